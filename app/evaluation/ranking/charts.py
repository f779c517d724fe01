"""Charts of the ranking and of running jobs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from app.evaluation.estimates.methods import METHOD_NAMES, METHOD_SHORT
from app.evaluation.schemas import RankedPolicy, RankingOut
from app.platform.jobs.models import Job, JobEvent
from app.platform.web.charts import MUTED, Chart, axis, figure

METHOD_STYLES = {
    "dlsm": {"color": "token:rl", "symbol": "diamond"},
    "linear": {"color": "token:distilled", "symbol": "square"},
    "dlmm": {"color": "token:accent", "symbol": "hexagram"},
    "fqe": {"color": "token:cdbs", "symbol": "circle"},
    "wdr": {"color": "token:no_dbs", "symbol": "cross"},
    "dual_dice": {"color": "token:warn", "symbol": "star"},
    "wis": {"color": "token:random", "symbol": "triangle-up"},
    "pdis": {"color": "token:other", "symbol": "x"},
    "cwpdis": {"color": "token:muted", "symbol": "triangle-down"},
    "aggregate": {"color": "token:text", "symbol": "pentagon"},
}
PALETTE = ("token:rl", "token:distilled", "token:random", "token:cdbs", "token:no_dbs", "token:other", "token:accent", "token:warn")
DASHES = ("solid", "dash", "dot")
JOB_CURVES = {
    "mean_q": ("Training: mean Q of each policy", "reward; an unbounded climb is over-estimation"),
    "action_distance": ("Training: distance from the logged amplitudes", "mean absolute difference, fraction"),
    "score": ("Training: estimated return on held-out sessions", "reward, fitted Q evaluation"),
    "loss": ("Distillation: loss", "mean squared difference from the teacher, fraction squared"),
    "dlsm_loss": ("DLSM: training loss", "negative objective"),
    "dlsm_held_out_score": ("DLSM: score on held-out sessions", "lower is better"),
    "dlmm_loss": ("DLMM: training loss", "negative evidence bound"),
    "dlmm_held_out_bound": ("DLMM: evidence bound on held-out sessions", "higher is better"),
    "dual_dice_dice_objective": ("DualDICE: objective", "saddle point; it need not fall"),
}
"""Learning curves by the name that the computations give them: title and unit."""

SHARE_CURVES = {"dlmm_loss", "dlmm_held_out_bound", "dual_dice_dice_objective"}
"""Curves that methods draw while they estimate, over the share of their work instead of their updates."""


def shown_references(ranking: RankingOut) -> list[RankedPolicy]:
    """References for the page: cDBS, the best constant, proportional control, the behaviour clone; the API has every constant."""
    return [p for p in ranking.references if p.reference != "constant"]


def label(policy: RankedPolicy) -> str:
    """A policy's name in the ranking's charts and tables."""
    names = {
        "cdbs": "cDBS (reference)",
        "best_constant": f"best constant: {policy.name}",
        "proportional": "proportional (reference)",
        "cloning": "behaviour clone (reference)",
    }
    return names.get(policy.reference or "", policy.name)


def forest(ranking: RankingOut) -> Chart:
    """Estimate and interval of every policy, best on top; the ranking's method is shown, the others wait in the legend."""
    shown = [*ranking.policies, *shown_references(ranking)]
    data = []
    for method in sorted(ranking.methods, key=lambda m: m != ranking.default_method):
        have = [p for p in shown if method in p.estimates]
        estimates = [p.estimates[method] for p in have]
        style = METHOD_STYLES[method]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": METHOD_SHORT[method],
                "visible": True if method == ranking.default_method else "legendonly",
                "x": [e.value for e in estimates],
                "y": [label(p) for p in have],
                "marker": {
                    "size": 10,
                    "color": style["color"],
                    "symbol": [style["symbol"] + ("" if e.supported else "-open") for e in estimates],
                },
                "error_x": {
                    "type": "data",
                    "symmetric": False,
                    "array": [e.high - e.value for e in estimates],
                    "arrayminus": [e.value - e.low for e in estimates],
                    "color": style["color"],
                },
                "hovertemplate": "%{y}: %{x:.2f}<extra>" + METHOD_NAMES[method] + "</extra>",
            }
        )
    level = next((e.level for p in shown for e in p.estimates.values()), 0.9)
    rows = [
        [label(p), p.rank, METHOD_NAMES[m], e.value, e.low, e.high, "yes" if e.supported else "no"]
        for p in shown
        for m, e in p.estimates.items()
    ]
    return Chart(
        id="forest",
        title="Estimated return",
        subtitle=f"E[r_end + discounted step rewards over {ranking.horizon_steps} steps], {100 * level:.0f} % intervals · "
        f"n = {ranking.snapshot.sessions} sessions · open marks: not supported by the data",
        figure=figure(
            data,
            xaxis=axis("Estimated return", "reward"),
            yaxis=axis("", categoryorder="array", categoryarray=[label(p) for p in reversed(shown)], dtick=1),
            margin={"l": 150, "r": 16, "t": 12, "b": 44},
        ),
        columns=["Policy", "Rank", "Method", "Value (reward)", f"Low ({100 * level:.0f} %)", f"High ({100 * level:.0f} %)", "Supported"],
        rows=rows,
        height=140 + 30 * len(shown),
    )


def job_curves(job: Job, events: Sequence[JobEvent]) -> list[Chart]:
    """The learning curves of a job's steps; of a step that was resumed, the last point of an x counts."""
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
    """A curve of several policies trained side by side ends in `_1`, `_2`, ...: its name, and ` · 1` for the line's label."""
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
        subtitle=f"{unit} · n = {len(rows)} points of {len(by_step)} {'step' if len(by_step) == 1 else 'steps'}",
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
