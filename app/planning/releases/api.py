"""REST routes of released policies."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.learning.deps import CurrentPolicy
from app.planning.bundles.service import Limits
from app.planning.releases import service
from app.planning.releases.schemas import PolicyReleaseIn, PolicyReleaseLimits, PolicyReleaseOut
from app.platform.database import Db
from app.platform.signatures.schemas import SignatureOut
from app.platform.web.schemas import problems
from app.tables.learning import Policy
from app.tables.participants import Participant

router = APIRouter(tags=["planning"], responses=problems(401, 403, 404, 422))


@router.get("/policies/{policy_id}/release")
def read_release(policy: CurrentPolicy, db: Db) -> PolicyReleaseOut:
    """Whether a policy is released for testing in participants, within which limits, and whether the signature stands."""
    return _out(policy, service.release_of(db, db.get_one(Participant, policy.participant_id), policy))


@router.post("/policies/{policy_id}/release", status_code=201, responses=problems(409, 429))
def release_policy(policy: CurrentPolicy, wanted: PolicyReleaseIn, db: Db, caller: CurrentCaller) -> PolicyReleaseOut:
    """Sign a policy as released for testing in participants: its file, its snapshot and settings, and the limits in mA.

    Those who approve plans alone, and a policy made elsewhere, and what was made from it, not by whoever added it.
    """
    participant = db.get_one(Participant, policy.participant_id)
    limits = Limits(wanted.min_ma, wanted.max_ma, wanted.ramp_ma_per_s)
    found = service.release(db, participant, policy, limits, wanted.hemisphere, caller, wanted.password, wanted.code)
    return _out(policy, found)


def _out(policy: Policy, found: service.Release) -> PolicyReleaseOut:
    return PolicyReleaseOut(
        policy_id=policy.id,
        signature_state=found.state,
        signature=SignatureOut.model_validate(found.signature) if found.signature else None,
        limits=PolicyReleaseLimits.model_validate(found.limits) if found.limits else None,
    )
