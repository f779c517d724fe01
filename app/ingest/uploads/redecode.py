"""`betaloop ingest redecode`: read every stored file again with the present decoder, and add the result to what there was.

Traces are added under the new decode version and never replaced. Sessions use the newest version from then on; buffer snapshots keep the
traces that they pin.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
import structlog
from sqlalchemy.orm import Session

from app.ingest import repository
from app.ingest.proposals import clocks
from app.ingest.proposals.clocks import MOVED_S
from app.ingest.sessions import in_milliamperes
from app.ingest.stated_beta import name_beta, options_of_file, stated_beta
from app.ingest.uploads import outcomes as outcomes_intake
from app.ingest.uploads import reading, recordings
from app.ingest.uploads.reading import ReaderFault
from app.ingest.uploads.receiving import TABLES
from app.platform import files
from app.platform.database import transaction
from app.platform.errors import Conflict, NotFound
from app.platform.jobs.children.child import places
from app.study import repository as study
from app.study.recordings import amplitude_sources
from app.study.traces import AMPLITUDE_STREAM, unpack
from app.tables.participants import Participant
from app.tables.recordings import Recording, Trace
from app.tables.sessions import StudySession
from app.tables.uploads import UploadFile
from ml.formats import DECODE_VERSION, OUTCOME_TABLES, DecodedFile, RecordingLog, UndecodableFile

log = structlog.get_logger()


class Refused(Exception):
    """The present decoder's recording cannot take the place of the stored one without moving or losing data of sessions."""


@dataclass
class Change:
    """Result of reading a file again.

    Attributes:
        state: `up to date`, `read again`, or `failed` (then nothing of the file was changed).
        `said`: what changed, or why it failed.
        sessions: whose time or dose changed, a sentence each.
    """

    upload_file_id: int
    participant: str
    kind: str
    state: str
    said: list[str] = field(default_factory=list)
    sessions: list[str] = field(default_factory=list)


def redecode(participant_id: int | None, upload_file_id: int | None, dry_run: bool, actor: str) -> Iterator[Change]:
    """Read files again, each in a transaction of its own, so that a fault in one leaves the others alone; yields as it goes.

    Args:
        participant_id, upload_file_id: only these; all where None.
        dry_run: report what would change, and change nothing.
        actor: name for the audit trail.

    Raises:
        NotFound: the named file does not exist or was never decoded.
    """
    with transaction(actor) as db:
        ids = repository.readable_files(db, participant_id, upload_file_id)
    if upload_file_id is not None and not ids:
        raise NotFound(f"There is no decoded file {upload_file_id}.", "See the numbers on the page of an upload.")
    for file_id in ids:
        with transaction(actor) as db:
            file = db.get_one(UploadFile, file_id)
            participant = db.get_one(Participant, file.participant_id)
            change = Change(file_id, participant.code, file.kind, "read again")
            try:
                with db.begin_nested() as savepoint:
                    repository.lock_participant(db, participant.id)
                    change.said, change.sessions = read_again(db, file, participant, actor)
                    if dry_run:
                        savepoint.rollback()
                if not change.said:
                    change.state = "up to date"
            except (UndecodableFile, Refused, Conflict, files.MissingFile) as error:
                change.state, change.said, change.sessions = "failed", [str(error)], []
            except Exception as fault:
                # a fault of ours in one file must not keep the others at the old version
                where = fault.places if isinstance(fault, ReaderFault) else places(fault)
                log.error("redecoding failed", upload_file=file_id, places=where)
                change.state, change.said = "failed", [f"fault in the decoder: {where.split()[-1]}, see the log"]
        yield change


def read_again(db: Session, file: UploadFile, participant: Participant, actor: str) -> tuple[list[str], list[str]]:
    """Read a file again; what changed, and the sessions whose time or dose did."""
    known = [*repository.recordings_of_file(db, file.id)]
    outcomes_only = any(file.kind == one.kind for one in OUTCOME_TABLES)
    meanings = repository.meanings_in_force(db, participant.site.study_id)
    old = [r for r in known if _version(db, r) < DECODE_VERSION or explained_otherwise(r, meanings)]
    if not outcomes_only and not old:
        return [], []
    decoded = _decoded(db, file, participant)
    if outcomes_only:
        return _outcomes_again(db, file, decoded), []
    said, dosed = [], []
    starts: dict[Recording, datetime] = {}
    pairs, added = _matched(known, decoded.recordings)
    for recording, fresh in pairs:
        if recording in old:
            fresh = clocks.keep_stated(recording, fresh)
            renewed, doses = _renew(db, recording, fresh)
            said.append(renewed)
            dosed += doses
            began = recordings.known_time(fresh.started_at)
            if began is not None and (recording.started_at is None or abs((began - recording.started_at).total_seconds()) > MOVED_S):
                starts[recording] = began
    for fresh in added:
        other = study.recording_by_fingerprint(db, participant.id, fresh.fingerprint)
        if other is None:
            row = recordings.add(db, participant, file, fresh)
            said.append(f"recording {row.id} is new; send the file again to have its session proposed")
    for lost in [r for r in known if r not in {p[0] for p in pairs}]:
        raise Refused(f"the present decoder no longer finds recording {lost.id} in the file")
    why = f"decode version {DECODE_VERSION} reads another start"
    timed = clocks.move(db, starts, actor, why, lambda r: _version(db, r) >= DECODE_VERSION) if starts else []
    if decoded.outcomes and not outcomes_only:
        said += _outcomes_again(db, file, decoded)
    return said, [*timed, *dosed]


