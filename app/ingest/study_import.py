"""Import of a whole study: folders of files and a sheet with a row per session. Each file and each session is a transaction of its own.
What is there already stays as it is. So an import that was cut short is finished by doing it again, and twice changes nothing."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.ingest import repository
from app.ingest.proposals import service as proposals
from app.ingest.schemas import PartIn, ProposalChange
from app.ingest.sessions import StatedSession
from app.ingest.stated_beta import BetaStated, decode_options
from app.ingest.uploads import reading, service
from app.ingest.uploads.incoming import Incoming, arrange
from app.ingest.uploads.reports import known_recordings
from app.platform import files, raw_bytes
from app.platform.database import transaction
from app.platform.errors import BetaloopError
from app.settings import get_settings
from app.study import blinding, visits
from app.study import repository as study
from app.study.recordings.facts import unknown_clock
from app.study.schemas import ConditionsChange, QocIn, SessionChange, VisitIn
from app.study.sessions import changes, conditions
from app.study.sessions.contradictions import control_recording
from app.study.traces import step_table
from app.tables.participants import Participant
from app.tables.sessions import Controller, StudySession
from app.tables.visits import Visit
from ml.formats import DecodeOptions, RecordingLog, UndecodableFile
from ml.formats.studies.matching import Candidate, Matches, match
from ml.formats.studies.sheet import Sheet, SheetRow

log = structlog.get_logger()

REASON = "import of the study's sheet"
AMPLITUDE_DIFFERS = 0.05
"""A recorded amplitude under cDBS that differs from the sheet's by more than this share is reported."""

Progress = Callable[[int, int, str], None]
"""Takes how many of how many steps are done, and what is next."""


@dataclass
class StudyReport:
    """Result of an import, or of a dry run of one.

    Attributes:
        sessions: (line of the sheet, participant, file, what was or would be done). rows: (line, why it has no session).
        files: (file, why nothing of it has a row). problems: (file, why it could not be read). notes: how many were not kept.
    """

    dry_run: bool
    sessions: list[tuple[int, str, str, str]] = field(default_factory=list)
    rows: list[tuple[int, str]] = field(default_factory=list)
    files: list[tuple[str, str]] = field(default_factory=list)
    problems: list[tuple[str, str]] = field(default_factory=list)
    notes: int = 0
    changed: int = 0


@dataclass(frozen=True)
class _Unit:
    """Files that are read together: one file, or the loose files of one recording; `name` as the sheet may call it."""

    name: str
    paths: list[Path]


def import_study(
    folders: Sequence[Path], sheet: Sheet, caller: Caller, actor: str, dry_run: bool = False, progress: Progress = lambda *_: None
) -> StudyReport:
    """Import the files of a study and confirm the sessions that its sheet describes.

    Args:
        folders: with the files, in folders named by participant, unless the sheet has one participant alone. sheet: as it was read.
        caller: who imports. actor: name for the audit trail. dry_run: read everything, change nothing.
    """
    report = StudyReport(dry_run, rows=list(sheet.problems), notes=sum(r.has_note for r in sheet.rows))
    codes = {row.participant.casefold(): row.participant for row in sheet.rows}
    units = _units(folders)
    candidates: list[Candidate] = []
    if not dry_run:
        _add_visits(sheet.rows, caller, actor, report)
    for number, unit in enumerate(units):
        progress(number, len(units), unit.name)
        code = _participant_of(unit, codes)
        if code is None:
            report.files.append((unit.name, "no folder of its path is a participant of the sheet"))
            continue
        try:
            candidates += _take(unit, code, caller, actor, report, len(candidates))
        except BetaloopError as error:
            report.problems.append((unit.name, f"{error.detail} {error.hint}".strip()))
        except UndecodableFile as error:
            report.problems.append((unit.name, f"{error.what} ({error.where}). {error.hint}"))
    progress(len(units), len(units), "")
    found = match(sheet.rows, _once(candidates))
    _confirm(found, caller, actor, report)
    report.rows += [(row.line, why) for row, why in found.rows]
    report.files += [(c.file, f"no row of participant {c.participant} is of its session{_when(c)}") for c in found.candidates]
    report.rows.sort()
    return report


def _add_visits(rows: Sequence[SheetRow], caller: Caller, actor: str, report: StudyReport) -> None:
    """Add the visits of the sheet that are not there, so that recordings find theirs by its day."""
    for row in {(r.participant, r.visit): r for r in reversed(rows)}.values():
        try:
            with transaction(actor) as db:
                report.changed += bool(find_visit(db, study.participant_by_code(db, row.participant, caller), row, caller)[1])
        except BetaloopError as error:
            report.problems.append((f"participant {row.participant}, visit {row.visit}", f"{error.detail} {error.hint}".strip()))


