"""Methods by seed: a panel per metric, a point per seed, a bar at their mean. As a chart and as an SVG."""

from __future__ import annotations

from app.analysis.evaluations.service import BySeed, SeedRow
from app.analysis.figures import Box, Panel
from app.platform.web.charts import TEXT, Cell, Chart, axis, counted, figure, side_by_side
from app.platform.web.numbers import hover

METRICS = {
    "mae": ("Mean absolute error", "reward, lower is better"),
    "rank_correlation": ("Rank correlation", "Spearman, higher is better"),
    "regret_of_range": ("Regret@1", "share of the range, lower is better"),
}


def charts(found: BySeed) -> list[Chart]:
    """One chart per metric that some method has."""
    return [c for c in (_chart(found, name) for name in METRICS) if c.rows]


def panels(found: BySeed) -> list[Panel]:
    """The same for an SVG."""
    made = []
    for name, (title, unit) in METRICS.items():
        by_method = _by_method(found, name)
        boxes = []
        for rows in by_method.values():
            boxes.append(Box(rows[0].name, "#0b6e99", tuple(v for _, v in _values(rows, name)), f"n = {len(rows)}"))
        made.append(Panel(title, unit, tuple(boxes)))
    return made


def _by_method(found: BySeed, metric: str) -> dict[str, list[SeedRow]]:
    grouped: dict[str, list[SeedRow]] = {}
    for row in found.rows:
        if getattr(row, metric) is not None:
            grouped.setdefault(row.method, []).append(row)
    return grouped


def _values(rows: list[SeedRow], metric: str) -> list[tuple[int, float]]:
    return [(r.seed, float(getattr(r, metric))) for r in rows]


def _chart(found: BySeed, metric: str) -> Chart:
    title, unit = METRICS[metric]
    grouped = _by_method(found, metric)
    names = [rows[0].name for rows in grouped.values()]
    means = [sum(v for _, v in _values(rows, metric)) / len(rows) for rows in grouped.values()]
    points = [p for rows in grouped.values() for p in _values(rows, metric)]
    height = max((abs(v) for _, v in points), default=0.0)
    x = [i + s for i, own in enumerate(grouped.values()) for s in side_by_side([v for _, v in _values(own, metric)], height / 24, 0.3, 0.1)]
    data = [
        {"type": "bar", "x": list(range(len(names))), "y": means, "marker": {"color": "token:accent/0.3"}, "name": "mean"},
        {
            "type": "scatter", "mode": "markers", "x": x, "y": [v for _, v in points], "marker": {"size": 9, "color": TEXT}, "name": "seed",
            "text": [f"seed {s}" for s, _ in points], "hovertemplate": f"%{{text}}: {hover()}<extra></extra>",
        },
    ]  # fmt: skip
    layout = {
        "xaxis": {"tickvals": list(range(len(names))), "ticktext": names, "showgrid": False, "zeroline": False},
        "yaxis": axis(unit),
        "dragmode": False,
    }
    rows: list[list[Cell]] = [[r.name, r.seed, r.policies, getattr(r, metric)] for own in grouped.values() for r in own]
    subtitle = f"{unit} \u00b7 {counted(len(found.seeds), 'seed')} · {counted(found.policies, 'policy', 'policies')}"
    return Chart(
        f"seed-{metric.replace('_', '-')}", title, subtitle, figure(data, **layout), ("Method", "Seed", "Policies", title), rows, height=280
    )
