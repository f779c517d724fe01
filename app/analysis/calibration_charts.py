"""Charts of the calibration: predicted against actual return, the metrics of every method, and each outcome."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from app.analysis.calibration_accuracy import AccuracyOut, CalibrationOut, MethodMetricOut, PredictionOut, TestedPolicyOut
from app.evaluation.ranking.charts import style
from app.platform.numbers import counted, hover
from app.platform.web.charts import MUTED, Chart, axis, figure
from ml.ope import shown as method_of
from ml.outcomes import OUTCOMES

QUANTITY_NAMES = {
    **{o.field: (o.label, o.unit, 1.0) for o in OUTCOMES},
    "energy": ("Energy", "% of cDBS", 100.0),
    "mean_beta": ("Mean beta", "", 1.0),
}
"""Title, unit, and factor of the stored number in that unit; the unit of beta is the participant's."""
METRIC_NAMES = {
    "mae": ("Mean absolute error", "reward"),
    "rank_correlation": ("Rank correlation", "Spearman"),
    "regret_of_range": ("Regret@1", "share of range"),
}
"""What the chart of metrics shows; the table has the other forms too."""

Point = tuple[TestedPolicyOut, PredictionOut]


def label(p: TestedPolicyOut) -> str:
    """Label a policy at a visit."""
    return f"{'cDBS (reference)' if p.reference else p.name}, visit {p.visit}"


def returns(found: CalibrationOut, method: str) -> Chart:
    """Plot actual against predicted return by one method, with the line on which they agree."""
    shown = [(p, q) for p in found.policies for q in p.predictions if q.method == method]
    bars = [v for _, q in shown for v in (q.predicted, q.low, q.high, q.actual, q.actual_low, q.actual_high) if v is not None]
    square = _square(bars, bars)
    rows = [
        [
            label(p), q.predicted, q.low, q.high, q.actual, q.actual_low, q.actual_high, q.sessions,
            "whole return" if q.parts == "return" else "steps alone",
        ]
        for p, q in shown
    ]  # fmt: skip
    level = f"{100 * found.level:.0f} %"
    return Chart(
        id="predicted-actual",
        title="Worth of a session, predicted and seen",
        subtitle=f"score of the whole session, {level} intervals \u00b7 {_n([(p, q.sessions) for p, q in shown])} \u00b7 "
        "dashed: predicted = seen \u00b7 circles: cDBS \u00b7 open marks: no session near",
        figure=figure(
            [_trace(method, shown)],
            xaxis=axis("Predicted before the visit", "score", range=square["range"]),
            yaxis=axis("Seen at the visit", "score", range=square["range"]),
            shapes=square["shapes"],
            showlegend=False,
        ),
        columns=["Policy", "Predicted (score)", "Low", "High", "Seen (score)", "Low", "High", "Sessions", "Compared"],
        rows=rows,
        height=460,
    )


def metrics(found: CalibrationOut) -> Chart:
    """Plot MAE, rank correlation and regret of every method over all visits, side by side, with intervals over resampled visits."""
    rows = [m for m in found.metrics if m.visit is None]
    names = [method_of(m.method).short for m in rows]
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {}
    for k, (metric, (title, unit)) in enumerate(METRIC_NAMES.items()):
        suffix = "" if k == 0 else str(k + 1)
        values = [getattr(m, metric) for m in rows]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": [v.value for v in values],
                "y": names,
                "xaxis": f"x{suffix}",
                "cliponaxis": False,
                "error_x": _error_bars(values),
                "marker": {
                    "size": 10,
                    "color": [style(m.method)["color"] for m in rows],
                    "symbol": [style(m.method)["symbol"] for m in rows],
                },
                "hovertemplate": f"%{{y}}: {hover('x')}<extra>{title}</extra>",
            }
        )
        more = {"range": [-1.1, 1.1]} if metric == "rank_correlation" else {"rangemode": "tozero"}
        layout[f"xaxis{suffix}"] = axis(title, unit, domain=[k / 3 + (0.03 if k else 0.0), (k + 1) / 3 - 0.02], anchor="y", **more)
    level, most = f"{100 * found.level:.0f} %", max((m.sessions for m in rows), default=0)
    columns = ["Method", "n policies at visits", "n sessions"]
    for title, unit in METRIC_NAMES.values():
        columns += [f"{title} ({unit})", f"Low ({level})", f"High ({level})"]
    return Chart(
        id="metrics",
        title="Metrics of every method",
        subtitle=f"over all visits, {level} over resampled visits \u00b7 n = {counted(most, 'session')}",
        figure=figure(
            data,
            yaxis=axis("", categoryorder="array", categoryarray=names[::-1]),
            showlegend=False,
            margin={"l": 96, "r": 16, "t": 12, "b": 48},
            **layout,
        ),
        columns=columns,
        rows=[[method_of(m.method).name, m.policies, m.sessions, *(v for name in METRIC_NAMES for v in _cells(m, name))] for m in rows],
        height=110 + 34 * len(rows),
    )


