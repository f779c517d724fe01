"""Five metrics in the units of pages and figures: energy in % of cDBS, as on every other page. Files and the API keep its share."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fastapi import Response

from app.analysis import primary_words
from app.analysis.facts import HIGHER_IS_BETTER, METRICS
from app.analysis.figures import COLOURS, SYNTHETIC, Box, Panel, boxes_svg, csv_of
from app.analysis.metrics import ALPHA, Comparison, FiveMetrics, Group, MetricResult, PolicyResult
from app.platform.kept import kept
from app.platform.numbers import counted, hover, p_text
from app.platform.web.charts import MUTED, TEXT, Cell, Chart, axis, colour, figure, marker, side_by_side
from app.platform.web.csv_files import download
from app.tables.sessions import LEARNED, Controller
from ml.outcomes import BY_KEY


def for_readers(found: FiveMetrics) -> FiveMetrics:
    """Convert every metric of the analysis to the unit in which it is shown."""
    return replace(found, metrics=[_metric(m) for m in found.metrics])


def _metric(m: MetricResult) -> MetricResult:
    factor = primary_words.shown_factor(m.metric)
    if factor == 1.0:
        return m
    return replace(
        m,
        unit=primary_words.shown_unit(m.metric, m.unit),
        groups=[_group(g, factor) for g in m.groups],
        comparisons=[_comparison(c, factor) for c in m.comparisons],
        policies=[PolicyResult(p.policy_id, _group(p.group, factor), _comparison(p.comparison, factor)) for p in m.policies],
    )


def _group(g: Group, factor: float) -> Group:
    q1, median, q3 = (None if v is None else factor * v for v in (g.q1, g.median, g.q3))
    return replace(g, q1=q1, median=median, q3=q3, values=tuple(factor * v for v in g.values))


def _comparison(c: Comparison, factor: float) -> Comparison:
    difference, low, high = (None if v is None else factor * v for v in (c.difference, c.low, c.high))
    return replace(c, difference=difference, low=low, high=high)


# The five charts of the participant page, in the manner of the paper's results figure: a box and every session, by controller.

SHORT = {Controller.DISTILLED: "Distilled"}
"""Names that must fit under a narrow box."""

COLUMNS = (
    "Controller", "n", "Median", "Quartile 1", "Quartile 3", "Difference from cDBS", "95 % low", "95 % high", "p", "p (Holm)", "Test",
)  # fmt: skip

_HALF, _STEP, _ROWS = 0.27, 0.11, 24
"""Dots next to a box: furthest offset, distance of neighbours where there is room, and how many rows of dots a panel is high."""


@dataclass(frozen=True)
class FiveMetricsView:
    """Content of the fragment `analysis/five_metrics.html`: pass it as `analysis`."""

    result: FiveMetrics
    charts: list[Chart]


def view(result: FiveMetrics, evidence: Hashable) -> FiveMetricsView:
    """Return the analysis as it is shown, with its charts, which are cached under the key of its evidence."""
    shown = for_readers(result)
    return FiveMetricsView(shown, kept(("metric charts", evidence), lambda: [metric_chart(m) for m in shown.metrics if m.n]))


def metric_chart(metric: MetricResult) -> Chart:
    """Plot box and strip of one metric by controller, with p-values above and the numbers in the table."""
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
    """Draw quartiles of a group, whiskers to its extremes."""
    return {
        "type": "box", "x": [at], "q1": [g.q1], "median": [g.median], "q3": [g.q3],
        "lowerfence": [min(g.values)], "upperfence": [max(g.values)], "width": 0.5, "boxpoints": False, "hoverinfo": "skip",
        "line": {"color": colour(g.controller), "width": 1.5}, "fillcolor": colour(g.controller, 0.12),
    }  # fmt: skip


def points(at: int, g: Group, metric: MetricResult) -> dict[str, Any]:
    """Draw every session of a group, to the four digits that its label shows: a page of many participants has thousands."""
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
    """Write the text above a box: p, with an asterisk where a learned controller is better at .05."""
    if test is None:
        return "p"
    return "too few" if test.p_value is None else p_text(test.p_value) + (" *" if is_better(test, metric) else "")


def is_better(test: Comparison, metric: str) -> bool:
    """Decide whether a learned controller differs from cDBS in the desired direction, with p below .05: other arms are not on trial."""
    if test.controller not in LEARNED or test.p_value is None or test.difference is None or test.p_value >= ALPHA or test.difference == 0:
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


# The paper's comparisons as a table and as a figure, of one participant or of several.

EXPORTED = (
    "participant", "metric", "unit", "controller", "policy_id", "name", "n", "n_cdbs", "median", "q1", "q3", "difference", "low", "high",
    "level", "p", "p_holm", "method", "not_tested",
)  # fmt: skip
SVG = "image/svg+xml"


def table(found: Sequence[FiveMetrics], name: str) -> Response:
    """Serve one row per participant, metric and controller or policy."""
    return download(csv_of(EXPORTED, (row for one in found for row in _rows(one))), f"{name}-as-in-the-paper.csv")


def svg(found: Sequence[FiveMetrics], name: str, *, synthetic: bool) -> Response:
    """Draw the results figure: a panel per metric, a box per participant and controller, every session a point."""
    shown = [for_readers(one) for one in found]
    panels = [_panel(shown, metric) for metric in METRICS]
    note = "Two-sided Wilcoxon rank-sum test against cDBS, sessions taken as independent; * a learned controller is better, p < .05."
    note = f"{SYNTHETIC} {note}" if synthetic else note
    content = boxes_svg([p for p in panels if any(b.values for b in p.boxes)], f"Results {name}", note)
    return Response(content, media_type=SVG, headers={"Content-Disposition": f'inline; filename="{name}-results.svg"'})


def _rows(found: FiveMetrics) -> Iterator[tuple[object, ...]]:
    for m in found.metrics:
        tests = {c.controller: c for c in m.comparisons}
        for g in m.groups:
            yield _line(found.participant, m.metric, m.unit, None, g, tests.get(g.controller))
        for p in m.policies:
            yield _line(found.participant, m.metric, m.unit, p.policy_id, p.group, p.comparison)


def _line(participant: str, metric: str, unit: str, policy_id: int | None, g: Group, c: Comparison | None) -> tuple[object, ...]:
    summary = (participant, metric, unit, g.controller.value, policy_id, g.label, g.n, c and c.n_cdbs, g.median, g.q1, g.q3)
    if c is None:
        return (*summary, None, None, None, None, None, None, "reference", None)
    return (*summary, c.difference, c.low, c.high, c.level, c.p_value, c.p_holm, c.method, c.note)


def _panel(found: Sequence[FiveMetrics], metric: str) -> Panel:
    boxes: list[Box] = []
    unit = ""
    for one in found:
        m = next(m for m in one.metrics if m.metric == metric)
        unit = unit or m.unit
        tests = {c.controller: c for c in m.comparisons}
        for g in m.groups:
            if g.n:
                label = SHORT.get(g.controller, g.label)
                lines = f"{one.participant}\n{label}\nn = {g.n}" if len(found) > 1 else f"{label}\nn = {g.n}"
                boxes.append(Box(lines, COLOURS[g.controller.value], g.values, above(tests.get(g.controller), metric)))
    return Panel(primary_words.TITLES[metric][0], unit, tuple(boxes))
