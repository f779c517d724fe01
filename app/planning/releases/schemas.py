"""API types of released policies."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from app.platform.signatures.schemas import SignatureOut, Signing
from app.platform.signatures.service import SignatureState
from app.platform.web.schemas import Model, Number
from app.tables.participants import Hemisphere

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
    """Whether a policy is released for testing in participants."""

    policy_id: int
    signature_state: SignatureState = Field(description="`none`: not released. `broken`: the policy was changed since.")
    signature: SignatureOut | None = Field(description="The newest under this policy, standing or not.")
    limits: PolicyReleaseLimits | None
