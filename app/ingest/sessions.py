"""From decoded recordings to rows: devices, recordings, traces, and the session that a person stated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.policy import SYSTEM
from app.ingest import repository
from app.ingest.formats.log import DECODE_VERSION, RecordingLog, TraceLog
from app.ingest.formats.redact import pseudonym
from app.ingest.models import UploadFile
from app.platform.errors import Invalid
from app.platform.schemas import sensible_time
from app.settings import get_settings
from app.study import blinding
from app.study import repository as study
from app.study.models import Controller, Device, Hemisphere, Participant, Recording, SessionSegment, StudySession, Trace, Visit
from app.study.traces import AMPLITUDE_STREAM, cdbs_in_force, pack, step_table

CONTROL_STREAMS = ("beta", "band_power")
"""Streams that can drive a controller, in the order of preference where the participant's source does not decide."""


@dataclass(frozen=True)
class StatedSession:
    """What the sender says of the session that the files belong to."""

    visit: Visit
    controller: Controller
    policy_id: int | None = None
    started_at: datetime | None = None
    hemisphere: Hemisphere | None = None


@dataclass(frozen=True)
class Stored:
    """What became of the recordings of a file.

    Attributes:
        session_ids: sessions that the file belongs to. known: all of its recordings had come before.
        notes, flagged: sentences for the report.
    """

    session_ids: list[int]
    known: bool
    notes: list[str]
    flagged: list[str]


def store_recordings(
    db: Session, participant: Participant, file: UploadFile, recordings: Sequence[RecordingLog], stated: StatedSession
) -> Stored:
    """Store what a file gave and make its session.

    The recordings of one file (the two implants of one participant) belong to one session. A recording that is known by its content,
    from another file, keeps the sessions it has. A recording without any data is kept and makes no session.
    """
    known_ids: list[int] = []
    notes: list[str] = []
    flagged: list[str] = []
    fresh: list[tuple[Recording, RecordingLog]] = []
    for decoded in recordings:
        known = study.recording_by_fingerprint(db, participant.id, decoded.fingerprint)
        if known is not None:
            known_ids.extend(study.session_ids_of_recording(db, known.id))
        else:
            kept, flags = _in_milliamperes(decoded, participant, stated)
            fresh.append((_add_recording(db, participant, file, kept), kept))
            flagged.extend(flags)
    if known_ids:
        notes.append(f"The same recording came before in another file; it stays session {', '.join(map(str, sorted(set(known_ids))))}.")
        flagged.extend(disagreements(db, known_ids, stated))
    with_data = [(r, log) for r, log in fresh if any(t.valid.any() for t in log.traces)]
    if fresh and not with_data:
        flagged.append("It holds no data: the recording is kept, and no session was made.")
    if not with_data:
        return Stored(sorted(set(known_ids)), bool(known_ids) and not fresh, notes, flagged)
    session = _add_session(db, participant, fresh, stated)
    control = next(s.recording for s in session.segments if s.is_control)
    notes.append(_session_sentence(session, control, stated))
    flagged.extend(contradictions(db, participant, session, stated))
    return Stored(sorted({*known_ids, session.id}), False, notes, flagged)


def contradictions(db: Session, participant: Participant, session: StudySession, stated: StatedSession) -> list[str]:
    """Sentences where the amplitudes of a session are not those of the controller that it is said to have had."""
    try:
        table = step_table(db, session, participant.current_settings)
    except Invalid as error:
        return [str(error)]
    inside = table.fraction[table.t_s > 0]
    known = inside[~np.isnan(inside)]
    found = []
    if table.above_one:
        found.append(
            f"{table.above_one} of {inside.size} steps lie above the cDBS amplitude of {table.cdbs_ma or float('nan'):g} mA; "
            "they are kept as they are and stay out of replay buffers."
        )
    mean = float(known.mean()) if known.size else None
    if mean is not None and stated.controller == Controller.CDBS and not 0.9 <= mean <= 1.1:
        found.append(f"Said to be cDBS, but its mean amplitude is {100 * mean:.0f} % of the cDBS amplitude. Correct one of them.")
    if mean is not None and stated.controller == Controller.NO_DBS and mean > 0.05:
        found.append(f"Said to be without DBS, but its mean amplitude is {100 * mean:.0f} % of the cDBS amplitude. Correct one of them.")
    if stated.controller in (Controller.RL, Controller.DISTILLED) and stated.policy_id is None:
        found.append("No policy is named for this session: it cannot be compared with its estimate. Name one on the session's page.")
    return found


