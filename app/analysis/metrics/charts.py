"""The five charts of the participant page, in the manner of the paper's results figure: a box and every session, by controller."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

from app.analysis.evidence.measurements import HIGHER_IS_BETTER
from app.analysis.metrics.comparisons import ALPHA, Comparison, Group
from app.analysis.metrics.service import FiveMetrics, MetricResult
from app.analysis.metrics.shown import for_readers
from app.platform.kept import kept
from app.platform.web.charts import MUTED, TEXT, Cell, Chart, axis, colour, counted, figure, marker, side_by_side
from app.platform.web.numbers import hover, p_text
from app.tables.sessions import Controller
from ml.outcomes import BY_KEY

SHORT = {Controller.DISTILLED: "Distilled"}
"""Names that must fit under a narrow box."""

COLUMNS = (
    "Controller", "n", "Median", "Quartile 1", "Quartile 3", "Difference from cDBS", "95 % low", "95 % high", "p", "p (Holm)", "Test",
)  # fmt: skip

_HALF, _STEP, _ROWS = 0.27, 0.11, 24
"""Of the dots beside a box: furthest offset, distance of neighbours where there is room, and how many rows of dots a panel is high."""


@dataclass(frozen=True)
class FiveMetricsView:
    """What the fragment `analysis/five_metrics.html` shows: pass it as `analysis`."""

    result: FiveMetrics
    charts: list[Chart]


def view(result: FiveMetrics, evidence: Hashable) -> FiveMetricsView:
    """The analysis as it is shown, with its charts, which are kept under the key of the evidence that it is made of."""
    shown = for_readers(result)
    return FiveMetricsView(shown, kept(("metric charts", evidence), lambda: [metric_chart(m) for m in shown.metrics if m.n]))


def metric_chart(metric: MetricResult) -> Chart:
    """Box and strip of one metric by controller, with p-values above and the numbers in the table."""
    shown = [g for g in metric.groups if g.n]
    tests = {c.controller: c for c in metric.comparisons}
    data: list[dict[str, Any]] = []
    for at, g in enumerate(shown):
        data += [box(at, g), points(at, g, metric)]
    names = [f"{SHORT.get(g.controller, g.label)}<br>n = {g.n}" for g in shown]
    places = {"tickvals": list(range(len(shown))), "ticktext": names, "range": [-0.6, len(shown) - 0.4], "tickangle": 0}
    layout: dict[str, Any] = {
        "xaxis": {**places, "showgrid": False, "zeroline": False},
        "yaxis": axis(metric.unit, rangemode="tozero", zeroline=False),
        "annotations": [_p_label(at, tests.get(g.controller), metric.metric) for at, g in enumerate(shown)],
        "margin": {"l": 52, "r": 8, "t": 30, "b": 44},
        "showlegend": False,
        "dragmode": False,
    }
    outcome = BY_KEY.get(metric.metric)
    if outcome is not None and outcome.whole:
        layout["yaxis"] |= {"range": [outcome.low - 0.5, outcome.high + 0.5], "dtick": 1}
    rows = [_row(g, tests.get(g.controller)) for g in metric.groups]
    subtitle = f"{metric.unit} \u00b7 n = {counted(metric.n, 'session')}"
    return Chart(f"metric-{metric.metric}", metric.title, subtitle, figure(data, **layout), COLUMNS, rows, height=270)


def box(at: int, g: Group) -> dict[str, Any]:
    """Quartiles of a group, whiskers to its extremes."""
    return {
        "type": "box", "x": [at], "q1": [g.q1], "median": [g.median], "q3": [g.q3],
        "lowerfence": [min(g.values)], "upperfence": [max(g.values)], "width": 0.5, "boxpoints": False, "hoverinfo": "skip",
        "line": {"color": colour(g.controller), "width": 1.5}, "fillcolor": colour(g.controller, 0.12),
    }  # fmt: skip


def points(at: int, g: Group, metric: MetricResult) -> dict[str, Any]:
    """Every session of a group, to the four digits that its label shows: a page of many participants has thousands."""
    height = max((max(other.values) for other in metric.groups if other.n), default=0.0)
    outcome = BY_KEY.get(metric.metric)
    unit = outcome.entry_unit if outcome is not None and outcome.whole else metric.unit
    return {
        "type": "scatter", "mode": "markers", "x": [round(at + s, 3) for s in side_by_side(g.values, height / _ROWS, _HALF, _STEP)],
        "y": [float(f"{v:.4g}") for v in g.values], "cliponaxis": False,
        "marker": marker(g.controller, 8, opacity=0.9, line={"color": "token:surface", "width": 0.7}), "name": g.label,
        "customdata": list(g.session_ids), "meta": "/sessions/",
        "hovertemplate": f"{g.label}, session %{{customdata}}<br>{hover(digits=4)} {unit}<extra></extra>",
    }  # fmt: skip


def above(test: Comparison | None, metric: str) -> str:
    """What stands above a box: p, with an asterisk where it is below .05 in the desired direction."""
    if test is None:
        return "p"
    return "too few" if test.p_value is None else p_text(test.p_value) + (" *" if is_better(test, metric) else "")


def is_better(test: Comparison, metric: str) -> bool:
    """Whether a difference is below .05 and in the desired direction."""
    if test.p_value is None or test.difference is None or test.p_value >= ALPHA or test.difference == 0:
        return False
    return (test.difference > 0) is HIGHER_IS_BETTER[metric]


def _p_label(at: int, test: Comparison | None, metric: str) -> dict[str, Any]:
    strong = test is not None and test.p_value is not None and test.p_value < ALPHA
    text = above(test, metric)
    return {
        "x": at, "y": 1.0, "yref": "paper", "yanchor": "bottom", "showarrow": False, "text": f"<b>{text}</b>" if strong else text,
        "font": {"size": 12, "color": TEXT if strong else MUTED},
    }  # fmt: skip


def _row(g: Group, test: Comparison | None) -> list[Cell]:
    row: list[Cell] = [g.label, g.n, g.median, g.q1, g.q3]
    if test is None:
        return [*row, None, None, None, None, None, "reference"]
    return [*row, test.difference, test.low, test.high, test.p_value, test.p_holm, test.method or test.note]
