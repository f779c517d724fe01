"""Learning curves of running and ended jobs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from app.platform.numbers import counted
from app.platform.web.charts import MUTED, Chart, axis, figure
from app.tables.jobs import Job, JobEvent

PALETTE = ("token:rl", "token:distilled", "token:random", "token:cdbs", "token:no_dbs", "token:other", "token:accent", "token:warn")


DASHES = ("solid", "dash", "dot")


JOB_CURVES = {
    "mean_q": ("Training: mean Q of each policy", "reward; an unbounded climb is over-estimation"),
    "action_distance": ("Training: distance from the recorded amplitudes", "mean absolute difference, fraction of cDBS"),
    "score": ("Training: estimated return on held-out sessions", "reward, fitted Q evaluation"),
    "loss": ("Distillation: loss", "mean squared difference from the teacher, fraction squared"),
    "dlsm_loss": ("DLSM: training loss", "negative objective"),
    "dlsm_held_out_score": ("DLSM: score on held-out sessions", "lower is better"),
    "dlsm_paper_loss": ("DLSM (paper): training loss", "negative evidence bound"),
    "dlsm_paper_held_out_score": ("DLSM (paper): score on held-out sessions", "lower is better; it stops nothing here"),
    "dlmm_loss": ("DLMM: training loss", "negative evidence bound"),
    "dlmm_held_out_bound": ("DLMM: evidence bound on held-out sessions", "higher is better"),
    "dual_dice_dice_objective": ("DualDICE: objective", "saddle point; it need not fall"),
}
"""Learning curves by the name that the computations give them: title and unit."""


SHARE_CURVES = {"dlsm_paper_loss", "dlsm_paper_held_out_score", "dlmm_loss", "dlmm_held_out_bound", "dual_dice_dice_objective"}
"""Curves that methods draw while they estimate, over the share of their work instead of their updates."""


def job_curves(job: Job, events: Sequence[JobEvent]) -> list[Chart]:
    """Draw the learning curves of a job's steps; of a step that was resumed, the last point of an x counts."""
    curves: dict[str, dict[str, dict[float, float]]] = defaultdict(lambda: defaultdict(dict))
    for event in events:
        for point in event.data.get("points", []):
            for name, value in point["values"].items():
                curve, member = _of_member(name)
                curves[curve][(event.step_key or "") + member][point["x"]] = value
    titles = {s.key: s.title for s in job.steps}
    unnamed = sorted(curves.keys() - JOB_CURVES.keys())
    return [_curve_chart(name, curves[name], titles) for name in (*(n for n in JOB_CURVES if n in curves), *unnamed)]


def _of_member(name: str) -> tuple[str, str]:
    """Split the name of a curve of several policies trained side by side (`_1`, `_2`, ...) into its name and ` · 1` for the line's
    label."""
    curve, _, number = name.rpartition("_")
    return (curve, f" · {number}") if number.isdigit() and curve in JOB_CURVES else (name, "")


def _curve_chart(curve: str, by_step: dict[str, dict[float, float]], titles: dict[str, str]) -> Chart:
    title, unit = JOB_CURVES.get(curve, (curve.replace("_", " ").capitalize(), "as the computation gives it"))
    x_title = "Share of the fit (%)" if curve in SHARE_CURVES else "Update"
    data: list[dict[str, Any]] = []
    rows: list[list[Any]] = []
    for k, (step, points) in enumerate(sorted(by_step.items())):
        x = sorted(points)
        line = {"color": PALETTE[k % len(PALETTE)], "dash": DASHES[k // len(PALETTE) % len(DASHES)], "width": 1.8}
        key, _, member = step.partition(" · ")
        name = titles.get(key, key) + (f" · {member}" if member else "")
        data.append({"type": "scatter", "mode": "lines", "name": name, "x": x, "y": [points[v] for v in x], "line": line})
        rows += [[name, v, points[v]] for v in x]
    return Chart(
        id=f"job-{curve.replace('_', '-')}",
        title=title,
        subtitle=f"{unit} · n = {counted(len(rows), 'point')} of {counted(len(by_step), 'step')}",
        figure=figure(
            data,
            xaxis=axis(x_title),
            yaxis=axis(""),
            showlegend=True,
            legend={"orientation": "h", "y": -0.34, "yanchor": "top", "x": 0, "font": {"color": MUTED, "size": 11}},
        ),
        columns=["Step", x_title, title],
        rows=rows,
        height=400,
    )