def _in_milliamperes(decoded: RecordingLog, participant: Participant, stated: StatedSession) -> tuple[RecordingLog, list[str]]:
    """Fractions as the milliamperes they were, by the cDBS amplitude in force now: what was delivered must not change when that does."""
    if not any(t.stream == AMPLITUDE_STREAM and t.unit == "fraction" for t in decoded.traces):
        return decoded, []
    hemisphere = stated.hemisphere or (Hemisphere(decoded.hemisphere) if decoded.hemisphere else None)
    try:
        cdbs = cdbs_in_force(stated.visit, hemisphere, participant.current_settings)
    except Invalid as error:
        return decoded, [f"Amplitudes are kept as fractions: {error}"]
    if cdbs is None:
        return decoded, ["Amplitudes are kept as fractions, because nobody has stated a cDBS amplitude for this participant yet."]
    traces = tuple(
        replace(t, unit="mA", values=(t.values * cdbs).astype(np.float32), details={**t.details, "given_as": "fraction", "cdbs_ma": cdbs})
        if t.stream == AMPLITUDE_STREAM and t.unit == "fraction"
        else t
        for t in decoded.traces
    )
    return replace(decoded, traces=traces), []


def disagreements(db: Session, session_ids: Sequence[int], stated: StatedSession) -> list[str]:
    """Sentences where known sessions are not what the sender now says of them."""
    found = []
    for session_id in dict.fromkeys(session_ids):
        session = study.session(db, session_id, SYSTEM)
        arm = blinding.arm(session, SYSTEM)
        differs = []
        if session.visit_id != stated.visit.id:
            differs.append(f"it stands in visit {session.visit.number}, not {stated.visit.number}")
        if arm.controller != stated.controller:
            differs.append(f"its controller is {arm.controller}, not {stated.controller}")
        if stated.policy_id is not None and arm.policy_id != stated.policy_id:
            differs.append(f"its policy is {arm.policy_id or 'none'}, not {stated.policy_id}")
        if differs:
            found.append(f"Session {session_id} was not changed: {'; '.join(differs)}. Correct it on its page if it is wrong there.")
    return found


def _add_recording(db: Session, participant: Participant, file: UploadFile, decoded: RecordingLog) -> Recording:
    recording = Recording(
        participant_id=participant.id,
        device_id=_device(db, participant, decoded).id,
        upload_file_id=file.id,
        fingerprint=decoded.fingerprint,
        hemisphere=decoded.hemisphere,
        clock=decoded.clock,
        started_at=_known_time(decoded.started_at),
        duration_s=decoded.duration_s,
        details=_json(
            {
                "kind": decoded.kind,
                "events": [asdict(e) for e in decoded.events],
                "limits": dict(decoded.limits),
                "settings": dict(decoded.settings),
                "quality": dict(decoded.quality),
            }
        ),
    )
    db.add(recording)
    db.flush()
    db.add_all(_trace(recording.id, t) for t in decoded.traces)
    db.flush()
    return recording


def _device(db: Session, participant: Participant, decoded: RecordingLog) -> Device:
    name = pseudonym(decoded.device_key, get_settings().secret("pseudonyms")) if decoded.device_key else decoded.kind
    device = repository.device(db, participant.id, name)
    if device is None:
        device = Device(participant_id=participant.id, pseudonym=name, kind=decoded.kind, hemisphere=decoded.hemisphere)
        db.add(device)
        db.flush()
    return device


