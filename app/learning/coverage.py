"""Coverage of a snapshot's buffer: amplitudes, beta, sessions per controller and visit, and what stayed outside."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.learning.trajectories import read_buffer
from app.platform.numbers import counted, stated
from app.platform.web.charts import ACCENT, CONTROLLERS, WARN, Chart, axis, figure
from app.study import blinding
from app.study import repository as study_repository
from app.tables.learning import BufferSnapshot
from app.tables.sessions import StudySession
from ml.mdp import AMPLITUDE_TOLERANCE
from ml.trajectories import ReplayBuffer

AMPLITUDE_BINS = 20
HIDDEN = "hidden"
"""Replaces the controller of a session whose plan's key is sealed."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


@dataclass(frozen=True)
class LeftOut:
    """A session outside the buffer, and why."""

    session: StudySession
    reason: str


@dataclass(frozen=True)
class SnapshotView:
    """A snapshot for its page.

    Attributes:
        sessions_by_visit: sessions per controller, for each visit's number.
        controllers: those that occur, in the order of every table.
        left_out: sessions outside, with their reasons.
        steps: all steps of the sessions inside; usable_steps: those that may enter; above_one: those above the cDBS amplitude.
        with_end_reward: sessions inside whose QoCs give an r_end.
        above_threshold: share of valid beta amplitudes at or above xi_beta.
        amplitudes, betas: charts.
    """

    snapshot: BufferSnapshot
    settings_version: int
    controllers: list[str]
    sessions_by_visit: dict[int, Counter[str]]
    left_out: list[LeftOut]
    steps: int
    usable_steps: int
    above_one: int
    with_end_reward: int
    above_threshold: float
    amplitudes: Chart
    betas: Chart


def describe(db: Session, snapshot: BufferSnapshot, caller: Caller) -> SnapshotView:
    """Read a snapshot's file and say what it covers."""
    buffer = read_buffer(snapshot.file_sha256)
    sessions = {s.id: s for s in study_repository.sessions_of_participant(db, snapshot.participant_id)}
    by_visit: dict[int, Counter[str]] = {}
    for member in snapshot.members:
        session = sessions[member.session_id]
        if member.left_out_reason is None:
            # a plan may be signed over sessions of an earlier snapshot: of these only the visit is shown
            arm = blinding.arm(session, caller) if blinding.unsealed([session]) else None
            by_visit.setdefault(session.visit.number, Counter())[arm.controller.value if arm else HIDDEN] += 1
    present = {name for counts in by_visit.values() for name in counts}
    amplitude = np.concatenate([s.amplitude for s in buffer.sessions])
    beta = np.concatenate([s.beta for s in buffer.sessions])
    valid = beta[~np.isnan(beta)]
    return SnapshotView(
        snapshot=snapshot,
        settings_version=study_repository.settings_version(db, snapshot.settings_version_id).version,
        controllers=[name for name in (*CONTROLLERS, HIDDEN) if name in present],
        sessions_by_visit=dict(sorted(by_visit.items())),
        left_out=[LeftOut(sessions[m.session_id], m.left_out_reason) for m in snapshot.members if m.left_out_reason is not None],
        steps=int(amplitude.size),
        usable_steps=snapshot.steps,
        above_one=int(np.sum(amplitude > 1 + AMPLITUDE_TOLERANCE)),
        with_end_reward=sum(s.end_reward(buffer.settings) is not None for s in buffer.sessions),
        above_threshold=float(np.mean(valid >= buffer.settings.xi_beta)),
        amplitudes=_amplitude_chart(buffer),
        betas=_beta_chart(buffer),
    )


def _amplitude_chart(buffer: ReplayBuffer) -> Chart:
    actions = buffer.transitions().actions
    counts, edges = np.histogram(actions, bins=AMPLITUDE_BINS, range=(0.0, 1.0))
    centres = (edges[:-1] + edges[1:]) / 2
    data = [
        {"type": "bar", "x": centres, "y": counts, "marker": {"color": ACCENT}, "hovertemplate": "%{y} steps near %{x:.2f}<extra></extra>"}
    ]
    return Chart(
        id="amplitudes",
        title="Recorded amplitudes",
        subtitle=f"amplitude fraction of the cDBS amplitude · n = {actions.size} usable steps",
        figure=figure(data, xaxis=axis("Amplitude", "fraction", range=[-0.02, 1.02]), yaxis=axis("Steps"), bargap=0.05),
        columns=["From (fraction)", "To (fraction)", "Steps"],
        rows=[[float(a), float(b), int(n)] for a, b, n in zip(edges[:-1], edges[1:], counts, strict=True)],
        height=260,
    )


def _beta_chart(buffer: ReplayBuffer) -> Chart:
    """Draw quantiles of beta per session, oldest session first, with the threshold."""
    unit, xi = buffer.beta_unit, buffer.settings.xi_beta
    labels = [f"visit {s.visit} · {s.session_id}" for s in buffer.sessions]
    quantiles = np.array([np.nanquantile(s.beta, QUANTILES) for s in buffer.sessions])
    low, mid, high = quantiles[:, 0], quantiles[:, 2], quantiles[:, 4]
    data: list[dict[str, Any]] = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": "median, 5 to 95 %",
            "x": labels,
            "y": mid,
            "error_y": {"type": "data", "symmetric": False, "array": high - mid, "arrayminus": mid - low, "color": ACCENT},
            "marker": {"color": ACCENT, "size": 7},
        },
        {
            "type": "scatter",
            "mode": "lines",
            "name": f"threshold {stated(xi, 4)}",
            "x": labels,
            "y": [xi] * len(labels),
            "line": {"color": WARN, "dash": "dash"},
        },
    ]
    return Chart(
        id="betas",
        title="Beta of each session",
        subtitle=f"{unit} from {buffer.beta_source.replace('_', ' ')} · n = {counted(len(labels), 'session')}",
        figure=figure(data, xaxis=axis("Session", showticklabels=len(labels) <= 24), yaxis=axis("Beta", unit)),
        columns=["Session", *(f"{100 * q:.0f} % quantile ({unit})" for q in QUANTILES)],
        rows=[[label, *map(float, row)] for label, row in zip(labels, quantiles, strict=True)],
        height=300,
    )
