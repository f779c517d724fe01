"""Rules of uploads: bytes first, then identity out, then recordings and sessions; the same bytes twice are one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime

from sqlalchemy.orm import Session

from app.accounts import policy as can
from app.accounts.policy import Caller
from app.ingest import repository
from app.ingest.formats.log import FileReport, Problem
from app.ingest.formats.options import DecodeOptions
from app.ingest.models import Upload, UploadFile
from app.ingest.receiving import BetaStated, FileOutcome, Incoming, Receiver
from app.ingest.sessions import StatedSession
from app.platform.errors import Invalid
from app.platform.schemas import sensible_time
from app.study import repository as study
from app.study import service as study_service
from app.study.models import Controller, Hemisphere, Participant

__all__ = ["BetaStated", "FileOutcome", "Incoming", "UploadOutcome", "receive", "state_session", "stored_reports"]


@dataclass
class UploadOutcome:
    """What became of an upload."""

    upload: Upload
    participant: Participant
    files: list[FileOutcome]

    @property
    def session_ids(self) -> list[int]:
        """Sessions of all files, each once."""
        return sorted({i for f in self.files for i in f.session_ids})

    @property
    def usable(self) -> bool:
        """Whether anything could be used."""
        return any(f.row.status == "decoded" for f in self.files)


def state_session(
    db: Session,
    participant: Participant,
    visit_number: int,
    controller: Controller,
    policy: str | None = None,
    started_at: datetime | None = None,
    hemisphere: Hemisphere | None = None,
) -> StatedSession:
    """What the sender says of the session. Raises Invalid for a visit or policy that does not exist."""
    try:
        started_at = sensible_time(started_at) if started_at else None
    except ValueError as error:
        raise Invalid(f"The stated start {started_at} is out of range: {error}.", "Give the start of the session.") from error
    visit = study.visit_by_number(db, participant.id, visit_number)
    if visit is None:
        known = ", ".join(str(v.number) for v in study.visits(db, participant.id, 500, 0)[0]) or "none yet"
        raise Invalid(f"Participant {participant.code} has no visit {visit_number} (visits: {known}).", "Add the visit first.")
    policy_id = None
    if policy:
        policy_id = study.policy_id(db, participant.id, policy)
        if policy_id is None:
            raise Invalid(f"Participant {participant.code} has no policy '{policy}'.", "Give the name or number of one of its policies.")
    return StatedSession(visit, controller, policy_id, started_at, hemisphere)


def receive(
    db: Session,
    participant: Participant,
    stated: StatedSession,
    incoming: Sequence[Incoming],
    caller: Caller,
    beta: BetaStated | None = None,
) -> UploadOutcome:
    """Take an upload: keep every file, decode what can be decoded, make sessions. Commits by itself; see `Receiver`.

    `beta` says what the beta column of a table is; the participant's unit and source are taken, and said, where it is silent.

    Raises:
        TooLarge: a file exceeds the installation's limit; files before it are kept.
    """
    study_service.require(caller, can.UPLOAD, participant)
    if not incoming:
        raise Invalid("The upload holds no file.", "Choose at least one file.")
    beta = beta or BetaStated()
    said = asdict(beta) | {
        "visit": stated.visit.number,
        "controller": stated.controller,
        "policy_id": stated.policy_id,
        "started_at": stated.started_at.isoformat() if stated.started_at else None,
        "hemisphere": stated.hemisphere,
    }
    upload = Upload(participant_id=participant.id, visit_id=stated.visit.id, created_by=caller.label, report=[], stated=said)
    db.add(upload)
    db.flush()
    receiver = Receiver(db, participant, upload, stated, decode_options(participant, beta), beta)
    outcomes = [receiver.receive(one) for one in incoming]
    # a file that came before has its row in another upload; this one only points at it
    upload.stated = said | {"duplicates": [o.row.id for o in outcomes if o.duplicate]}
    upload.report = [asdict(r) for o in outcomes for r in o.reports]
    upload.status = "decoded" if any(o.row.status == "decoded" for o in outcomes) else "failed"
    db.commit()
    return UploadOutcome(upload, participant, outcomes)


def decode_options(participant: Participant, beta: BetaStated) -> DecodeOptions:
    """The participant's choices for decoders."""
    settings = participant.current_settings
    return DecodeOptions(
        period_s=settings.period_s,
        beta_low_hz=settings.beta_low_hz,
        beta_high_hz=settings.beta_high_hz,
        min_valid_fraction=settings.min_valid_fraction,
        table_beta_unit=beta.unit or settings.beta_unit or "unstated",
    )


def stored_outcomes(db: Session, upload: Upload) -> list[FileOutcome]:
    """The files of an upload as they were stored, and those that had come before."""
    own = [FileOutcome(f.name, f, stored_reports(f), False, list(repository.session_ids_of_file(db, f.id))) for f in upload.files]
    earlier = [db.get_one(UploadFile, i) for i in upload.stated.get("duplicates", [])]
    return own + [FileOutcome(f.name, f, stored_reports(f), True, list(repository.session_ids_of_file(db, f.id))) for f in earlier]


def stored_reports(row: UploadFile) -> list[FileReport]:
    """The reports of a file as they were stored."""
    return [FileReport(**{**r, "problem": Problem(**r["problem"]) if r["problem"] else None}) for r in row.report.get("reports", [])]
