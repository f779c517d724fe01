"""How many steps of a session can be learned from, per channel that could have driven its controller, and why where there are none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.platform.errors import Invalid
from app.study import repository
from app.study.sessions.repository import SlotHead, slot_head
from app.study.settings import mismatch
from app.study.traces import AMPLITUDE_STREAM, StepTable, TracesOf, beta_of_part, driving, laid_out, shown_table, step_table
from app.tables.participants import SettingsVersion
from app.tables.recordings import Recording, Trace
from app.tables.sessions import Controller, StudySession
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
        """Why the participant's threshold says nothing about this trace; empty where it does."""
        return mismatch(self.settings, self.table.beta_trace)

    @property
    def threshold(self) -> float | None:
        """xi_beta, where it is stated to be in the unit and from the source of this trace."""
        return None if self.threshold_mismatch else self.settings.xi_beta


def session_data(db: Session, session: StudySession, traces: TracesOf | None = None) -> SessionData:
    """Beta and amplitude of a session, from `traces` where the caller has read those of many sessions at once."""
    settings = session.visit.participant.current_settings
    table = step_table(db, session, settings) if traces is None else laid_out(session, settings, traces)
    return SessionData(session, settings, table)


def qoc_of(session: StudySession) -> Qoc:
    """A session's QoCs as the science knows them."""
    row = session.qoc
    return Qoc() if row is None else Qoc(**{o.field: getattr(row, o.field) for o in OUTCOMES})


def failed_qoc_of(sessions: Iterable[StudySession]) -> Qoc:
    """Return what a stopped session of a participant counts as, in buffers, rankings and analyses alike.

    Args:
        sessions: all of the participant. Those count that are confirmed, not excluded, and of no sealed visit.
    """
    return failed_qoc(qoc_of(s) for s in sessions if s.status == "confirmed" and not s.excluded_reason and not s.visit.sealed)


# What the log of a controller says of its session: which policy decided, within which limits, and for which slot of a signed plan.

LEAST_SHARE = 0.7
"""Share of decisions by its policy or schedule below which a session counts for none; ours, as the least coverage of a step."""
CONTROLLER_OF_KIND = {"distilled": Controller.DISTILLED, "baseline": Controller.OTHER}
"""Controllers of policies by their kind; those of every other kind are RL."""


@dataclass(frozen=True)
class Logged:
    """What ran, by the controller's own log.

    Attributes:
        policy_id, policy_name, controller: of the participant's policy with the logged network; None where the participant has none.
        number: of the policy in the installation that made the bundle.
        min_ma, max_ma, cdbs_ma: of the bundle.
    """

    policy_id: int | None
    policy_name: str | None
    controller: Controller | None
    number: int
    min_ma: float
    max_ma: float
    cdbs_ma: float


def of_recording(db: Session, recording: Recording) -> Logged | None:
    """What a recording says of its controller; None where it is no log, or a log that does not tell."""
    said = limits_and_policy(recording)
    if said is None or said["network_sha256"] is None:  # a schedule has no policy
        return None
    same = repository.policies_of_network(db, recording.participant_id, said["network_sha256"])
    policy = next((p for p in same if p.id == said["policy_id"]), same[0] if same else None)
    return Logged(
        policy_id=policy.id if policy else None,
        policy_name=policy.name if policy else None,
        controller=CONTROLLER_OF_KIND.get(policy.kind, Controller.RL) if policy else None,
        number=said["policy_id"],
        min_ma=said["min_ma"],
        max_ma=said["max_ma"],
        cdbs_ma=said["cdbs_ma"],
    )


def limits_and_policy(recording: Recording) -> Mapping[str, Any] | None:
    """What stands at the head of a log (`ml.formats.tables.log_head.Ran`); None as in `of_recording`."""
    said = recording.details.get("settings", {}).get("controller")
    return said if isinstance(said, Mapping) else None


@dataclass(frozen=True)
class LoggedSlot:
    """The session of a signed plan that a log says it is of.

    Attributes:
        slot_id, plan_id, position, visit_number, visit_date (ISO 8601): as they stood when the bundle was made.
        planned: the session of the plan as it stands; None where this participant has none such.
    """

    slot_id: int
    plan_id: int
    position: int
    visit_number: int
    visit_date: str
    planned: SlotHead | None


