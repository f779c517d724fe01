"""Queries of the tables of data queries, within what the caller may read."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session, joinedload, selectinload

from app.accounts.permissions import Caller
from app.platform.errors import NotFound
from app.study.repository import in_scope
from app.tables.data_queries import DataQuery, DataQueryEntry, QueryState
from app.tables.participants import Participant
from app.tables.uploads import Upload
from app.tables.visits import Dose, Visit


def data_query(db: Session, query_id: int, caller: Caller) -> DataQuery:
    """A query. Raises NotFound."""
    mine = _queries().join(DataQuery.participant).join(Participant.site).where(DataQuery.id == query_id, in_scope(caller))
    row = db.scalar(mine)
    if row is None:
        raise NotFound(f"There is no data query {query_id}, or you have no access to it.")
    return row


def queries_of_participant(db: Session, participant_id: int) -> Sequence[DataQuery]:
    """A participant's queries in the order in which they were asked."""
    return db.scalars(_queries().where(DataQuery.participant_id == participant_id).order_by(DataQuery.id)).all()


def numbers_of_session(db: Session, session_id: int) -> list[int]:
    """The numbers of all queries about a session, closed ones too."""
    return list(db.scalars(select(DataQuery.id).where(DataQuery.session_id == session_id).order_by(DataQuery.id)))


def not_closed_of_session(db: Session, session_id: int) -> int:
    """How many queries about a session are not closed."""
    newest = select(func.max(DataQueryEntry.id)).join(DataQuery).where(DataQuery.session_id == session_id).group_by(DataQuery.id)
    waiting = select(func.count()).where(DataQueryEntry.id.in_(newest), DataQueryEntry.state != QueryState.CLOSED)
    return db.scalar(waiting) or 0


def lock_query(db: Session, row: DataQuery) -> None:
    """Hold a query for this transaction and read its entries again, so that two answers at once are taken in turn."""
    db.execute(select(DataQuery.id).where(DataQuery.id == row.id).with_for_update())
    db.expire(row, ["entries"])


def dose_of(db: Session, participant_id: int, dose_id: int) -> Dose | None:
    """A dose of the participant; None without one, or where it was taken back."""
    return db.scalar(select(Dose).join(Visit, Visit.id == Dose.visit_id).where(Dose.id == dose_id, Visit.participant_id == participant_id))


def visit_number(db: Session, visit_id: int | None) -> int | None:
    """The number that people give a visit."""
    return db.scalar(select(Visit.number).where(Visit.id == visit_id))


def upload_of(db: Session, participant_id: int, upload_id: int) -> bool:
    """Return True for an upload of the participant."""
    return db.scalar(select(Upload.id).where(Upload.id == upload_id, Upload.participant_id == participant_id)) is not None


def _queries() -> Select[DataQuery]:
    return select(DataQuery).options(
        selectinload(DataQuery.entries), joinedload(DataQuery.participant).joinedload(Participant.site), joinedload(DataQuery.session)
    )
