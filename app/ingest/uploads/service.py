"""Rules of uploads: bytes first, then identity out, then recordings, then sessions; the same bytes twice are one recording."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any

import structlog
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.ingest import repository, sessions, wording
from app.ingest.proposals import making
from app.ingest.sessions import StatedSession
from app.ingest.stated_beta import BetaStated, decode_options
from app.ingest.uploads import outcomes as outcomes_intake
from app.ingest.uploads import reading
from app.ingest.uploads.in_progress import in_progress, not_counted, place, tell_file
from app.ingest.uploads.incoming import Incoming, arrange
from app.ingest.uploads.reading import FileParts
from app.ingest.uploads.receiving import LETHAL, FileOutcome, Receiver
from app.ingest.uploads.reports import alike_together, known_recordings, store_reports, stored_reports, unreadable_members
from app.platform import files
from app.platform.errors import BetaloopError, Conflict, Invalid, TooLarge, passing
from app.platform.jobs.children.child import places
from app.platform.web.schemas import sensible_time
from app.study import access
from app.study import repository as study
from app.study.visits import require_unlocked
from app.tables.participants import Hemisphere, Participant
from app.tables.sessions import Controller, StudySession
from app.tables.uploads import Upload, UploadFile
from ml.formats import DecodeOptions, FileReport, GraspLog, Problem, UndecodableFile

__all__ = ["BetaStated", "FileOutcome", "Incoming", "UploadOutcome", "receive", "state_session", "stored_reports", "unreadable_members"]

log = structlog.get_logger()


class CutShort(BetaloopError):
    """A fault ended an upload of which something was kept; `interrupted` takes it up again.

    Args:
        upload_id: the upload. kept, of: how many of its files are kept.
        beneath: the fault, where it is one that passes (a full disk, a database that is away): its status is this error's.
    """

    status = 500
    title = "Something went wrong on our side"

    def __init__(self, upload_id: int, kept: int, of: int, beneath: BetaloopError | None) -> None:
        super().__init__(*wording.cut_short(upload_id, kept, of, beneath))
        if beneath is not None:
            self.status, self.title, self.retry_after_s = beneath.status, beneath.title, beneath.retry_after_s


SESSIONS_BEGUN = "sessions_begun"
"""Member of what an upload states: how often its sessions were begun to be made."""


@dataclass
class UploadOutcome:
    """Result of an upload.

    Attributes:
        files: those that were kept.
        asides: reports of what was not: larger than allowed, left by the operating system.
    """

    upload: Upload
    participant: Participant
    files: list[FileOutcome]
    asides: list[FileReport] = field(default_factory=list)

    @property
    def session_ids(self) -> list[int]:
        """Sessions of all files, each once."""
        return sorted({i for f in self.files for i in f.session_ids})

    @property
    def usable(self) -> bool:
        """True where anything could be used."""
        return any(f.row.status == "decoded" for f in self.files)

    @property
    def reports_for_sender(self) -> list[FileReport]:
        """Every report, in the sender's names."""
        return [r for f in self.files for r in f.reports_for_sender] + self.asides


def state_session(
    db: Session,
    participant: Participant,
    visit_number: int | None = None,
    controller: Controller | None = None,
    policy: str | None = None,
    started_at: datetime | None = None,
    hemisphere: Hemisphere | None = None,
    confirm: bool = True,
    session_id: int | None = None,
) -> StatedSession:
    """Check what the sender states about the sessions. Raises Invalid for a visit, policy or session that does not exist, or that do not
    fit; Conflict for a locked visit."""
    try:
        started_at = sensible_time(started_at) if started_at else None
    except ValueError as error:
        raise Invalid(
            f"The stated start {started_at} is out of range: {error}.", "Give the start of the session.", field="started_at"
        ) from error
    visit = study.visit_by_number(db, participant.id, visit_number) if visit_number is not None else None
    if visit is None:
        known = ", ".join(str(v.number) for v in study.visits(db, participant.id, 500, 0)[0])
        if visit_number is not None:
            listed = f"visits: {known or 'none yet'}"
            raise Invalid(f"Participant {participant.code} has no visit {visit_number} ({listed}).", "Add the visit first.", field="visit")
        if not known:
            raise Invalid(f"Participant {participant.code} has no visit yet.", "Add the visit first.", field="visit")
    if controller is not None and visit is not None and confirm:
        require_unlocked(visit)
    if controller is not None and visit is None and confirm:
        hint = "Name the visit, or send confirm=false and let it be proposed by its date."
        raise Invalid("A controller is stated, but no visit.", hint, field="visit")
    policy_id = study.policy_id(db, participant.id, policy) if policy else None
    if policy and policy_id is None:
        hint = "Give the name or number of one of its policies."
        raise Invalid(f"Participant {participant.code} has no policy '{policy}'.", hint, field="policy")
    session = None
    if session_id is not None:
        mine = study.sessions_of_participant(db, participant.id, with_proposals=True)
        session = next((s for s in mine if s.id == session_id), None)
        if session is None:
            raise Invalid(
                f"Participant {participant.code} has no session {session_id}.", "Name one of this participant's sessions.", field="session"
            )
    return StatedSession(visit, controller, policy_id, started_at, hemisphere, confirm, session)


