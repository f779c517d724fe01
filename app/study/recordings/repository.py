"""Queries of what recordings say beside their traces."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload

from app.study.models import Recording


def histories(db: Session, participant_id: int) -> Sequence[Recording]:
    """What devices of a participant told of their own history, the newest first."""
    query = select(Recording).options(joinedload(Recording.device)).where(Recording.participant_id == participant_id)
    query = query.where(Recording.details["settings"]["section"].astext == "history")
    return db.scalars(query.order_by(Recording.started_at.desc().nulls_last(), Recording.id.desc())).all()


def with_battery(db: Session, participant_id: int) -> Sequence[Recording]:
    """Recordings and reports that tell the charge or voltage of the stimulator's battery, the newest first."""
    query = select(Recording).options(joinedload(Recording.device)).where(Recording.participant_id == participant_id)
    query = query.where(Recording.details["settings"]["battery"].astext.is_not(None), Recording.superseded_by_id.is_(None))
    return db.scalars(query.order_by(Recording.started_at.desc().nulls_last(), Recording.id.desc())).all()