def _trace(recording_id: int, trace: TraceLog) -> Trace:
    values, valid = pack(trace.values, trace.valid)
    return Trace(
        recording_id=recording_id,
        decode_version=DECODE_VERSION,
        stream=trace.stream,
        channel=trace.channel,
        unit=trace.unit,
        source=trace.source,
        dt_s=trace.dt_s,
        first_end_s=trace.t_end_first_s,
        n=trace.values.size,
        values_f32=values,
        valid_bits=valid,
        details=_json(dict(trace.details)),
    )


def _add_session(
    db: Session, participant: Participant, fresh: Sequence[tuple[Recording, RecordingLog]], stated: StatedSession
) -> StudySession:
    wanted_source = participant.current_settings.beta_source
    choices = [(_control(log, wanted_source), recording, log) for recording, log in fresh]
    control, recording, log = next((c for c in choices if c[0] is not None), choices[0])
    started_at = stated.started_at or _known_time(log.started_at)
    offset_s = _offset_s(log, started_at, participant.current_settings.period_s)
    session = StudySession(
        visit_id=stated.visit.id,
        ordinal=study.next_ordinal(db, stated.visit.id),
        hemisphere=stated.hemisphere or recording.hemisphere,
        started_at=started_at,
        duration_s=log.duration_s - offset_s,
        control_stream=control.stream if control else CONTROL_STREAMS[0],
        control_channel=control.channel if control else None,
    )
    blinding.assign(session, stated.controller, stated.policy_id)
    for other, other_log in fresh:
        start_s = _offset_s(other_log, started_at, participant.current_settings.period_s)
        # a recording without data still says what was there; a segment needs a length
        stop_s = max(other_log.duration_s, start_s + 1e-3)
        session.segments.append(SessionSegment(recording=other, start_s=start_s, stop_s=stop_s, is_control=other is recording))
    db.add(session)
    db.flush()
    return session


def _known_time(value: datetime | None) -> datetime | None:
    """A recording's own time, where its clock was set at all."""
    try:
        return sensible_time(value) if value is not None else None
    except ValueError:
        return None


def _offset_s(log: RecordingLog, started_at: datetime | None, period_s: float) -> float:
    """Where a session that starts at `started_at` begins in a recording, seconds, on the recording's grid; what comes before is its lead.

    A recording without a time of its own begins with the session, and so does one that does not reach to the stated start.
    """
    if started_at is None or log.started_at is None:
        return 0.0
    offset = round((started_at - log.started_at).total_seconds() / period_s) * period_s
    return offset if 0 < offset < log.duration_s else 0.0


def _control(decoded: RecordingLog, wanted_source: str | None) -> TraceLog | None:
    """The trace that the controller is taken to have seen: of the participant's source where there is one, else the first stream's."""
    candidates = [t for stream in CONTROL_STREAMS for t in decoded.traces if t.stream == stream and t.valid.any()]
    return next((t for t in candidates if t.source == wanted_source), candidates[0] if candidates else None)


def _session_sentence(session: StudySession, control: Recording, stated: StatedSession) -> str:
    length = f"{session.duration_s / 60:.1f} min" if session.duration_s else "no data"
    channel = f"controlled by {session.control_stream} {session.control_channel or ''}".strip()
    return f"Session {session.id}: visit {stated.visit.number}, {stated.controller}, {length}, {channel} (recording {control.id})."


def _json(value: Any) -> Any:
    """Plain JSON: NaN and infinity, which PostgreSQL's JSONB refuses, become null; times become ISO text."""
    if isinstance(value, dict):
        return {str(k): _json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_json(v) for v in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, datetime):
        return value.isoformat()
    if hasattr(value, "tolist"):
        return _json(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value)
