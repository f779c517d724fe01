"""REST routes of buffer snapshots."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.learning import repository
from app.learning.deps import CurrentSnapshot
from app.learning.schemas import SnapshotOut
from app.learning.serializers import snapshot_out
from app.learning.snapshots import service as snapshots
from app.platform.database import Db
from app.platform.web.schemas import Page, PagingQuery, problems
from app.study.deps import CurrentParticipant
from app.tables.participants import Participant

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/snapshots")
def list_snapshots(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[SnapshotOut]:
    """Buffer snapshots of a participant, newest first."""
    rows, total = repository.snapshots(db, participant.id, paging.limit, paging.offset)
    return Page(items=[snapshot_out(db, s, participant) for s in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.post("/participants/{code}/snapshots", status_code=201)
def take_snapshot(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> SnapshotOut:
    """Pin the replay buffer as it is now; the same data give the same snapshot."""
    row = snapshots.take_snapshot(db, participant, caller)
    return snapshot_out(db, row, participant)


@router.get("/snapshots/{snapshot_id}")
def read_snapshot(snapshot: CurrentSnapshot, db: Db) -> SnapshotOut:
    """One snapshot with its sessions, and why others were left out."""
    return snapshot_out(db, snapshot, db.get_one(Participant, snapshot.participant_id))