def _decoded(db: Session, file: UploadFile, participant: Participant) -> DecodedFile:
    """Decode the stored file with the present decoder, with what its sender had stated of it."""
    assert file.stored_sha256 is not None
    path = files.path_of(file.stored_sha256)
    if not path.exists() or files.hash_file(path)[0] != file.stored_sha256:
        raise files.MissingFile(f"The stored file {file.stored_sha256} is missing or damaged.")
    decoded = reading.decode(path, file.kind, options_of_file(db, file, participant), file.name)
    return name_beta(decoded, stated_beta(db, file), participant.current_settings) if file.kind in TABLES else decoded


def _outcomes_again(db: Session, file: UploadFile, decoded: DecodedFile) -> list[str]:
    """Read the outcomes of a file again; returns what changed, or nothing where all is unchanged."""
    before = outcomes_intake.stored_of(db, file)
    said = outcomes_intake.take_clocked(db, file, decoded.outcomes)
    if file.session_id is not None:
        said += outcomes_intake.take_of_session(db, file, decoded.outcomes, db.get_one(StudySession, file.session_id))
    return said if outcomes_intake.stored_of(db, file) != before else []


def explained_otherwise(recording: Recording, meanings: Mapping[str, Mapping[str, Any]]) -> bool:
    """Decide whether markers or channels of a recording have another meaning in its study than it was read by."""
    quality = recording.details.get("quality", {})
    used = quality.get("meanings", {})
    keys = {*used, *(q["key"] for q in quality.get("questions", ()))}
    return any(meanings.get(key) != used.get(key) for key in keys)


def _version(db: Session, recording: Recording) -> int:
    """Find the newest decode version of a recording."""
    traces = study.traces_of_recording(db, recording.id)
    return max([t.decode_version for t in traces] or [int(recording.details.get("decode_version", 0))])


def _matched(
    known: Sequence[Recording], decoded: Sequence[RecordingLog]
) -> tuple[list[tuple[Recording, RecordingLog]], list[RecordingLog]]:
    """Match stored recordings with their present decoding, by content, else by device, side and start; also return new recordings."""
    pairs: list[tuple[Recording, RecordingLog]] = []
    left, rest = list(known), list(decoded)
    for same in (lambda r, d: r.fingerprint == d.fingerprint, _same_stretch):
        for fresh in list(rest):
            found = [r for r in left if same(r, fresh)]
            if len(found) == 1:
                pairs.append((found[0], fresh))
                left.remove(found[0])
                rest.remove(fresh)
    return pairs, rest


def _same_stretch(recording: Recording, fresh: RecordingLog) -> bool:
    began = recordings.known_time(fresh.started_at)
    if (recording.hemisphere, recording.details.get("kind")) != (fresh.hemisphere, fresh.kind):
        return False
    if recording.started_at is None or began is None:
        return recording.started_at is None and began is None
    ahead_s = fresh.settings.get("clock", {}).get("ahead_s") or 0.0
    apart_s = (recording.started_at - began).total_seconds()
    return min(abs(apart_s), abs(apart_s - ahead_s)) < 60  # an earlier version took the dates as the clock showed them