def as_stated(db: Session, participant: Participant, said: Mapping[str, object]) -> StatedSession:
    """Read what the sender of a stored upload had stated about its sessions. Raises Invalid as `state_session`."""
    visit, controller, side, start, session = (said.get(name) for name in ("visit", "controller", "hemisphere", "started_at", "session"))
    return state_session(
        db,
        participant,
        visit if isinstance(visit, int) else None,
        Controller(str(controller)) if controller else None,
        str(said["policy_id"]) if said.get("policy_id") else None,
        datetime.fromisoformat(start) if isinstance(start, str) else None,
        Hemisphere(str(side)) if side else None,
        bool(said.get("confirm", True)),
        session if isinstance(session, int) else None,
    )


def receive(
    db: Session,
    participant: Participant,
    stated: StatedSession,
    incoming: Sequence[Incoming],
    caller: Caller,
    beta: BetaStated | None = None,
) -> UploadOutcome:
    """Take an upload: keep every file, decode what can be decoded, make or propose sessions. Commits by itself; see `Receiver`.

    `beta` states what the columns of a table are; where it is silent, the participant's unit and source are taken, and reported.

    Raises:
        TooLarge: every file exceeds the installation's limit. Invalid: no file. Conflict: the site has ended. CutShort: a fault, after
            something was kept. TooManyUploads, StoreAway: too many at once.
    """
    access.require(caller, can.UPLOAD, participant)
    access.refuse_ended(participant.site)
    if not incoming:
        raise Invalid("The upload holds no file.", "Choose at least one file.", field="file")
    beta = beta or BetaStated()
    with place(), in_progress(number := repository.next_upload(db)):
        # written with its first file: until then no transaction is open while a file travels to the bucket
        upload = Upload(id=number, participant_id=participant.id, created_by=caller.label, stated=_said(stated, beta))
        arranged = arrange(incoming)
        receiver = Receiver(db, participant, upload, decode_options(db, participant, beta), beta)
        outcome = UploadOutcome(upload, participant, [], alike_together(arranged.asides))
        try:
            _take(receiver, outcome, arranged.incoming)
            finish(db, outcome, stated)
        except Exception as fault:
            beneath = passing(fault)
            if not receiver.kept or (isinstance(fault, BetaloopError) and beneath is None):
                raise
            log.error("upload cut short", upload=number, kept=len(receiver.kept), places=places(fault))
            raise CutShort(number, len(receiver.kept), len(arranged.incoming), beneath) from fault
    return outcome


def _take(receiver: Receiver, outcome: UploadOutcome, incoming: Sequence[Incoming]) -> None:
    """Store and decode each file; those that are too large are reported. Raises TooLarge where all are."""
    refused: list[TooLarge] = []
    waiting = deque(incoming)
    number = 0
    while waiting:
        one = waiting.popleft()
        number += 1
        tell_file(outcome.upload.id, number, number + len(waiting))
        try:
            taken = receiver.receive(one)
            if isinstance(taken, FileParts):
                waiting.extendleft(Incoming(f"{one.name}/{name}", stream) for name, stream in reversed(taken.parts))
                outcome.asides.append(FileReport(one.name, understood=[wording.count_parts(len(taken.parts))], ignored=taken.ignored))
            else:
                outcome.files.append(taken)
        except TooLarge as error:
            refused.append(error)
            problem = Problem(error.detail, "file", f"It was not kept. {error.hint}")
            outcome.asides.append(FileReport(one.name, problem=problem))
    if refused and not outcome.files:
        raise refused[0]


