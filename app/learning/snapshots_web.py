"""REST routes of buffer snapshots."""

from __future__ import annotations

from fastapi import APIRouter
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.learning import repository, snapshots
from app.learning.deps import CurrentSnapshot
from app.learning.schemas import SnapshotOut, SnapshotSessionOut
from app.platform.database import Db
from app.platform.web.schemas import Page, PagingQuery, problems
from app.study import repository as study_repository
from app.study.deps import CurrentParticipant
from app.tables.learning import BufferSnapshot
from app.tables.participants import Participant

api = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


def snapshot_out(db: Session, s: BufferSnapshot, participant: Participant) -> SnapshotOut:
    """Convert a snapshot for the API."""
    return SnapshotOut(
        id=s.id,
        participant=participant.code,
        settings_version=study_repository.settings_version(db, s.settings_version_id).version,
        characteristics_version=next((c.version for c in participant.characteristics if c.id == s.characteristics_id), None),
        pins_sha256=s.pins_sha256,
        file_sha256=s.file_sha256,
        sessions=s.sessions,
        steps=s.steps,
        median_steps=s.median_steps,
        beta_unit=s.beta_unit,
        beta_source=s.beta_source,
        created_at=s.created_at,
        created_by=s.created_by,
        members=[SnapshotSessionOut.model_validate(m, from_attributes=True) for m in s.members],
    )


@api.get("/participants/{code}/snapshots")
def list_snapshots(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[SnapshotOut]:
    """List buffer snapshots of a participant, newest first."""
    rows, total = repository.snapshots(db, participant.id, paging.limit, paging.offset)
    return Page(items=[snapshot_out(db, s, participant) for s in rows], total=total, limit=paging.limit, offset=paging.offset)


@api.post("/participants/{code}/snapshots", status_code=201)
def take_snapshot(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> SnapshotOut:
    """Pin the present replay buffer; the same data give the same snapshot."""
    row = snapshots.take_snapshot(db, participant, caller)
    return snapshot_out(db, row, participant)


@api.get("/snapshots/{snapshot_id}")
def read_snapshot(snapshot: CurrentSnapshot, db: Db) -> SnapshotOut:
    """Return one snapshot with its sessions, and why others were excluded."""
    return snapshot_out(db, snapshot, db.get_one(Participant, snapshot.participant_id))
