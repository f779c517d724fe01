"""Rules of taking part. The caller commits."""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.jobs import service as jobs
from app.study.access import WITHDRAWN, require
from app.study.participation.schemas import StatusChange
from app.tables.participants import Participant


def change_status(db: Session, participant: Participant, change: StatusChange, caller: Caller) -> Participant:
    """Say that a participant has completed the study, has withdrawn, or takes part again.

    Nothing is deleted. Who has withdrawn is no longer listed among those who take part, takes neither data nor plans nor jobs nor
    controllers, and the jobs that run for them are cancelled.

    Raises:
        NotFound, Forbidden: as `require`.
    """
    require(caller, can.WRITE_STUDY, participant)
    if participant.status == change.status:
        return participant
    set_reason(db, change.reason)
    participant.status = change.status
    db.flush()
    if change.status == WITHDRAWN:
        for job in jobs.live_of(db, participant.id):
            jobs.cancel(db, job, caller.label)
    return participant