def finish(db: Session, outcome: UploadOutcome, stated: StatedSession) -> None:
    """Finish an upload once all its files are in: sessions, grasp tests, the report. Commits."""
    upload = outcome.upload
    begun = upload.stated.get(SESSIONS_BEGUN, 0)
    if begun >= LETHAL:
        _leave_without_sessions(outcome)
        _close(db, outcome)
        return
    # committed before, so that sessions which end the process that makes them are not tried for ever
    upload.stated = {**upload.stated, SESSIONS_BEGUN: begun + 1}
    db.commit()
    with not_counted(db, lambda: _set_begun(upload, begun)):
        make_sessions(db, outcome, stated)
        attach_grasps_of(db, outcome, stated)
        _close(db, outcome)


def _set_begun(upload: Upload, begun: int) -> None:
    upload.stated = {**upload.stated, SESSIONS_BEGUN: begun}


def _close(db: Session, outcome: UploadOutcome) -> None:
    upload = outcome.upload
    # a file that came before has its row in another upload; this one only points at it
    earlier = [o.row.id for o in outcome.files if o.same_bytes]
    upload.stated = {**upload.stated, "duplicates": earlier}
    upload.status = "decoded" if outcome.usable else "failed"
    db.commit()


def _leave_without_sessions(outcome: UploadOutcome) -> None:
    """Report on the files of an upload that its sessions ended the process which made them, and that they are not made any more."""
    log.error("upload left without sessions: making them ended the service", upload=outcome.upload.id)
    for file in outcome.files:
        if file.recordings and not file.same_bytes:
            file.reports[0].flagged.append(
                f"The service ended {LETHAL} times while it made sessions of this upload: its recordings are kept, no session was made. "
                f"Send the file again with what is wrong in it mended, or tell your administrator: upload {outcome.upload.id}."
            )
            _keep_reports(file)


def _said(stated: StatedSession, beta: BetaStated) -> dict[str, Any]:
    return asdict(beta) | {
        "visit": stated.visit.number if stated.visit else None,
        "controller": stated.controller,
        "policy_id": stated.policy_id,
        "started_at": stated.started_at.isoformat() if stated.started_at else None,
        "hemisphere": stated.hemisphere,
        "confirm": stated.confirm,
        "session": stated.session.id if stated.session else None,
    }


def make_sessions(db: Session, outcome: UploadOutcome, stated: StatedSession) -> None:
    """Make sessions of all recordings of the upload that have none yet; known recordings keep the sessions they have."""
    repository.lock_participant(db, outcome.participant.id)
    with_recordings = [f for f in outcome.files if f.recordings]
    known = {r.id: list(study.session_ids_of_recording(db, r.id)) for f in with_recordings for r in f.recordings}
    fresh = {r.id: r for f in with_recordings for r in f.recordings if not known[r.id]}
    created: list[making.NewSession] = []
    trouble = ""
    try:
        with db.begin_nested(), study.traces_read_once(db):
            created = making.make_sessions(db, outcome.participant, outcome.upload, list(fresh.values()), stated)
    except Exception as fault:
        if passing(fault) is not None:
            raise  # they are made when it is over
        # the recordings are stored and safe; a fault of ours must not turn a whole upload away
        log.error("sessions could not be made", upload=outcome.upload.id, places=places(fault))
        trouble = f"No session could be made of it. It is stored; tell your administrator: upload {outcome.upload.id}."
    reported: set[int] = set()
    for file in with_recordings:
        mine = {r.id for r in file.recordings}
        if mine <= reported:
            _report_copy(db, file, mine)
            continue
        reported |= mine
        earlier = sorted({i for r in mine for i in known[r]})
        if earlier and not file.same_bytes:
            listed = ", ".join(map(str, earlier))
            file.reports[0].understood.append(f"The same recording came before in another file; it stays session {listed}.")
        file.reports[0].flagged.extend(sessions.disagreements(db, earlier, stated))
        ours = [m for m in created if any(r.id in mine for r in m.recordings)]
        if file.same_bytes:
            anew = "It has no session any more: it is proposed anew." if ours else "Nothing was changed."
            file.reports[0].understood.append(anew)
        for one in ours:
            file.reports[0].understood.extend(one.understood)
            file.reports[0].flagged.extend(one.flagged)
        without = [r for r in mine & fresh.keys() if not any(r == x.id for m in ours for x in m.recordings)]
        if without:
            file.reports[0].flagged.append(trouble or _no_session(len(without), len(mine)))
        file.session_ids = sorted({*earlier, *(m.session.id for m in ours)})
        _keep_reports(file)


