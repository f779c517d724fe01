"""Rules of ending studies and sites. The caller commits."""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.accounts import studies
from app.accounts.permissions import Caller
from app.platform.jobs import service as jobs
from app.study import repository
from app.tables.accounts import Study


def end_study(db: Session, study: Study, reason: str, caller: Caller) -> None:
    """End a study: it is read and exported, nothing in it changes, and it is not on Today. Its jobs that run are cancelled.

    Who may what is asked at every call (`Grant.holds`), so that it holds at once for whatever people have open.

    Raises:
        Conflict: it has ended already.
    """
    studies.set_ended(db, study, True, reason)
    for participant_id in repository.participants_of_study(db, study.id):
        for job in jobs.live_of(db, participant_id):
            jobs.cancel(db, job, caller.label)


def reopen_study(db: Session, study: Study, reason: str) -> None:
    """Open a study that has ended; its sites are as they were. Raises Conflict where it has not."""
    studies.set_ended(db, study, False, reason)


def end_site(db: Session, study: Study, code: str, reason: str) -> None:
    """End a site: it takes neither enrolments nor uploads; all else goes on. Raises NotFound, Conflict."""
    studies.set_ended(db, studies.site_of(db, study, code), True, reason)


def reopen_site(db: Session, study: Study, code: str, reason: str) -> None:
    """Open a site that has ended. Raises NotFound, Conflict."""
    studies.set_ended(db, studies.site_of(db, study, code), False, reason)
