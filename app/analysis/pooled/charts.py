"""The results figure of several participants: a box and every session by participant and controller, a chart per metric."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from app.analysis import wording
from app.analysis.evidence.facts import METRICS
from app.analysis.metrics.charts import SHORT, above, box, points
from app.analysis.metrics.service import FiveMetrics
from app.analysis.metrics.shown import for_readers
from app.platform.web.charts import TEXT, Cell, Chart, axis, counted, figure

MOST_WIDE = 8
"""Boxes whose names stand side by side on a tablet in letters of full size."""


def results(found: Sequence[FiveMetrics]) -> list[Chart]:
    """A chart per metric that some session has."""
    shown = [for_readers(one) for one in found]
    return [c for c in (_chart(shown, metric) for metric in METRICS) if c.rows]


def _chart(found: Sequence[FiveMetrics], metric: str) -> Chart:
    data: list[dict[str, Any]] = []
    names: list[str] = []
    notes: list[dict[str, Any]] = []
    rows: list[list[Cell]] = []
    units: list[str] = []
    for one in found:
        m = next(m for m in one.metrics if m.metric == metric)
        tests = {c.controller: c for c in m.comparisons}
        units += [m.unit] if m.n and m.unit not in units else []
        for g in m.groups:
            if not g.n:
                continue
            at, test = len(names), tests.get(g.controller)
            data += [box(at, g), points(at, g, m)]
            names.append(f"{one.participant}<br>{SHORT.get(g.controller, g.label)}<br>n = {g.n}")
            text = above(test, metric)
            place = {"x": at, "y": 1.0, "yref": "paper", "yanchor": "bottom", "showarrow": False}
            notes.append(place | {"text": text, "font": {"size": 11, "color": TEXT}})
            rows.append([one.participant, g.label, g.n, g.median, g.q1, g.q3, test.p_value if test else None])
    unit, places = ", ".join(units), list(range(len(names)))
    layout = {
        "xaxis": {
            "tickvals": places,
            "ticktext": names,
            "range": [-0.6, len(names) - 0.4],
            "tickangle": 0,
            "tickfont": {"size": 10 if len(names) > MOST_WIDE else 12},
            "showgrid": False,
            "zeroline": False,
        },
        "yaxis": axis(unit, rangemode="tozero", zeroline=False),
        "annotations": notes,
        "margin": {"l": 52, "r": 8, "t": 26, "b": 60},
        "showlegend": False,
        "dragmode": False,
    }
    sessions = sum(int(r[2] or 0) for r in rows)
    subtitle = f"{unit} \u00b7 n = {counted(sessions, 'session')}"
    columns = ("Participant", "Controller", "n", "Median", "Quartile 1", "Quartile 3", "p")
    return Chart(
        f"all-{metric}",
        wording.TITLES[metric][0],
        subtitle,
        figure(data, **layout),
        columns,
        rows,
        height=280,
        src=f"/analyses/figure?metric={metric}",
    )