def _report_copy(db: Session, file: FileOutcome, recordings: set[int]) -> None:
    """Describe a further copy within this upload: only that it is one, and where it is."""
    file.session_ids = sorted({i for r in recordings for i in study.session_ids_of_recording(db, r)})
    where = f"; it is session {', '.join(map(str, file.session_ids))}" if file.session_ids else ""
    file.duplicate = True
    file.reports[0].understood.append(f"The same recording as in another file of this upload{where}.")
    _keep_reports(file)


def _no_session(without: int, of: int) -> str:
    if of == 1:
        return "It holds no data of a session: the recording is kept, and no session was made."
    return f"{without} of {of} recordings hold no data of a session: they are kept, and no session was made of them."


def attach_grasps_of(db: Session, outcome: UploadOutcome, stated: StatedSession) -> None:
    """Attach grasp tests to the stated session, else to the only one that this upload gave."""
    target = stated.session
    if target is None and len(outcome.session_ids) == 1:
        target = db.get_one(StudySession, outcome.session_ids[0])
    for file in outcome.files:
        if file.row.kind != repository.GRASP_KIND and file.outcomes and not file.same_bytes:
            _attach_own(db, file)
        if file.row.kind != repository.GRASP_KIND or file.row.status != "decoded":
            continue
        if file.row.session_id is not None:
            file.session_ids = [file.row.session_id]
            if stated.session is not None and stated.session.id != file.row.session_id:
                file.reports[0].flagged.append(f"It belongs to session {file.row.session_id} already and was not moved.")
            continue
        try:
            said = attach_grasps(db, file.row, target) if target else outcomes_intake.take_of_session(db, file.row, file.outcomes, None)
        except BetaloopError as error:
            said = [str(error)]
        file.reports[0].understood.extend(said)
        file.session_ids = [file.row.session_id] if file.row.session_id is not None else []
        _keep_reports(file)


def _attach_own(db: Session, file: FileOutcome) -> None:
    """Attach the grasp tests within a recording to the session of that recording, where it has one."""
    if len(file.session_ids) == 1 and any(isinstance(log, GraspLog) for log in file.outcomes):
        session = db.get_one(StudySession, file.session_ids[0])
        file.reports[0].understood.extend(outcomes_intake.take_of_session(db, file.row, file.outcomes, session))
        _keep_reports(file)


def _keep_reports(file: FileOutcome) -> None:
    if not file.same_bytes:
        store_reports(file.row, file.reports, known_recordings(file.row))


def attach_grasps(db: Session, file: UploadFile, session: StudySession) -> list[str]:
    """Attach a stored grasp file to a session and derive its grasp frequency; sentences on what came of it.

    Raises:
        Invalid: no grasp file, or another participant's session. Conflict: it belongs to a session already.
    """
    if file.kind != repository.GRASP_KIND or file.status != "decoded" or file.stored_sha256 is None:
        raise Invalid(f"File {file.id} is no decoded grasp test.", "Choose a grasp file that waits for its session.")
    if file.session_id is not None and file.session_id != session.id:
        raise Conflict(f"File {file.id} belongs to session {file.session_id} already.", "Correct the session's outcomes by hand.")
    try:
        decoded = reading.decode(files.path_of(file.stored_sha256), file.kind, DecodeOptions(), file.name)
    except UndecodableFile as error:
        raise Invalid(f"File {file.id} cannot be read any more: {error.what} ({error.where}).", error.hint) from error
    return outcomes_intake.take_of_session(db, file, decoded.outcomes, session)


def stored_outcomes(db: Session, upload: Upload) -> list[FileOutcome]:
    """List the files of an upload as they were stored, and those that had come before."""
    earlier = [db.get_one(UploadFile, i) for i in upload.stated.get("duplicates", [])]
    both = [(f, False) for f in upload.files] + [(f, True) for f in earlier]
    return [
        FileOutcome(f.name, f, stored_reports(f), before, before, repository.session_ids_of_file(db, f, known_recordings(f)))
        for f, before in both
    ]
