"""Queries of what tremor and grasp files gave."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.outcomes import GraspTest, TremorSeries


def tremor_series(
    db: Session, participant_id: int, start: datetime, stop: datetime, but_file_id: int | None = None
) -> Sequence[TremorSeries]:
    """Files of minutes of tremor that reach into a stretch of time, oldest first; one of them can be left out, for each may be a year."""
    reaching = (TremorSeries.last_end_at > start) & (TremorSeries.first_start_at < stop)
    own = select(TremorSeries).where(TremorSeries.participant_id == participant_id, reaching, TremorSeries.removed_at.is_(None))
    if but_file_id is not None:
        own = own.where(TremorSeries.upload_file_id != but_file_id)
    return db.scalars(own.order_by(TremorSeries.upload_file_id)).all()


def tremor_series_of_file(db: Session, participant_id: int, upload_file_id: int) -> TremorSeries | None:
    """The minutes of tremor that a file gave."""
    own = (TremorSeries.participant_id == participant_id) & (TremorSeries.upload_file_id == upload_file_id)
    return db.scalar(select(TremorSeries).where(own, TremorSeries.removed_at.is_(None)))


def grasp_tests(db: Session, session_id: int) -> Sequence[GraspTest]:
    """The grasp tests of a session, oldest file first."""
    mine = (GraspTest.session_id == session_id) & GraspTest.removed_at.is_(None)
    return db.scalars(select(GraspTest).where(mine).order_by(GraspTest.upload_file_id, GraspTest.id)).all()


def grasp_tests_of_file(db: Session, upload_file_id: int) -> Sequence[GraspTest]:
    """The grasp tests that a file gave, of whatever session."""
    return db.scalars(select(GraspTest).where(GraspTest.upload_file_id == upload_file_id, GraspTest.removed_at.is_(None))).all()
