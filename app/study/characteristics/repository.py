"""Queries of characteristics."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.outcomes import GraspTest
from app.tables.sessions import StudySession
from app.tables.visits import Visit


def sessions_with_grasp_tests(db: Session, participant_id: int) -> Sequence[StudySession]:
    """Confirmed sessions of a participant that have a grasp test from a file, by number."""
    tested = select(GraspTest.session_id).where(GraspTest.removed_at.is_(None))
    mine = (Visit.participant_id == participant_id) & (StudySession.status == "confirmed") & StudySession.id.in_(tested)
    return db.scalars(select(StudySession).join(StudySession.visit).where(mine).order_by(StudySession.id)).all()
