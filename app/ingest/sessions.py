"""From recordings to sessions: what belongs together, and which part of which recording it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta

import numpy as np
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.ingest import channels, repository
from app.platform.errors import Conflict, Invalid
from app.study import blinding, cdbs_amplitude
from app.study import repository as study
from app.study.recordings.controller_log import simulated
from app.study.recordings.facts import unknown_clock
from app.study.sessions import designs
from app.study.sessions import repository as session_repository
from app.study.sessions.usable_steps import CONTROL_STREAMS
from app.study.traces import AMPLITUDE_STREAM, pack, unpack
from app.study.visits import require_unlocked
from app.tables.participants import Hemisphere, Participant
from app.tables.recordings import Recording, Trace
from app.tables.sessions import Controller, SessionSegment, StudySession
from app.tables.visits import Visit

TOGETHER = 0.5
"""Two recordings belong to one session when they share at least this part of the shorter one's time."""
LONGEST_STEP_S = 60.0
"""What a device notes less often than this is its history, no session."""


@dataclass(frozen=True)
class StatedSession:
    """Statement of the sender about the sessions in an upload.

    Attributes:
        visit, controller: None where the sender leaves it to the files and to the person who confirms the proposals.
        confirm: whether what is stated counts at once; without a controller and a visit nothing does.
        session: where files without a clock (grasp tests) belong; None: the single session of the upload.
    """

    visit: Visit | None = None
    controller: Controller | None = None
    policy_id: int | None = None
    started_at: datetime | None = None
    hemisphere: Hemisphere | None = None
    confirm: bool = True
    session: StudySession | None = None

    @property
    def counts(self) -> bool:
        """True where the sessions are confirmed as they arrive."""
        return self.confirm and self.controller is not None and self.visit is not None


@dataclass
class Placement:
    """One session's recordings: the one that its controller saw, the part of it, and the others of the same time."""

    control: Recording
    recordings: list[Recording]
    start_s: float
    stop_s: float
    started_at: datetime | None
    stream: str
    channel: str | None
    notes: list[str] = field(default_factory=list)


def makes_session(traces: Sequence[Trace], recording: Recording) -> bool:
    """Decide whether a recording has data of a session: any valid row, on a grid of steps. What the device calls a test or a history is
    none."""
    if recording.details.get("run", 0) is None:
        return False
    return any(t.dt_s <= LONGEST_STEP_S and any(t.valid_bits) for t in traces)


def together(recordings: Sequence[Recording]) -> list[list[Recording]]:
    """Group recordings that belong to one session each, by start; those without a time, or on another device's unknown clock, by run."""
    groups: list[list[Recording]] = []
    for recording in sorted(recordings, key=lambda r: (r.started_at is None, r.started_at, r.id)):
        home = next((g for g in groups if any(_belong(recording, other) for other in g)), None)
        if home is None:
            groups.append([recording])
        else:
            home.append(recording)
    return groups


def _belong(a: Recording, b: Recording) -> bool:
    apart = a.device_id != b.device_id and (unknown_clock(a) or unknown_clock(b))
    if a.started_at is not None and b.started_at is not None and not apart:
        begin = max(a.started_at, b.started_at)
        end = min(a.started_at + timedelta(seconds=a.duration_s), b.started_at + timedelta(seconds=b.duration_s))
        return (end - begin).total_seconds() >= TOGETHER * min(a.duration_s, b.duration_s)
    return a.upload_file_id == b.upload_file_id and a.details.get("run", 0) == b.details.get("run", 0)


def place(db: Session, participant: Participant, recordings: Sequence[Recording], stated: StatedSession, alone: bool) -> Placement:
    """Place a session in its recordings.

    Args:
        recordings: of one session, none of them empty.
        alone: whether the upload has these recordings alone, so that a stated start is theirs where they have none.

    A stated start counts where it is within the recording: a recording's own clock is never overruled, but the notes report it.
    """
    settings = participant.current_settings
    choices = []
    for r in recordings:
        part_s = (offset_s(r, _start(stated, r, alone), settings.period_s), r.duration_s)
        choices.append((channels.of_part(study.traces_of_recording(db, r.id), r, settings, part_s, stated.hemisphere), r))
    # the stated side first, then recordings that a controller could have seen
    choices.sort(key=lambda c: (stated.hemisphere is not None and c[1].hemisphere != stated.hemisphere, c[0] is None))
    trace, control = choices[0]
    started_at = _start(stated, control, alone)
    start_s = offset_s(control, started_at, settings.period_s)
    stream, channel = (trace.stream, trace.channel) if trace else (CONTROL_STREAMS[0], None)
    placement = Placement(control, list(recordings), start_s, control.duration_s, started_at, stream, channel)
    if stated.started_at is not None and started_at is not stated.started_at:
        placement.notes.append(_start_refused(stated.started_at, control))
    return placement