def _once(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Keep each session once; recordings of two implants that share a session came in two files."""
    return list({c.key: c for c in reversed(candidates)}.values())[::-1]


def _when(candidate: Candidate) -> str:
    return f" of {candidate.started_at:%Y-%m-%d %H:%M} UTC" if candidate.started_at else ""


def _units(folders: Sequence[Path]) -> list[_Unit]:
    """List what is read together, in order of the paths: loose files of a recording's folder, and every other file alone."""
    out: list[_Unit] = []
    for root in folders:
        everything = sorted(p for p in root.rglob("*") if p.is_file()) if root.is_dir() else [root]
        loose: dict[Path, list[Path]] = defaultdict(list)
        for path in everything:
            if path.suffix.lower() == ".json":
                loose[path.parent].append(path)
            else:
                out.append(_Unit(_name_below(path, root), [path]))
        for folder, members in loose.items():
            if len(members) > 1 and _is_one_recording(members):
                out.append(_Unit(_name_below(folder, root), members))
            else:
                out += [_Unit(_name_below(path, root), [path]) for path in members]
    return sorted(out, key=lambda u: u.name)


def _name_below(path: Path, root: Path) -> str:
    return f"{root.name}/{path.relative_to(root)}" if path != root else path.name


def _is_one_recording(members: Sequence[Path]) -> bool:
    """Decide whether files are the loose ones of device recordings, which are put together."""
    with ExitStack() as stack:
        incoming = [Incoming(p.name, stack.enter_context(p.open("rb"))) for p in members]
        return len(arrange(incoming).incoming) < len(members)


def _participant_of(unit: _Unit, codes: dict[str, str]) -> str | None:
    named = [codes[part.casefold()] for part in unit.name.split("/") if part.casefold() in codes]
    return named[-1] if named else next(iter(codes.values())) if len(codes) == 1 else None


def _take(unit: _Unit, code: str, caller: Caller, actor: str, report: StudyReport, offset: int) -> list[Candidate]:
    """Receive a unit, unless its bytes came before; list the sessions that it holds."""
    with transaction(actor) as db, ExitStack() as stack:
        participant = study.participant_by_code(db, code, caller)
        arranged = arrange([Incoming(_inner(unit, p), stack.enter_context(p.open("rb"))) for p in unit.paths])
        out: list[Candidate] = []
        for name, one in _parts_of(arranged.incoming, unit.name, decode_options(db, participant, BetaStated())):
            sha256 = hashlib.file_digest(one.stream, "sha256").hexdigest()  # type: ignore[arg-type]
            one.stream.seek(0)
            known = repository.decoded_file(db, participant.id, sha256)
            if known is not None:
                ids = repository.session_ids_of_file(db, known, known_recordings(known))
                out += [_of_session(db, i, participant, name, sha256, caller) for i in ids]
            elif (refused := repository.refused_file(db, participant.id, sha256)) is not None:
                where = f"decide on file {refused.id} on the page of the quarantine of {participant.code}, or correct the file"
                report.problems.append((name, f"it could not be read before: {where}"))
            elif report.dry_run:
                out += _dry(db, one, participant, name, sha256, offset + len(out))
            else:
                stated = StatedSession(confirm=False)
                outcome = service.receive(db, participant, stated, [one], caller)
                report.changed += 1
                for file in outcome.files:
                    report.problems += [(name, f"{r.problem.what} ({r.problem.where})") for r in file.reports if r.problem]
                out += [_of_session(db, i, participant, name, sha256, caller) for i in outcome.session_ids]
        return out


def _parts_of(incoming: Sequence[Incoming], name: str, options: DecodeOptions) -> Iterator[tuple[str, Incoming]]:
    """List files with the names that a sheet may call them by; the parts of one that holds several in its place.

    Raises:
        UndecodableFile: its sessions cannot be separated.
    """
    for one in incoming:
        several = None
        may_have = reading.may_have_parts(one.stream.read(reading.HEAD))
        one.stream.seek(0)
        if may_have:
            with raw_bytes.received(one.stream, get_settings().upload_limit_mb * 1024 * 1024) as (raw, _, _):
                several = reading.parts(raw, options)
            one.stream.seek(0)
        if several is None:
            yield name, one
        else:
            inner = [Incoming(f"{one.name}/{part}", stream) for part, stream in several.parts]
            for part in inner:
                yield from _parts_of([part], f"{name}/{Path(part.name).name}", options)


def _inner(unit: _Unit, path: Path) -> str:
    return f"{unit.name}/{path.name}" if len(unit.paths) > 1 else path.name


def _of_session(db: Session, number: int, participant: Participant, name: str, sha256: str, caller: Caller) -> Candidate:
    session = study.session(db, number, caller)
    control = control_recording(session)
    clock = control.details.get("settings", {}).get("clock") or {}
    within_s = float(clock.get("uncertainty_s") or 0.0)
    known = session.started_at is not None and not unknown_clock(control)
    return Candidate(
        number, participant.code, name, sha256, session.started_at, session.duration_s, session.hemisphere, known, within_s
    )  # fmt: skip


def _dry(db: Session, one: Incoming, participant: Participant, name: str, sha256: str, offset: int) -> Iterator[Candidate]:
    """Read a file without storing anything; one candidate per run of its recordings, with negative keys."""
    options = decode_options(db, participant, BetaStated())
    clean = files.draft_path()
    try:
        with raw_bytes.received(one.stream, get_settings().upload_limit_mb * 1024 * 1024) as (raw, _, _):
            found = reading.clean(raw, clean, options)
        if found.problem is not None:
            raise found.problem
        decoded = reading.decode(clean, found.kind, options, one.name)
    finally:
        clean.unlink(missing_ok=True)
    runs: dict[int, RecordingLog] = {}
    for r in decoded.recordings:
        if r.run is not None and any(t.valid.any() for t in r.traces):
            runs.setdefault(r.run, r)
    for number, r in enumerate(runs.values(), start=1):
        clock: dict[str, Any] = dict(r.settings.get("clock") or {})
        known = r.started_at is not None and clock.get("known") is not False
        within_s = float(clock.get("uncertainty_s") or 0.0)
        yield Candidate(-offset - number, participant.code, name, sha256, r.started_at, r.duration_s, r.hemisphere, known, within_s)


def _confirm(matches: Matches, caller: Caller, actor: str, report: StudyReport) -> None:
    """Confirm every matched session and enter what the sheet says of it; what fails is listed with its row."""
    for candidate, rows in matches.pairs:
        if report.dry_run and (candidate.key < 0 or len(rows) > 1):
            for row in rows:
                cut = f", cut out of {len(rows)}" if len(rows) > 1 else ""
                new = f"would be a session of visit {row.visit}, {row.controller}{cut}"
                report.sessions.append((row.line, row.participant, candidate.file, new))
            continue
        try:
            numbers = _parts(candidate, rows, caller, actor)
        except BetaloopError as error:
            report.rows += [(row.line, f"{error.detail} {error.hint}".strip()) for row in rows]
            continue
        for number, row in zip(numbers, rows, strict=True):
            try:
                with transaction(actor) as db:
                    said = enter_row(db, study.session(db, number, caller), row, caller, report.dry_run)
                    if report.dry_run:
                        db.rollback()
            except BetaloopError as error:
                report.rows.append((row.line, f"session {number}: {error.detail} {error.hint}".strip()))
                continue
            report.changed += bool(said)
            report.sessions.append((row.line, row.participant, candidate.file, f"session {number}: {'; '.join(said) or 'as it was'}"))


def _parts(candidate: Candidate, rows: Sequence[SheetRow], caller: Caller, actor: str) -> list[int]:
    """Cut a proposal into a session per row where a recording holds several; numbers of the sessions, in the order of the rows."""
    if len(rows) == 1:
        return [candidate.key]
    with transaction(actor) as db:
        session = study.session(db, candidate.key, caller)
        control = next(s for s in session.segments if s.is_control)
        begin = candidate.started_at
        starts = [max(0.0, (r.start - begin).total_seconds()) if r.start and begin else 0.0 for r in rows]
        ends = [*starts[1:], control.stop_s - control.start_s]
        stops = [min(end, start + 60 * r.minutes) if r.minutes else end for start, end, r in zip(starts, ends, rows, strict=True)]
        parts = [
            PartIn(start_s=control.start_s + a, stop_s=control.start_s + b, controller=Controller(r.controller))
            for a, b, r in zip(starts, stops, rows, strict=True)
        ]
        version = repository.proposal(db, session.id, caller).version
        return [s.id for s in proposals.split(db, session, version, parts, caller)]


def enter_row(db: Session, session: StudySession, row: SheetRow, caller: Caller, dry_run: bool) -> list[str]:
    """Confirm a session as its row says, and enter outcomes, medication and design. Returns what was done; nothing where all was there."""
    said: list[str] = []
    visit, made = find_visit(db, session.visit.participant, row, caller)
    said += made
    if session.status == "proposed":
        change: dict[str, Any] = {"visit": visit.number, "controller": row.controller, "reason": REASON}
        change |= {"policy": row.policy} if row.policy else {}
        change |= {"hemisphere": row.hemisphere} if row.hemisphere and row.hemisphere != session.hemisphere else {}
        if session.started_at is None and row.start is not None:
            change["started_at"] = row.start
        version = repository.proposal(db, session.id, caller).version
        notes = proposals.confirm(db, session, ProposalChange(version=version, **change), caller)
        said += [f"visit {visit.number}, {row.controller}", *notes]
    else:
        arm = blinding.visible_arm(session, caller)
        if session.visit_id != visit.id or (arm is not None and arm.controller != row.controller):
            ran = arm.controller if arm else "hidden"
            said.append(f"not changed: it is of visit {session.visit.number}, {ran}, and the sheet says {visit.number}, {row.controller}")
            return said
    said += _outcomes(db, session, row, caller)
    said += _medication(db, session, row, caller)
    said += _design(db, session, row, caller)
    return said + _amplitude(db, session, row)


def find_visit(db: Session, participant: Participant, row: SheetRow, caller: Caller) -> tuple[Visit, list[str]]:
    """Find the visit of a row, or add it; and sentences on what was added or differs."""
    visit = study.visit_by_number(db, participant.id, row.visit)
    if visit is None:
        visit = visits.add_visit(db, participant, VisitIn(number=row.visit, date=row.day), caller)
        return visit, [f"visit {row.visit} added" + (f" on {row.day}" if row.day else "")]
    differs = row.day is not None and visit.date not in (None, row.day)
    return visit, [f"visit {row.visit} is of {visit.date}, and the sheet says {row.day}"] if differs else []


def _outcomes(db: Session, session: StudySession, row: SheetRow, caller: Caller) -> list[str]:
    known = {name: value for name in row.outcomes if (value := getattr(session.qoc, name, None)) is not None}
    differ = [
        f"{name} is {known[name]:g}, and the sheet says {value:g}: not changed"
        for name, value in row.outcomes.items()
        if name in known and not np.isclose(known[name], value)
    ]
    fresh = {name: value for name, value in row.outcomes.items() if name not in known}
    if fresh:
        changes.record_qoc(db, session, QocIn(**fresh, reason=REASON), caller)
    return [*(f"{name} {value:g}" for name, value in fresh.items()), *differ]


def _medication(db: Session, session: StudySession, row: SheetRow, caller: Caller) -> list[str]:
    hours = row.medication_h
    if hours is None and row.last_dose is not None and session.started_at is not None:
        hours = round((session.started_at - row.last_dose).total_seconds() / 3600.0, 3)
    if hours is None or session.medication_h is not None:
        return []
    if not 0 <= hours <= 72:
        return [f"the last dose would have been {hours:g} h before the start: not entered"]
    changes.change_session(db, session, SessionChange(medication_h=hours, reason=REASON), caller)
    return [f"last dose {hours:g} h before"]


def _design(db: Session, session: StudySession, row: SheetRow, caller: Caller) -> list[str]:
    present = session.conditions
    fresh = {n: v for n, v in row.design.items() if (present is None or getattr(present, n) != v)}
    if not fresh or row.controller != Controller.RANDOM:
        return []
    conditions.change(db, session, ConditionsChange.model_validate({**fresh, "reason": REASON}), caller)
    return [f"design: {', '.join(fresh)}"]


def _amplitude(db: Session, session: StudySession, row: SheetRow) -> list[str]:
    """Compare the recorded amplitude of a cDBS session with the sheet's."""
    if row.amplitude_ma is None or row.controller != Controller.CDBS or session.visit.sealed:
        return []
    values = step_table(db, session, session.visit.participant.current_settings).amplitude_ma
    known = values[np.isfinite(values)]
    if not known.size or abs(np.median(known) - row.amplitude_ma) <= AMPLITUDE_DIFFERS * max(row.amplitude_ma, 0.1):
        return []
    return [f"look at this: the sheet says {row.amplitude_ma:g} mA, and the recording {float(np.median(known)):g} mA"]
