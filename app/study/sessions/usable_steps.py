"""Usable steps of a session, per channel that could have driven its controller, and the reason where there are none."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.platform.errors import Invalid
from app.study import cdbs_amplitude, repository
from app.study.settings import mismatch
from app.study.traces import (
    AMPLITUDE_STREAM,
    StepTable,
    TracesOf,
    amplitude_program,
    beta_of_part,
    driving,
    laid_out,
    shown_table,
    step_table,
)
from app.tables.participants import SettingsVersion
from app.tables.recordings import Trace
from app.tables.sessions import StudySession
from ml.outcomes import OUTCOMES
from ml.qoc import Qoc, failed_qoc
from ml.trajectories import SessionTrajectory

# One session as pages, analyses and buffers read it: its steps, its beta threshold where unit and source fit, its QoCs.


@dataclass(frozen=True)
class SessionData:
    """A session with its step table under the participant's present settings."""

    session: StudySession
    settings: SettingsVersion
    table: StepTable

    @property
    def threshold_mismatch(self) -> str:
        """Reason why the participant's threshold does not apply to this trace; empty where it does."""
        return mismatch(self.settings, self.table.beta_trace)

    @property
    def threshold(self) -> float | None:
        """xi_beta, where it is stated to be in the unit and from the source of this trace."""
        return None if self.threshold_mismatch else self.settings.xi_beta


def session_data(db: Session, session: StudySession, traces: TracesOf | None = None) -> SessionData:
    """Return beta and amplitude of a session, from `traces` where the caller has read those of many sessions at once."""
    settings = session.visit.participant.current_settings
    table = step_table(db, session, settings) if traces is None else laid_out(session, settings, traces)
    return SessionData(session, settings, table)


def qoc_of(session: StudySession) -> Qoc:
    """Convert a session's QoCs for the analyses."""
    row = session.qoc
    return Qoc() if row is None else Qoc(**{o.field: getattr(row, o.field) for o in OUTCOMES})


def failed_qoc_of(sessions: Iterable[StudySession]) -> Qoc:
    """Return what a stopped session of a participant counts as, in buffers, rankings and analyses alike.

    Args:
        sessions: all of the participant. Those count that are confirmed, not excluded, and of no sealed visit.
    """
    return failed_qoc(qoc_of(s) for s in sessions if s.status == "confirmed" and not s.excluded_reason and not s.visit.sealed)


CONTROL_STREAMS = ("beta", "band_power")
"""Streams that can drive a controller, in the order of preference where the participant's source does not decide."""


@dataclass(frozen=True)
class UsableSteps:
    """Steps of one channel of a session.

    Attributes:
        stream, channel, source: of the trace. is_control: whether the controller is taken to have seen it.
        steps: of the session. valid: with a valid beta. usable: that may enter a replay buffer.
        reason: why there are none; None where there are some.
        at: which steps are usable, numbers from 0.
        late_s: seconds of the session before its first whole state, as beta begins too late; 0 where none.
    """

    stream: str
    channel: str
    source: str
    is_control: bool
    steps: int
    valid: int
    usable: int
    reason: str | None
    at: frozenset[int] = frozenset()
    late_s: float = 0.0

    @property
    def why(self) -> str:
        """Explain why there are none, or why learning starts late."""
        return self.reason or late_words(self.late_s)


@dataclass(frozen=True)
class Worth:
    """Steps of a channel that can be learned from: those that are usable where the amplitude is known, and those with a valid beta."""

    usable: int
    valid: int


def worth_of(trace: Trace, settings: SettingsVersion, start_s: float, stop_s: float) -> Worth:
    """Count the steps of a channel within a part of its recording, before there is a session of it; none off the participant's grid."""
    try:
        beta = beta_of_part(trace, settings, start_s, stop_s)
    except Invalid:
        return Worth(0, 0)
    whole = _trajectory(0, 0, beta, np.zeros(beta.size), settings)
    return Worth(int(whole.usable().sum()), int(np.sum(~np.isnan(whole.beta))))


def on_any(found: Sequence[UsableSteps], source: str = "time_domain") -> int:
    """Count steps of a session that are usable on any channel of a source, each counted once.

    More than on any single channel where the device sensed other contacts from one part of the recording to the next. A controller sees one
    channel, so that no buffer holds them together.
    """
    return len(frozenset[int]().union(*(u.at for u in found if u.source == source)))


def usable_steps(db: Session, session: StudySession) -> list[UsableSteps]:
    """Count usable steps of every channel of the control recordings under the participant's present settings, the control channel first.

    A session of several parts of recordings is counted by channel over all of them. Empty where no recording has such a channel.
    """
    settings = session.visit.participant.current_settings
    found: dict[tuple[str, str], UsableSteps] = {}
    for segment in session.segments:
        if not segment.is_control:
            continue
        traces = repository.traces_of_recording(db, segment.recording_id)
        amplitude = driving(session, traces)
        alone = sum(t.stream == AMPLITUDE_STREAM for t in traces) <= 1
        candidates = [t for stream in CONTROL_STREAMS for t in traces if t.stream == stream]
        for trace in candidates:
            control = trace is _control(session, candidates)
            one = _of_channel(session, settings, trace, amplitude, control, alone)
            before = found.get((trace.stream, trace.channel))
            if before is None or one.usable > before.usable:
                found[trace.stream, trace.channel] = one
    return sorted(found.values(), key=lambda u: not u.is_control)