def slot_of_recording(db: Session, recording: Recording) -> LoggedSlot | None:
    """The slot that a recording ran in; None where it is no log, and of trials on a bench and replays, at which nobody was connected."""
    said = limits_and_policy(recording)
    if said is None or said.get("purpose") != "session" or said.get("slot_id") is None:
        return None
    head = slot_head(db, recording.participant_id, int(said["slot_id"]))
    # numbers of another installation may be anything: plan, place and slot must belong together
    planned = head if head is not None and (head.plan_id, head.position) == (said["plan_id"], said["position"]) else None
    return LoggedSlot(
        int(said["slot_id"]), int(said["plan_id"]), int(said["position"]), int(said["visit_number"]), str(said["visit_date"]), planned
    )


def policy_share(recording: Recording) -> float | None:
    """Return the share of a session's decisions that followed its policy or schedule; None without a session's log."""
    said = limits_and_policy(recording)
    if said is None or said.get("purpose") != "session" or said.get("policy_share") is None:
        return None
    return float(said["policy_share"])


def rehearsed(recording: Recording) -> bool:
    """Whether a log is of a trial on a bench: a controller ran, and no participant was connected."""
    said = limits_and_policy(recording)
    return said is not None and said.get("purpose") == "bench"


def simulated(recording: Recording) -> bool:
    """Whether the device side of a log was a simulation."""
    said = limits_and_policy(recording)
    return said is not None and bool(said.get("simulated"))


def design_of_session(session: StudySession) -> dict[str, Any] | None:
    """How a random session's amplitudes were drawn, by the log of the schedule that ran, as members of its conditions.

    None where no such log is its control recording, or where the session does not begin where the schedule took over.
    """
    control = next((s for s in session.segments if s.is_control), None)
    said = limits_and_policy(control.recording) if control is not None else None
    if control is None or said is None or said.get("design") is None or not said.get("holds") or control.start_s > 1e-3:
        return None
    parameters = {"level": said.get("level"), "holds": said["holds"]}
    known = {"design": said["design"], "seed": said.get("seed"), "design_parameters": parameters}
    return known | ({"lower_bound": said["lower_bound"]} if said.get("lower_bound") is not None else {})


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


@dataclass(frozen=True)
class Worth:
    """What a channel's beta alone can teach: steps that are usable where the amplitude is known, and steps with a valid beta."""

    usable: int
    valid: int


def worth_of(trace: Trace, settings: SettingsVersion, start_s: float, stop_s: float) -> Worth:
    """What a channel can teach within a part of its recording, before there is a session of it; nothing off the participant's grid."""
    try:
        beta = beta_of_part(trace, settings, start_s, stop_s)
    except Invalid:
        return Worth(0, 0)
    whole = _trajectory(0, 0, beta, np.zeros(beta.size), settings)
    return Worth(int(whole.usable().sum()), int(np.sum(~np.isnan(whole.beta))))


def on_any(found: Sequence[UsableSteps], source: str = "time_domain") -> int:
    """Steps of a session that are usable on one channel of a source or another, each counted once.

    More than on any single channel where the device sensed other contacts from one part of the recording to the next. A controller sees one
    channel, so that no buffer holds them together.
    """
    return len(frozenset[int]().union(*(u.at for u in found if u.source == source)))


def usable_steps(db: Session, session: StudySession) -> list[UsableSteps]:
    """Usable steps of every channel of the control recordings under the participant's present settings, the control channel first.

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
    """Usable steps of a session in words: the control channel, and the others that have any."""
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
    return said + "."


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
    return UsableSteps(*named, steps, valid, len(at), None if at else _reason(trajectory, table, settings, valid), at)


def _trajectory(
    session_id: int, visit: int, beta: NDArray[np.float64], fraction: NDArray[np.float64], settings: SettingsVersion
) -> SessionTrajectory:
    """A session's rows, [W + T] each, as learning would have them."""
    return SessionTrajectory(
        session_id=session_id,
        visit=visit,
        controller="other",
        lead_beta=beta[: settings.window],
        beta=beta[settings.window :],
        amplitude=fraction[settings.window :],
        most_imputed=min(settings.most_imputed, settings.window - 1),
    )


def _reason(s: SessionTrajectory, table: StepTable, settings: SettingsVersion, valid: int) -> str:
    """Why a channel has no usable step, the first thing that would have to change."""
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
            return whole + "nobody has stated the cDBS amplitude, which the amplitude is a fraction of"
        return whole + "the amplitude is not known in any of them"
    return whole + "each of them lacks an amplitude from 0 to the cDBS amplitude"
