"""Tremor minutes and grasp tests on their way from a decoded file to the QoCs of sessions."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from app.platform.errors import Invalid
from app.study.outcomes import service as outcomes
from app.tables.sessions import StudySession
from app.tables.uploads import UploadFile
from ml.formats import GraspLog, TremorLog

NO_SESSION = (
    "A grasp file names no clock, so that nobody can tell its session from it: it is kept. Attach it on the page of proposals, "
    "or upload it again and name the session."
)


def take_tremor(db: Session, file: UploadFile, logs: Sequence[TremorLog]) -> list[str]:
    """Keep a file's tremor minutes; sentences for the report, on the sessions whose tremor was derived from them too."""
    said: list[str] = []
    for log in logs:
        said += outcomes.store_tremor(
            db, file.participant_id, file.id, log.start_unix_s, log.duration_s, log.fractions, log.any_tremor
        )  # fmt: skip
    return said


def take_grasps(db: Session, file: UploadFile, logs: Sequence[GraspLog], session: StudySession | None) -> list[str]:
    """Attach a file's grasp tests to a session; without one the file waits, and the report says how to attach it.

    Raises:
        Invalid: the session is another participant's.
    """
    if not logs:
        return []
    if session is None:
        return [NO_SESSION]
    if session.visit.participant_id != file.participant_id:
        raise Invalid(f"Session {session.id} belongs to another participant.", "Choose one of this participant's sessions.")
    file.session_id = session.id
    said: list[str] = []
    for log in logs:
        said += outcomes.store_grasp(db, session, file.id, log.hand, log.open_fist_s, log.implausible)
    db.flush()
    return said


def derive(db: Session, session: StudySession) -> list[str]:
    """Derive a session's QoCs again, after it was confirmed or its times changed."""
    return outcomes.derive_for_session(db, session)


def give_up(db: Session, session: StudySession) -> None:
    """Remove the grasp tests of a proposal before it is deleted: they stay as removed rows."""
    outcomes.give_up(db, session)