def over_visits(found: CalibrationOut, method: str) -> Chart | None:
    """Plot the three metrics of every method at each visit, side by side; None where there are not two visits to compare.

    The shown method is drawn strongly with its intervals, the others thinly.
    """
    rows = [m for m in found.metrics if m.visit is not None]
    visits = sorted({m.visit for m in rows if m.visit is not None})
    if len(visits) < 2:
        return None
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {}
    for k, (metric, (title, unit)) in enumerate(METRIC_NAMES.items()):
        suffix = "" if k == 0 else str(k + 1)
        for name in sorted(found.methods, key=lambda m: m == method):
            own = [m for m in rows if m.method == name]
            values, marks, chosen = [getattr(m, metric) for m in own], style(name), name == method
            data.append(
                {
                    "type": "scatter",
                    "mode": "lines+markers",
                    "name": method_of(name).short,
                    "legendgroup": name,
                    "showlegend": k == 0,
                    "opacity": 1.0 if chosen else 0.45,
                    "x": [m.visit for m in own],
                    "y": [v.value for v in values],
                    "xaxis": f"x{suffix}",
                    "yaxis": f"y{suffix}",
                    "line": {"color": marks["color"], "width": 2.5 if chosen else 1.2},
                    "marker": {"size": 9 if chosen else 6, "color": marks["color"], "symbol": marks["symbol"]},
                    "hovertemplate": f"visit %{{x}}: {hover()}<extra>{method_of(name).name}</extra>",
                }
                | ({"error_y": _error_bars(values)} if chosen else {})
            )
        ticks = {"tickvals": visits, "range": [visits[0] - 0.3, visits[-1] + 0.3]}
        layout[f"xaxis{suffix}"] = axis(
            "Visit", "", domain=[k / 3 + (0.05 if k else 0.0), (k + 1) / 3 - 0.02], anchor=f"y{suffix}", **ticks
        )
        more = {"range": [-1.1, 1.1]} if metric == "rank_correlation" else {"rangemode": "tozero"}
        layout[f"yaxis{suffix}"] = axis(title, unit, anchor=f"x{suffix}", **more)
    level = f"{100 * found.level:.0f} %"
    columns = ["Visit", "Method", "n policies", "n sessions"]
    for title, unit in METRIC_NAMES.values():
        columns += [f"{title} ({unit})", f"Low ({level})", f"High ({level})"]
    return Chart(
        id="over-visits",
        title="Metrics visit by visit",
        subtitle=f"strong: {method_of(method).name}, points: one visit each \u00b7 n = {counted(len(visits), 'visit')}, "
        f"{counted(sum(m.sessions for m in rows if m.method == method), 'session')} \u00b7 a gap: too few policies at that visit",
        figure=figure(
            data,
            showlegend=True,
            legend={"orientation": "h", "y": -0.24, "yanchor": "top", "x": 0, "font": {"color": MUTED, "size": 11}},
            **layout,
        ),
        columns=columns,
        rows=[
            [m.visit, method_of(m.method).name, m.policies, m.sessions, *(v for name in METRIC_NAMES for v in _cells(m, name))]
            for m in rows
        ],
        height=340,
    )


