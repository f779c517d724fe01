"""The samples of a session with their times, as files that other programs read: Parquet and NWB."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.ingest.repository import file_of_recording
from app.ingest.stated_beta import options_of_file
from app.overview.package_dictionary import Days
from app.platform import files
from app.platform.audit import record
from app.platform.errors import BetaloopError, Conflict, Invalid
from app.platform.jobs.children.child import ChildLimits
from app.platform.jobs.children.limited import ChildEnded, run_limited
from app.settings import get_settings
from app.study import blinding
from app.study.traces import recorded_traces, session_offset_s
from app.tables.recordings import Recording
from app.tables.sessions import StudySession
from ml.outcomes import OUTCOMES

# Samples of a session for other programs: which files they lie in, who may have them, and the child that writes them.

WRITE = "app.overview.samples_compute:write"
"""What the child runs."""


class SampleFormat(StrEnum):
    """Formats of the export."""

    PARQUET = "parquet"
    NWB = "nwb"


MEDIA_TYPES = {SampleFormat.PARQUET: "application/vnd.apache.parquet", SampleFormat.NWB: "application/x-hdf5"}


@dataclass(frozen=True)
class SampleFile:
    """The written file, open and without a name; its name for the person who takes it, and its size in bytes."""

    content: BinaryIO
    name: str
    size: int


def session_samples(db: Session, session: StudySession, form: SampleFormat, caller: Caller) -> SampleFile:
    """Write a session's samples with their times, and every trace on its own rows.

    The samples are decoded again from the stored files; a recording of which only traces were ever uploaded gives these alone.

    Raises:
        Forbidden: the caller may not know yet what ran. Conflict: the session has no recording, the installation cannot write NWB,
            or a stored file is missing. Invalid: reading takes more memory or time than a file may.
    """
    blinding.require_known(session.visit, caller)
    if form is SampleFormat.NWB and find_spec("pynwb") is None:
        raise Conflict(
            "This installation cannot write NWB: the package pynwb is not installed.",
            "Take Parquet, or have betaloop installed with its extra: betaloop[nwb].",
        )
    if not session.segments:
        raise Conflict(f"Session {session.id} has no recording.", "Upload its file first.")
    limits = reading_limits()
    name = f"{session.visit.participant.code}-session-{session.id}.{form.value}"
    with files.draft_folder() as folder:
        params = _params(db, session, caller, folder) | {"format": form.value, "target": str(folder / "samples")}
        try:
            run_limited(WRITE, params, limits, who=f"samples of {session.visit.participant_id}")
        except ChildEnded as ended:
            raise unread(session, ended) from None
        record(db, "export", "session", session.id, {"format": form.value})
        content = (folder / "samples").open("rb")
        return SampleFile(content, name, (folder / "samples").stat().st_size)


def _params(db: Session, session: StudySession, caller: Caller, folder: Path) -> dict[str, Any]:
    participant = session.visit.participant
    traces = recorded_traces(db, session, participant.current_settings)
    arrays = {f"t{i}": found.t_s for i, found in enumerate(traces)}
    arrays |= {f"v{i}": found.values.astype(np.float32) for i, found in enumerate(traces)}
    np.savez(folder / "traces.npz", allow_pickle=False, **arrays)
    headers = [
        {
            "recording": f.trace.recording_id,
            "hemisphere": f.trace.recording.hemisphere,
            "stream": f.trace.stream,
            "channel": f.trace.channel,
            "unit": f.trace.unit,
        }
        for f in traces
    ]
    arm, qoc = blinding.stated_arm(session, caller), session.qoc
    about = {
        "participant": participant.code,
        "session": session.id,
        "visit": session.visit.number,
        "ordinal": session.ordinal,
        "day": Days(participant.created_at).of(session.started_at),
        "duration_s": session.duration_s,
        "controller": arm.controller.value if arm else None,
        "policy": arm.policy_id if arm else None,
        "hemisphere": session.hemisphere,
        "control_stream": session.control_stream,
        "control_channel": session.control_channel,
        "excluded": session.excluded_reason is not None,
        **{o.field: qoc and qoc.value(o) for o in OUTCOMES},
    }
    return {"files": files_of(db, session), "traces": str(folder / "traces.npz"), "headers": headers, "session": about}


def reading_limits() -> ChildLimits:
    """Return the limits of a child that reads the samples of a session, for which a person waits."""
    settings = get_settings()
    return ChildLimits(settings.decode_memory_mb, settings.decode_seconds, quotes=False)


def files_of(db: Session, session: StudySession) -> list[dict[str, Any]]:
    """List the stored files of the session's recordings, and which stretch of each recording is the session's.

    Raises:
        Conflict: a stored file is missing.
    """
    wanted: dict[int, dict[int, Recording]] = defaultdict(dict)
    for segment in session.segments:
        if segment.recording.upload_file_id is not None:
            wanted[segment.recording.upload_file_id][segment.recording_id] = segment.recording
    lead = session.visit.participant.current_settings.window * session.visit.participant.current_settings.period_s
    found = []
    for recordings in wanted.values():
        file = file_of_recording(db, next(iter(recordings.values())))
        if file.stored_sha256 is None or not files.path_of(file.stored_sha256).exists():
            raise Conflict(
                f"The stored file {file.id} of session {session.id} is missing.", "Ask the administrator to run betaloop doctor."
            )
        rows = []
        for recording in recordings.values():
            start = session_offset_s(session, recording.id)
            rows.append(
                {"id": recording.id, "fingerprint": recording.fingerprint, "hemisphere": recording.hemisphere, "start_s": start,
                 "begin_s": start - lead, "end_s": start + session.duration_s}
            )  # fmt: skip
        options = replace(options_of_file(db, file, session.visit.participant), keep_samples=True)
        source = str(files.path_of(file.stored_sha256).resolve())
        found.append({"source": source, "kind": file.kind, "name": file.name, "options": asdict(options), "recordings": rows})
    return found


def unread(session: StudySession, ended: ChildEnded) -> BetaloopError:
    """Explain what kept a session's samples from being read. Raises nothing; a fault of ours goes on as the fault that it is."""
    if ended.cause in ("memory", "time"):
        much = f"{ended.limits.memory_mb} MiB" if ended.cause == "memory" else f"{ended.limits.cpu_s} s of processor time"
        setting = "BETALOOP_DECODE_MEMORY_MB" if ended.cause == "memory" else "BETALOOP_DECODE_SECONDS"
        return Invalid(f"The samples of session {session.id} take more than {much} to read.", f"Have {setting} raised.")
    raise ended
