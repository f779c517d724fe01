"""The paper's comparisons as a table and as a figure, of one participant or of several."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fastapi import Response

from app.analysis import wording
from app.analysis.evidence.facts import METRICS
from app.analysis.figures import COLOURS, Box, Panel, boxes_svg
from app.analysis.metrics.charts import SHORT, above
from app.analysis.metrics.comparisons import Comparison, Group
from app.analysis.metrics.service import FiveMetrics
from app.analysis.metrics.shown import for_readers
from app.analysis.tables import csv_of
from app.platform.web.csv_files import download

COLUMNS = (
    "participant", "metric", "unit", "controller", "policy_id", "name", "n", "n_cdbs", "median", "q1", "q3", "difference", "low", "high",
    "level", "p", "p_holm", "method", "not_tested",
)  # fmt: skip
SVG = "image/svg+xml"


def table(found: Sequence[FiveMetrics], name: str) -> Response:
    """One row per participant, metric and controller or policy."""
    return download(csv_of(COLUMNS, (row for one in found for row in _rows(one))), f"{name}-as-in-the-paper.csv")


def svg(found: Sequence[FiveMetrics], name: str) -> Response:
    """The results figure: a panel per metric, a box per participant and controller, every session a point."""
    shown = [for_readers(one) for one in found]
    panels = [_panel(shown, metric) for metric in METRICS]
    note = "Two-sided Wilcoxon rank-sum test against cDBS, sessions taken as independent; * p < .05 in the desired direction."
    content = boxes_svg([p for p in panels if any(b.values for b in p.boxes)], f"Results {name}", note)
    return Response(content, media_type=SVG, headers={"Content-Disposition": f'inline; filename="{name}-results.svg"'})


def _rows(found: FiveMetrics) -> Iterator[tuple[object, ...]]:
    for m in found.metrics:
        tests = {c.controller: c for c in m.comparisons}
        for g in m.groups:
            yield _row(found.participant, m.metric, m.unit, None, g, tests.get(g.controller))
        for p in m.policies:
            yield _row(found.participant, m.metric, m.unit, p.policy_id, p.group, p.comparison)


def _row(participant: str, metric: str, unit: str, policy_id: int | None, g: Group, c: Comparison | None) -> tuple[object, ...]:
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
    return Panel(wording.TITLES[metric][0], unit, tuple(boxes))