def _start(stated: StatedSession, recording: Recording, alone: bool) -> datetime | None:
    """Choose the start of a session of a recording: as stated where that is within the recording, else with the recording."""
    counts = stated.started_at is not None and _inside(stated.started_at, recording) and (alone or recording.started_at is not None)
    return stated.started_at if counts else recording.started_at


def _start_refused(stated: datetime, control: Recording) -> str:
    if control.started_at is None:
        return "The stated start was not taken: several recordings of this upload tell no time, and one start cannot be that of each."
    end = control.started_at + timedelta(seconds=control.duration_s)
    return (
        f"The stated start {stated:%Y-%m-%d %H:%M:%S} UTC does not lie in this recording ({control.started_at:%Y-%m-%d %H:%M:%S} to "
        f"{end:%H:%M:%S} UTC by its own clock): the recording's own time was taken."
    )


def _inside(moment: datetime, recording: Recording) -> bool:
    return recording.started_at is None or 0 <= (moment - recording.started_at).total_seconds() < recording.duration_s


def offset_s(recording: Recording, started_at: datetime | None, period_s: float) -> float:
    """Compute where a session that starts at `started_at` begins in a recording, seconds, on the recording's grid; what comes before is its
    lead.

    A recording without a time of its own begins with the session, and so does one that does not reach to the stated start.
    """
    if started_at is None or recording.started_at is None:
        return 0.0
    offset = round((started_at - recording.started_at).total_seconds() / period_s) * period_s
    return offset if 0 < offset < recording.duration_s else 0.0


def set_segments(session: StudySession, placement: Placement, period_s: float) -> None:
    """Give a session its parts of its recordings, the same stretch of time in each."""
    session.segments.clear()
    for recording in placement.recordings:
        if recording is placement.control:
            stop_s = max(placement.stop_s, placement.start_s + 1e-3)  # a segment needs a length
            session.segments.append(SessionSegment(recording=recording, start_s=placement.start_s, stop_s=stop_s, is_control=True))
        else:
            add_beside(session, recording, placement, period_s)


def add_beside(session: StudySession, recording: Recording, placement: Placement, period_s: float) -> bool:
    """Give a session its stretch of a recording that its controller did not see; whether the recording holds any of it."""
    start_s = offset_s(recording, placement.started_at, period_s) if placement.started_at else placement.start_s
    ahead = (recording.started_at - placement.started_at).total_seconds() if recording.started_at and placement.started_at else 0.0
    # a recording that begins within the session holds less of it by what it comes too late
    stop_s = min(start_s + (placement.stop_s - placement.start_s) - max(ahead, 0.0), recording.duration_s)
    if stop_s <= start_s:
        return False
    session.segments.append(SessionSegment(recording=recording, start_s=start_s, stop_s=stop_s, is_control=False))
    return True


def add_session(
    db: Session,
    visit: Visit,
    placement: Placement,
    controller: Controller | None,
    policy_id: int | None,
    hemisphere: Hemisphere | None,
    counts: bool,
) -> StudySession:
    """Add a session, confirmed or proposed. Raises Conflict where it would count in a locked visit."""
    if counts:
        require_unlocked(visit)
    session = StudySession(
        visit_id=visit.id,
        ordinal=study.next_ordinal(db, visit.id),
        hemisphere=hemisphere or placement.control.hemisphere,
        status="confirmed" if counts else "proposed",
        started_at=placement.started_at,
        duration_s=placement.stop_s - placement.start_s,
        control_stream=placement.stream,
        control_channel=placement.channel,
    )
    blinding.assign(session, controller, policy_id)
    set_segments(session, placement, visit.participant.current_settings.period_s)
    db.add(session)
    db.flush()
    return session


def fix_milliamperes(db: Session, session: StudySession) -> list[str]:
    """Convert fractions to milliamperes, by the cDBS amplitude in force as the session is confirmed; returns sentences where that fails.

    What was delivered must not change when the cDBS amplitude does. Traces of a recording that an earlier session counts on stay.
    """
    sentences = []
    for recording_id in dict.fromkeys(s.recording_id for s in session.segments):
        given = [t for t in study.traces_of_recording(db, recording_id) if t.stream == AMPLITUDE_STREAM and t.unit == "fraction"]
        if not given or repository.confirmed_sessions_of_recording(db, recording_id, besides=session.id):
            continue
        try:
            cdbs = cdbs_amplitude.of_session(session, session.visit.participant.current_settings)
        except Invalid as error:
            sentences.append(f"Amplitudes are kept as fractions: {error}")
            continue
        if cdbs is None:
            sentences.append("Amplitudes are kept as fractions, because nobody has stated a cDBS amplitude for this participant yet.")
            continue
        for trace in given:
            in_milliamperes(trace, cdbs)
    db.flush()
    return sentences


