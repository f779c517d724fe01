"""API types of margins and levels."""

from __future__ import annotations

from datetime import datetime

from pydantic import ConfigDict, Field, ValidationInfo, field_validator

from app.platform.signatures.schemas import SignatureOut, Signing
from app.platform.signatures.service import SignatureState
from app.platform.web.schemas import Int, Model, Number, Text
from app.study.outcome_fields import StatedMargins
from app.study.settings.schemas import Bound, published
from ml.outcomes import OUTCOMES

BOUNDS = {
    **{o.margin.field: Bound(o.margin.least, o.margin.most, o.margin.unit) for o in OUTCOMES},
    "test_within": Bound(0.5, 0.99),
    "test_saves": Bound(0.5, 0.99),
    "unsafe_beyond": Bound(0.05, 0.9),
    "nearly_off_share": Bound(0, 0.9, "of the steps"),
}
"""What may be stated. A level of *unsafe* above 0.9 would let a policy pass that is nearly surely worse."""


class MarginsFields(StatedMargins):
    """By how much an outcome may be worse than under cDBS, and how sure a proposal must be of it."""

    test_within: Number = Field(0.8, description="Probability of keeping all outcomes within the margins from which a test is proposed.")
    test_saves: Number = Field(0.9, description="Probability of using less energy than cDBS from which a test is proposed.")
    unsafe_beyond: Number = Field(0.5, description="Probability that an outcome lies beyond its margin from which a policy is unsafe.")
    nearly_off_share: Number = Field(0.2, description="Share of steps below 0.2 of the cDBS amplitude above which a policy is unsafe.")


class MarginsIn(MarginsFields):
    """Margins and levels; what is left out keeps its present value."""

    model_config = ConfigDict(json_schema_extra=published(BOUNDS))

    @field_validator(*BOUNDS)
    @classmethod
    def _within_bounds(cls, value: float, info: ValidationInfo) -> float:
        return BOUNDS[str(info.field_name)].check(value)


class MarginsOut(MarginsFields):
    """A version of a participant's margins and levels."""

    version: int
    created_at: datetime
    created_by: str
    reason: str | None = Field(description="Null for the defaults of an enrolment.")


class MarginsChange(Model):
    """New margins or levels, and why."""

    margins: MarginsIn
    reason: Text = Field(max_length=1000)


class MarginsLockFields(Model):
    """Which margins to lock, and why."""

    version: Int = Field(ge=1, le=100_000, description="Of the present margins, as the caller has read them.")
    reason: Text = Field(max_length=1000, description="What the margins rest on; kept with the lock and in the audit trail.")


class MarginsLockIn(MarginsLockFields, Signing):
    """Which margins to lock, why, and who signs."""


class MarginsLockOut(Model):
    """Margins that were locked."""

    version: int
    reason: str
    created_at: datetime
    created_by: str
    signature: SignatureOut | None
    signature_state: SignatureState = Field(description="`broken`: a value was changed since. `not_kept`: locked by an earlier version.")
