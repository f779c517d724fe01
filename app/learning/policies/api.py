"""REST routes of policies."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, File, Form, UploadFile
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.learning import repository
from app.learning.deps import CurrentPolicy
from app.learning.policies import service
from app.learning.policies.uploads import read_limited
from app.learning.schemas import PolicyChange, PolicyName, PolicyOut
from app.platform.database import Db
from app.platform.web.schemas import Page, PagingQuery, problems
from app.study import repository as study_repository
from app.study.deps import CurrentParticipant
from app.tables.learning import Policy
from app.tables.participants import Participant

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


def policy_out(db: Session, p: Policy, participant: Participant) -> PolicyOut:
    """Convert a policy for the API."""
    return PolicyOut(
        id=p.id,
        participant=participant.code,
        name=p.name,
        kind=p.kind,
        algorithm=p.algorithm,
        teacher_id=p.teacher_id,
        parent_id=p.parent_id,
        snapshot_id=p.snapshot_id,
        settings_version=study_repository.settings_version(db, p.settings_version_id).version,
        job_id=p.job_id,
        config=p.config,
        seed=p.seed,
        metrics=p.metrics,
        onnx_sha256=p.onnx_sha256,
        code_version=p.code_version,
        created_at=p.created_at,
        created_by=p.created_by,
        retired_reason=p.retired_reason,
    )


@router.get("/participants/{code}/policies")
def list_policies(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[PolicyOut]:
    """Policies of a participant, newest first; baselines and retired ones among them."""
    rows, total = repository.policies(db, participant.id, paging.limit, paging.offset)
    return Page(items=[policy_out(db, p, participant) for p in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.post("/participants/{code}/policies", status_code=201, responses=problems(409, 413, 429))
def add_policy(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    name: Annotated[PolicyName, Form(description="How the study calls it.")],
    file: Annotated[
        UploadFile, File(description="ONNX: input [N, W] of beta windows, oldest first; output [N, 1] of amplitude fractions.")
    ],
) -> PolicyOut:
    """Add a policy made elsewhere; it is checked by running it."""
    row = service.add_external(db, participant, name.strip(), read_limited(file), file.filename or "policy.onnx", caller)
    return policy_out(db, row, participant)


@router.get("/policies/{policy_id}")
def read_policy(policy: CurrentPolicy, db: Db) -> PolicyOut:
    """One policy."""
    return policy_out(db, policy, db.get_one(Participant, policy.participant_id))


@router.patch("/policies/{policy_id}")
def change_policy(policy: CurrentPolicy, change: PolicyChange, db: Db, caller: CurrentCaller) -> PolicyOut:
    """Retire a policy with a reason, or take it back."""
    participant = db.get_one(Participant, policy.participant_id)
    service.retire(db, participant, policy, change.retired_reason, caller)
    return policy_out(db, policy, participant)