def in_milliamperes(trace: Trace, cdbs_ma: float) -> None:
    """Turn an amplitude trace of fractions into the milliamperes that they were."""
    values = unpack(trace)
    trace.values_f32, trace.valid_bits = pack((values * cdbs_ma).astype(np.float32), ~np.isnan(values))
    trace.unit = "mA"
    trace.details = {**trace.details, "given_as": "fraction", "cdbs_ma": cdbs_ma}


def refuse_overlap(db: Session, session: StudySession) -> None:
    """Raise Conflict where a confirmed session already counts on the same stretch of a recording, or of its device in another one."""
    designs.refuse(db, session)
    for segment in session.segments:
        for other in repository.segments_of_recording(db, segment.recording_id, besides=session.id):
            shared = min(segment.stop_s, other.stop_s) - max(segment.start_s, other.start_s)
            if other.session.status == "confirmed" and shared > 1e-3:
                raise Conflict(
                    f"{shared:.0f} s of this part already belong to session {other.session_id} "
                    f"({other.start_s:.0f} to {other.stop_s:.0f} s of the recording).",
                    "Choose another part of the recording, or correct that session first.",
                )


def invented(participant: Participant, recordings: Sequence[Recording]) -> bool:
    """Return whether the log of a simulated device is among the recordings of a real participant."""
    return not participant.synthetic and any(simulated(r) for r in recordings)


def count(db: Session, session: StudySession) -> None:
    """Let a session count.

    Raises:
        Invalid: the log of a simulated device, of a real participant. Conflict: another session with the same minutes of its device was let
            count at the same time.
    """
    participant = session.visit.participant
    if invented(participant, [s.recording for s in session.segments]):
        raise Invalid(
            f"Session {session.id} cannot count for {participant.code}, who is a real participant: its log is of a simulated device.",
            "Drop it. Logs of simulations belong to a participant that was enrolled as synthetic.",
        )
    session.status = "confirmed"
    try:
        db.flush()
    except IntegrityError as error:
        if "counted_time_once" not in str(error.orig):
            raise
        number = session.id
        db.rollback()
        raise Conflict(
            f"Another person confirmed a session with the same minutes of this device as session {number} at the same time.",
            "Load the page again: it names the other session.",
        ) from error


def counted_minutes(db: Session, placement: Placement) -> bool:
    """Decide whether a session that counts has the minutes of a placement already, of the same device in another recording."""
    began = placement.control.started_at
    if began is None:
        return False
    begin, end = (began + timedelta(seconds=s) for s in (placement.start_s, placement.stop_s))
    return any(one.counts for one in session_repository.same_minutes(db, placement.control, begin, end, besides=None))


def disagreements(db: Session, session_ids: Sequence[int], stated: StatedSession) -> list[str]:
    """List sentences where known sessions are not what the sender now states about them."""
    found = []
    for session_id in dict.fromkeys(session_ids):
        session = study.session(db, session_id, SYSTEM)
        arm = blinding.stated_arm(session, SYSTEM)
        controller, policy_id = (arm.controller, arm.policy_id) if arm else (None, None)
        differs = []
        if stated.visit is not None and session.visit_id != stated.visit.id:
            differs.append(f"it stands in visit {session.visit.number}, not {stated.visit.number}")
        told = not session.visit.sealed
        if told and stated.controller is not None and controller != stated.controller:
            differs.append(f"its controller is {controller or 'still open'}, not {stated.controller}")
        if told and stated.policy_id is not None and policy_id != stated.policy_id:
            differs.append(f"its policy is {policy_id or 'none'}, not {stated.policy_id}")
        if stated.hemisphere is not None and session.hemisphere != stated.hemisphere:
            differs.append(f"it is controlled on the {session.hemisphere or 'unknown'} side, not the {stated.hemisphere}")
        if differs:
            where = "among the proposals" if session.status == "proposed" else "on its page"
            found.append(f"Session {session_id} was not changed: {'; '.join(differs)}. Correct it {where} if it is wrong there.")
    return found
