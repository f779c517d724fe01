"""Queries of what recordings say beside their traces."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload

from app.tables.recordings import Recording
from app.tables.sessions import StudySession
from app.tables.visits import Visit


def histories(db: Session, participant_id: int) -> Sequence[Recording]:
    """What devices of a participant told of their own history, the newest first."""
    query = select(Recording).options(joinedload(Recording.device)).where(Recording.participant_id == participant_id)
    query = query.where(Recording.details["settings"]["section"].astext == "history")
    return db.scalars(query.order_by(Recording.started_at.desc().nulls_last(), Recording.id.desc())).all()


def sealed_days(db: Session, participant_id: int) -> frozenset[dt.date]:
    """Days (UTC) of a participant's visits whose blinded plan's key is sealed, and those on which their sessions were held."""
    sealed = (Visit.participant_id == participant_id) & Visit.sealed
    dated = db.scalars(select(Visit.date).where(sealed, Visit.date.is_not(None)))
    began = db.scalars(select(StudySession.started_at).join(Visit).where(sealed, StudySession.started_at.is_not(None)))
    return frozenset([*(d for d in dated if d), *(at.astimezone(dt.UTC).date() for at in began if at)])


def with_battery(db: Session, participant_id: int) -> Sequence[Recording]:
    """Recordings and reports that tell the charge or voltage of the stimulator's battery, the newest first."""
    query = select(Recording).options(joinedload(Recording.device)).where(Recording.participant_id == participant_id)
    query = query.where(Recording.details["settings"]["battery"].astext.is_not(None), Recording.superseded_by_id.is_(None))
    return db.scalars(query.order_by(Recording.started_at.desc().nulls_last(), Recording.id.desc())).all()
