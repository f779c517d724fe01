"""From decoded recordings to rows: devices, recordings and their traces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any

from sqlalchemy.orm import Session

from app.ingest import repository, wording
from app.ingest.proposals import copies
from app.platform.database import acting
from app.platform.web.schemas import sensible_time
from app.settings import get_settings
from app.study import repository as study
from app.study.traces import pack
from app.tables.participants import Participant
from app.tables.recordings import Device, Recording, Trace
from app.tables.uploads import UploadFile
from ml.formats import DECODE_VERSION, RecordingLog, TraceLog, pseudonym


@dataclass
class Stored:
    """The recordings of a file: those that are new, and those that had come before in another file; sentences on copies of either."""

    fresh: list[Recording] = field(default_factory=list)
    known: list[Recording] = field(default_factory=list)
    understood: list[str] = field(default_factory=list)
    flagged: list[str] = field(default_factory=list)


def store(db: Session, participant: Participant, file: UploadFile, decoded: Sequence[RecordingLog]) -> Stored:
    """Store what a file gave. A recording that is known by its content, or whose minutes are stored more fully, is not stored again."""
    stored = Stored()
    for one in decoded:
        known = study.recording_by_fingerprint(db, participant.id, one.fingerprint)
        if known is not None:
            stored.known += repository.fullest(db, [known])
            continue
        with db.no_autoflush:
            row = _row(db, participant, file, one)
            verdict = copies.judge(db, row, one.traces)
        if verdict.copy_of is not None:
            stored.known.append(verdict.copy_of)
            stored.understood.append(wording.no_more_than(verdict.copy_of))
            continue
        fresh = _add(db, row, one)
        stored.fresh.append(fresh)
        for old in verdict.fuller_than:
            moved = copies.supersede(db, old, fresh, verdict.alone, acting(db))
            stored.flagged.append(wording.fuller_than(old, moved))
        for old in verdict.locked:
            stored.flagged.append(wording.locked_copy(fresh, old, [s.id for s in copies.sessions_of(db, old) if s.visit.locked]))
        stored.flagged += [wording.beside(fresh, other) for other in verdict.beside]
    return stored


def add(db: Session, participant: Participant, file: UploadFile, decoded: RecordingLog) -> Recording:
    """Add a recording with its traces."""
    return _add(db, _row(db, participant, file, decoded), decoded)


def _row(db: Session, participant: Participant, file: UploadFile, decoded: RecordingLog) -> Recording:
    """Make the row of a recording that is not in the database yet."""
    return Recording(
        participant_id=participant.id,
        device_id=_device(db, participant, decoded).id,
        upload_file_id=file.id,
        fingerprint=decoded.fingerprint,
        hemisphere=decoded.hemisphere,
        clock=decoded.clock,
        started_at=known_time(decoded.started_at),
        duration_s=decoded.duration_s,
        details=details(decoded),
    )


def _add(db: Session, recording: Recording, decoded: RecordingLog) -> Recording:
    db.add(recording)
    db.flush()
    db.add_all(trace_row(recording.id, t) for t in decoded.traces)
    db.flush()
    return recording


def details(decoded: RecordingLog) -> dict[str, Any]:
    """Collect what a recording has in addition to its traces, as plain JSON."""
    found: dict[str, Any] = as_json(
        {
            "kind": decoded.kind,
            "decode_version": DECODE_VERSION,
            "events": [asdict(e) for e in decoded.events],
            "limits": dict(decoded.limits),
            "settings": dict(decoded.settings),
            "quality": dict(decoded.quality),
            "run": decoded.run,
            "spectra": [asdict(s) for s in decoded.spectra],
        }
    )
    return found


def trace_row(recording_id: int, trace: TraceLog) -> Trace:
    """Make the row of a trace under the present decode version."""
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
        details=as_json(dict(trace.details)),
    )


def known_time(value: datetime | None) -> datetime | None:
    """Return a recording's own time, where its clock was set at all."""
    try:
        return sensible_time(value) if value is not None else None
    except ValueError:
        return None


def as_json(value: Any) -> Any:
    """Convert to plain JSON: NaN and infinity, which PostgreSQL's JSONB refuses, become null; times become ISO text."""
    if isinstance(value, dict):
        return {str(k): as_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [as_json(v) for v in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, datetime):
        return value.isoformat()
    if hasattr(value, "tolist"):
        return as_json(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value)


def _device(db: Session, participant: Participant, decoded: RecordingLog) -> Device:
    name = pseudonym(decoded.device_key, get_settings().secret("pseudonyms")) if decoded.device_key else decoded.kind
    device = repository.device(db, participant.id, name)
    if device is None:
        device = Device(participant_id=participant.id, pseudonym=name, kind=decoded.kind)
        db.add(device)
        db.flush()
    return device
