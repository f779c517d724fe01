"""REST routes of released policies."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter
from pydantic import Field

from app.accounts.deps import CurrentCaller
from app.learning.deps import CurrentPolicy
from app.planning import releases
from app.planning.bundles import release
from app.planning.bundles.service import Limits
from app.platform.audit.signatures import SignatureOut, SignatureState, Signing
from app.platform.database import Db
from app.platform.web.schemas import Model, Number, problems
from app.tables.learning import Policy
from app.tables.participants import Hemisphere, Participant

api = APIRouter(tags=["planning"], responses=problems(401, 403, 404, 422))

Milliamperes = Annotated[Number, Field(ge=0, le=25.5)]


class PolicyReleaseIn(Signing):
    """Within which limits a policy is released, and who signs."""

    min_ma: Milliamperes | None = Field(None, description="Lowest amplitude, mA; null: the default of a bundle.")
    max_ma: Milliamperes | None = Field(None, description="Highest amplitude, mA; null: the cDBS amplitude.")
    ramp_ma_per_s: Number | None = Field(None, gt=0, le=100, description="Fastest change, mA/s; null: the default of a bundle.")
    hemisphere: Hemisphere | None = Field(None, description="Needed where a visit states several cDBS amplitudes.")


class PolicyReleaseLimits(Model):
    """Limits that were signed with a release."""

    hemisphere: Hemisphere | None
    cdbs_ma: float
    min_ma: float
    max_ma: float
    ramp_ma_per_s: float


class PolicyReleaseOut(Model):
    """Release of a policy for testing in participants."""

    policy_id: int
    signature_state: SignatureState = Field(description="`none`: not released. `broken`: the policy was changed since.")
    signature: SignatureOut | None = Field(description="The newest under this policy, standing or not.")
    limits: PolicyReleaseLimits | None


@api.get("/policies/{policy_id}/release")
def read_release(policy: CurrentPolicy, db: Db) -> PolicyReleaseOut:
    """Return whether a policy is released for testing in participants, within which limits, and the state of the signature."""
    return _out(policy, releases.release_of(db, db.get_one(Participant, policy.participant_id), policy))


@api.post("/policies/{policy_id}/release", status_code=201, responses=problems(409, 429))
def release_policy(policy: CurrentPolicy, wanted: PolicyReleaseIn, db: Db, caller: CurrentCaller) -> PolicyReleaseOut:
    """Sign a policy as released for testing in participants: its file, its snapshot and settings, and the limits in mA.

    Only those who approve plans may. A policy made elsewhere, and those made from it, cannot be released by the user who added it.
    """
    participant = db.get_one(Participant, policy.participant_id)
    limits = Limits(wanted.min_ma, wanted.max_ma, wanted.ramp_ma_per_s)
    found = release.release(db, participant, policy, limits, wanted.hemisphere, caller, wanted.password, wanted.code)
    return _out(policy, found)


def _out(policy: Policy, found: releases.Release) -> PolicyReleaseOut:
    return PolicyReleaseOut(
        policy_id=policy.id,
        signature_state=found.state,
        signature=SignatureOut.model_validate(found.signature) if found.signature else None,
        limits=PolicyReleaseLimits.model_validate(found.limits) if found.limits else None,
    )
