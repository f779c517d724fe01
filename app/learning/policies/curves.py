"""Learning curves of one policy, as charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from app.platform.web.charts import ACCENT, Chart, axis, counted, figure

CURVES = {
    "mean_q": ("Promised return of the policy", "reward; an unbounded climb is over-estimation"),
    "action_distance": ("Distance from the recorded amplitudes", "mean absolute difference, fraction of cDBS"),
    "saturated": ("States answered with next to 0 or 1", "share; at 1 the policy is cDBS or no DBS by another name"),
    "critic_loss": ("Critic loss", "mean squared temporal-difference error, reward squared"),
    "loss": ("Distillation loss", "mean squared difference from the teacher, fraction squared"),
}
"""Learning curves by the name that the learners give them: title and unit."""


def curve_charts(curve: Mapping[str, Sequence[float]], of: str) -> list[Chart]:
    """Make a chart for each learning curve of a policy."""
    updates = curve.get("update", [])
    charts = []
    for name, (title, unit) in CURVES.items():
        values = curve.get(name)
        if not values:
            continue
        data = [{"type": "scatter", "mode": "lines", "x": updates, "y": values, "line": {"color": ACCENT, "width": 2}}]
        log = "loss" in name and min(values) > 0
        charts.append(
            Chart(
                id=f"curve-{name}",
                title=title,
                subtitle=f"{unit} · {of} · n = {counted(len(values), 'point')}",
                figure=figure(data, xaxis=axis("Update"), yaxis=axis("", type="log" if log else "linear")),
                columns=["Update", title],
                rows=[[int(u), float(v)] for u, v in zip(updates, values, strict=True)],
                height=240,
            )
        )
    return charts