def quantities(found: CalibrationOut, method: str) -> list[Chart]:
    """Plot actual against predicted values of every outcome that the method predicts."""
    points = [(p, q) for p in found.policies for q in p.predictions if q.method == method]
    charts = []
    for name, (title, unit, factor) in QUANTITY_NAMES.items():
        own = [(p, quantity) for p, q in points for quantity in q.quantities if quantity.name == name]
        if not own:
            continue
        unit = unit or found.beta_unit or ""
        ends = [factor * v for _, q in own for v in (q.predicted, q.actual)]
        square = _square(ends, ends)
        marks = style(method)
        trace = {
            "type": "scatter",
            "mode": "markers",
            "name": method_of(method).name,
            "x": [factor * q.predicted for _, q in own],
            "y": [factor * q.actual for _, q in own],
            "text": [label(p) for p, _ in own],
            "marker": {"size": 9, "color": marks["color"], "symbol": ["circle" if p.reference else marks["symbol"] for p, _ in own]},
            "hovertemplate": f"%{{text}}: predicted {hover('x')}, seen {hover()}<extra></extra>",
        }
        charts.append(
            Chart(
                id=f"actual-{name.replace('_', '-')}",
                title=title,
                subtitle=f"{unit} \u00b7 {_n([(p, q.sessions) for p, q in own])}",
                figure=figure(
                    [trace],
                    xaxis=axis("Predicted before", unit, range=square["range"]),
                    yaxis=axis("Seen", unit, range=square["range"]),
                    shapes=square["shapes"],
                    showlegend=False,
                ),
                columns=["Policy", f"Predicted ({unit})", f"Seen ({unit})", "Sessions"],
                rows=[[label(p), factor * q.predicted, factor * q.actual, q.sessions] for p, q in own],
                height=280,
            )
        )
    return charts


def _n(compared: Sequence[tuple[TestedPolicyOut, int]]) -> str:
    """Count the points and sessions; cDBS is counted apart, since the metrics exclude it."""
    policies = sum(p.reference is None for p, _ in compared)
    beside = len(compared) - policies
    references = f" and {beside} of cDBS" if beside else ""
    return f"n = {counted(policies, 'policy', 'policies')} at visits{references}, {counted(sum(n for _, n in compared), 'session')}"


def _square(values: Sequence[float], everything: Sequence[float]) -> dict[str, Any]:
    """Build layout members: both axes over one range of the values, and the line on which predicted and actual agree, over everything."""
    low, high = min(values), max(values)
    margin = 0.06 * (high - low) or 1.0
    ends = [min(low - margin, *everything), max(high + margin, *everything)]
    line = {"type": "line", "layer": "below", "x0": ends[0], "y0": ends[0], "x1": ends[1], "y1": ends[1]}
    return {"range": [low - margin, high + margin], "shapes": [line | {"line": {"color": MUTED, "width": 1.2, "dash": "dash"}}]}


def _trace(method: str, points: Sequence[Point]) -> dict[str, Any]:
    marks = style(method)

    def bars(of: Callable[[PredictionOut], tuple[float | None, float, float | None]]) -> dict[str, Any]:
        """Build error bars from (low, value, high); none where an end is unknown."""
        ends = [of(q) for _, q in points]
        return {
            "type": "data",
            "symmetric": False,
            "array": [h - v if h is not None else 0.0 for _, v, h in ends],
            "arrayminus": [v - low if low is not None else 0.0 for low, v, _ in ends],
            "color": marks["color"],
            "thickness": 1,
        }

    symbols = [("circle" if p.reference else marks["symbol"]) + ("" if q.supported else "-open") for p, q in points]
    return {
        "type": "scatter",
        "mode": "markers",
        "name": method_of(method).short,
        "x": [q.predicted for _, q in points],
        "y": [q.actual for _, q in points],
        "text": [label(p) for p, _ in points],
        "error_x": bars(lambda q: (q.low, q.predicted, q.high)),
        "error_y": bars(lambda q: (q.actual_low, q.actual, q.actual_high)),
        "marker": {"size": 10, "color": marks["color"], "symbol": symbols},
        "hovertemplate": "%{text}: predicted %{x:.2f}, seen %{y:.2f}<extra></extra>",
    }


def _error_bars(values: Sequence[MethodMetricOut]) -> dict[str, Any]:
    return {
        "type": "data",
        "symmetric": False,
        "array": [v.high - v.value if v.value is not None and v.high is not None else None for v in values],
        "arrayminus": [v.value - v.low if v.value is not None and v.low is not None else None for v in values],
        "color": MUTED,
        "thickness": 1.2,
    }


def _cells(m: AccuracyOut, name: str) -> list[float | None]:
    metric: MethodMetricOut = getattr(m, name)
    return [metric.value, metric.low, metric.high]