def _renew(db: Session, recording: Recording, fresh: RecordingLog) -> tuple[str, list[str]]:
    """Add the traces of the present version to a recording; a sentence on what differs, and one per session whose dose does.

    Raises:
        Refused: sessions would lose their control trace.
    """
    before = {(t.stream, t.channel): t for t in study.traces_of_recording(db, recording.id)}
    session_ids = sorted(study.session_ids_of_recording(db, recording.id))
    rows = [recordings.trace_row(recording.id, t) for t in fresh.traces]
    same = [t.reading for t in before.values() if t.decode_version == DECODE_VERSION]
    for row in rows:
        row.reading = max(same, default=0) + 1
    after = {(t.stream, t.channel): t for t in rows}
    for session in (db.get_one(StudySession, i) for i in session_ids):
        _refuse_loss(session, recording, before, after)
    for key, row in after.items():
        fixed = before[key].details.get("cdbs_ma") if key in before else None
        if row.stream == AMPLITUDE_STREAM and row.unit == "fraction" and fixed is not None:
            in_milliamperes(row, float(fixed))  # what was delivered does not change with today's settings
    found = amplitude_sources.keep_choice(recording.details, recordings.details(fresh), rows)
    db.add_all(rows)
    recording.fingerprint, recording.duration_s = fresh.fingerprint, fresh.duration_s
    recording.details = found
    db.flush()
    differences = [_difference(key, before.get(key), after.get(key)) for key in sorted({*before, *after})]
    listed = "; ".join(d for d in differences if d) or "the same numbers"
    old = max((t.decode_version for t in before.values()), default=0)
    used = f" (session{'s' if len(session_ids) > 1 else ''} {', '.join(map(str, session_ids))})" if session_ids else ""
    doses = [_dose_change(db.get_one(StudySession, i), recording, before, after) for i in session_ids]
    versions = f"version {old} to {DECODE_VERSION}" if old < DECODE_VERSION else "as markers and channels are explained now"
    return f"recording {recording.id}{used}, {versions}: {listed}", [d for d in doses if d]


def _dose_change(
    session: StudySession, recording: Recording, old_traces: dict[tuple[str, str], Trace], new_traces: dict[tuple[str, str], Trace]
) -> str | None:
    """Describe how the amplitudes of a session's steps of a recording differ; None where they do not."""
    parts = [(s.start_s, s.stop_s) for s in session.segments if s.recording_id == recording.id]
    changed = unknown = 0
    for key in {k for k in (*old_traces, *new_traces) if k[0] == AMPLITUDE_STREAM}:
        old, new = (_rows(traces.get(key), parts) for traces in (old_traces, new_traces))
        for end in sorted({*old, *new}):
            one, other = old.get(end, np.nan), new.get(end, np.nan)
            if not np.isclose(one, other, rtol=0, atol=1e-6, equal_nan=True):
                changed, unknown = changed + 1, unknown + bool(np.isnan(other))
    if not changed:
        return None
    lost = f", {unknown} of them an unknown one" if unknown else ""
    return f"session {session.id} (visit {session.visit.number}): {changed} steps of recording {recording.id} have another amplitude{lost}"


def _rows(trace: Trace | None, parts: Sequence[tuple[float, float]]) -> dict[float, float]:
    """Collect the values of a trace by the ends of their rows within parts of the recording, s; NaN where invalid."""
    if trace is None:
        return {}
    ends = np.round(trace.first_end_s + trace.dt_s * np.arange(trace.n), 3).tolist()
    return {t: v for t, v in zip(ends, unpack(trace).tolist(), strict=True) if any(a < t <= b + trace.dt_s for a, b in parts)}


def _refuse_loss(
    session: StudySession, recording: Recording, before: dict[tuple[str, str], Trace], after: dict[tuple[str, str], Trace]
) -> None:
    if not any(s.recording_id == recording.id and s.is_control for s in session.segments):
        return

    def found(traces: dict[tuple[str, str], Trace]) -> bool:
        return any(stream == session.control_stream and session.control_channel in (None, channel) for stream, channel in traces)

    if found(before) and not found(after):
        trace = f"{session.control_stream} {session.control_channel or ''}".strip()
        raise Refused(f"session {session.id} would lose its control trace '{trace}': choose another one on its page first")


def _difference(key: tuple[str, str], before: Trace | None, after: Trace | None) -> str:
    name = " ".join(key).strip()
    if before is None or after is None:
        return f"{name}: {'gone' if after is None else 'new'}"
    old, new = unpack(before), unpack(after)
    notes = [f"{a} was {b}" for a, b in ((after.unit, before.unit), (after.source, before.source)) if a != b]
    if old.size != new.size:
        notes.append(f"{new.size} rows, was {old.size}")
    n = min(old.size, new.size)
    changed = int(np.sum(~np.isclose(old[:n], new[:n], rtol=1e-6, atol=0, equal_nan=True)))
    if changed:
        notes.append(f"{changed} of {n} rows differ")
    gained = int(np.sum(~np.isnan(new))) - int(np.sum(~np.isnan(old)))
    if gained:
        notes.append(f"{gained:+d} valid rows")
    return f"{name}: {', '.join(notes)}" if notes else ""