def _control(session: StudySession, candidates: Sequence[Trace]) -> Trace | None:
    named = (t for t in candidates if t.stream == session.control_stream and session.control_channel in (None, t.channel))
    return next(named, None)


def sentence(found: Sequence[UsableSteps]) -> str:
    """Describe the usable steps of a session: the control channel, and the others that have any."""
    if not found:
        return "Usable steps: none, because no recording has a beta amplitude or a band power."
    first, rest = found[0], found[1:]
    said = f"Usable steps: {first.usable} of {first.steps} on {_name(first)}"
    said += f", because {first.reason}" if first.reason else ""
    every = on_any(found)
    if every > max(u.usable for u in found):
        said += f"; {every} on one time-domain channel or another, which were sensed one after another"
    others = [f"{u.usable} on {_name(u)}" for u in rest if u.usable]
    if others:
        said += f"; {', '.join(others)}"
    elif rest:
        said += f"; none on {len(rest)} other channel{'s' if len(rest) > 1 else ''}"
    return f"{said}. {late_words(first.late_s)}".rstrip()


def late_words(late_s: float) -> str:
    """Explain that learning starts within the session, as beta was not recorded early enough before it; empty where it was."""
    if not late_s:
        return ""
    return (
        f"Beta is not recorded long enough before the session for its first state, so learning starts {late_s:g} s into it, with the first "
        "full window of beta."
    )


def late_s(data: SessionData) -> float:
    """Compute the seconds of a session before its first whole state, where beta begins too late; 0 where none."""
    table, settings = data.table, data.settings
    if not np.any(table.t_s > 0):
        return 0.0
    whole = _trajectory(0, 0, table.beta, table.fraction, settings)
    return (whole.steps - whole.from_first_window().steps) * settings.period_s


def _name(u: UsableSteps) -> str:
    return f"{u.stream.replace('_', ' ')} {u.channel}".strip()


def _of_channel(
    session: StudySession, settings: SettingsVersion, trace: Trace, amplitude: Trace | None, is_control: bool, alone: bool
) -> UsableSteps:
    named = (trace.stream, trace.channel, trace.source, is_control)
    try:
        table = shown_table(session, settings, trace, amplitude, alone=alone)
    except Invalid as error:
        return UsableSteps(*named, 0, 0, 0, f"{error.detail} {error.hint}".strip().rstrip("."))
    steps = int(np.sum(table.t_s > 0))
    if steps == 0:
        return UsableSteps(*named, 0, 0, 0, "the session is shorter than one step")
    trajectory = _trajectory(session.id, session.visit.number, table.beta, table.fraction, settings)
    at = frozenset(np.flatnonzero(trajectory.usable()).tolist())
    valid = int(np.sum(~np.isnan(trajectory.beta)))
    why = None if at else _reason(session, trajectory, table, settings, valid)
    late = (trajectory.steps - trajectory.from_first_window().steps) * settings.period_s
    return UsableSteps(*named, steps, valid, len(at), why, at, late)


def _trajectory(
    session_id: int, visit: int, beta: NDArray[np.float64], fraction: NDArray[np.float64], settings: SettingsVersion
) -> SessionTrajectory:
    """Build a trajectory of a session's rows, [W + T] each, as learning would have them."""
    return SessionTrajectory(
        session_id=session_id,
        visit=visit,
        controller="other",
        lead_beta=beta[: settings.window],
        beta=beta[settings.window :],
        amplitude=fraction[settings.window :],
        most_imputed=min(settings.most_imputed, settings.window - 1),
    )


def _reason(session: StudySession, s: SessionTrajectory, table: StepTable, settings: SettingsVersion, valid: int) -> str:
    """Explain why a channel has no usable step, by the first thing that would have to change."""
    if valid == 0:
        return f"none of its steps has a valid beta: measured samples cover less than {100 * settings.min_valid_fraction:g} % of each"
    states = np.asarray(np.isfinite(s.states()).all(axis=1))
    windows = int(np.sum(states[:-1] & states[1:]))
    if windows == 0:
        imputed = f" with at most {s.most_imputed} missing among them" if s.most_imputed else " without a gap"
        return f"its {valid} valid steps are nowhere {settings.window + 1} in a row{imputed}, as a state and its next beta need"
    whole = f"{windows} steps have a whole state, but "
    if table.amplitude_trace is None:
        return whole + "no amplitude was recorded"
    if np.isnan(s.amplitude).all():
        if table.cdbs_ma is None and not np.isnan(table.amplitude_ma).all():
            side, program = table.amplitude_trace.recording.hemisphere or session.hemisphere, amplitude_program(table.amplitude_trace)
            return f"{whole}{cdbs_amplitude.lacking(session.visit, side, settings, program)}, which the amplitude is a fraction of"
        return whole + "the amplitude is not known in any of them"
    return whole + "each of them lacks an amplitude from 0 to the cDBS amplitude"
