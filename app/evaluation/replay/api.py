"""REST route of the comparison of policies on a recorded session."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from app.accounts.deps import CurrentCaller
from app.evaluation.replay.schemas import ReplayOut
from app.evaluation.replay.service import MOST, replay
from app.learning import repository as learning
from app.platform.database import Db
from app.platform.web.schemas import RowId, problems
from app.study.deps import CurrentParticipant, ResultsViewed

router = APIRouter(tags=["evaluation"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/replay", dependencies=[ResultsViewed])
def read_replay(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    session: Annotated[RowId, Query(description="A recorded session of the participant.")],
    policy: Annotated[list[RowId], Query(min_length=1, max_length=MOST, description="Policies to compare.")],
) -> ReplayOut:
    """What policies would have asked for on a recorded session's beta: not what would have happened."""
    return replay(db, participant, session, learning.policies_named(db, participant.id, list(dict.fromkeys(policy))), caller)
