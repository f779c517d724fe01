"""API types of visit plans."""

from __future__ import annotations

import datetime as dt
from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, model_validator

from app.evaluation.schemas import EstimateSummary
from app.planning.notices import Code
from app.planning.protocol.schedule import Order
from app.platform.audit.signatures import SignatureOut, Signing
from app.platform.web.schemas import Bool, Int, Model, Number, Text
from app.tables.participants import Hemisphere
from app.tables.sessions import Controller
from ml.designs import SessionDesign
from ml.ope.posterior.further_sessions import MOST_HELD

Id = Annotated[Int, Field(ge=1)]
Milliamperes = Annotated[Number, Field(ge=0, le=25.5)]


class PlanOptions(Model):
    """Layout of a visit day; omitted options take the default."""

    minutes_per_session: Number = Field(10.0, ge=5, le=20, description="Length of every session but no-DBS, minutes.")
    total_minutes: Number = Field(120.0, gt=0, le=1440, description="From the first session's start to the last one's end, at most.")
    washout_minutes: Number = Field(5.0, ge=0, le=120, description="Pause on the clinical stimulation after each session but the last.")
    no_dbs: Bool = Field(False, description="One session without stimulation, at the end.")
    no_dbs_minutes: Number = Field(5.0, ge=5, le=20, description="Length of the session without stimulation; no longer than another.")
    repeats: Int = Field(1, ge=1, le=4, description="Sessions of each policy within the visit.")
    order: Order = Field(
        Order.DRAWN,
        description="Of the policies: drawn from the seed, a Latin square or Williams' design that goes on "
        "from visit to visit, or as `policy_ids` names them.",
    )
    break_minutes: Number = Field(0.0, ge=0, le=240, description="One rest in the middle of the visit; 0 for none.")
    starts_at: dt.time | None = Field(None, description="Time of day of the first session, by the clinic's clock.")
    blinded: Bool = Field(False, description="Run the visit under letters; which is which stays sealed from the signature on.")
    random_sessions: Int = Field(0, ge=0, le=10, description="Sessions of the random controller.")
    hemisphere: Hemisphere | None = Field(
        None, description="Side whose amplitude the controllers set; needed where the visit states a cDBS amplitude of both."
    )
    min_ma: Milliamperes | None = Field(
        None, description="Lowest amplitude of the controllers, mA; the stimulator's own limit where not given, or 0 where none is known."
    )
    max_ma: Milliamperes | None = Field(None, description="Highest amplitude of the controllers, mA; the cDBS amplitude where not given.")
    ramp_ma_per_s: Number | None = Field(
        None, gt=0, le=100, description="Fastest change, mA/s; the cDBS amplitude within one period where not given."
    )
    seed: Int | None = Field(None, ge=0, description="Draws the order; without one it is drawn too, and recorded.")
    evaluation_id: Id | None = Field(
        None,
        description="Ranking that the choice rests on; the participant's newest where not given. Besides an older one the newest counts "
        "too. Policies that are unsafe by either need a reason, and a test with care has the higher limit of both.",
    )
    note: Text = Field("", max_length=4000)
    reason: Text | None = Field(
        None, max_length=1000, description="Why an approved plan is replaced; needed then, recorded in the audit trail."
    )


class OverrideIn(Model):
    """Reason why an unsafe policy is planned all the same."""

    policy_id: Id
    reason: Text = Field(max_length=1000)


class LimitIn(Model):
    """The lowest amplitude under which a policy may run."""

    policy_id: Id
    min_fraction: Number = Field(gt=0, le=1, description="Fraction of the cDBS amplitude.")


class HeldIn(Model):
    """Sessions near a stated amplitude, as a verdict requests."""

    amplitude_ma: Milliamperes | None = Field(None, description="Near which, mA; either this or `amplitude_fraction`.")
    amplitude_fraction: Number | None = Field(None, gt=0, lt=1, description="Near which, fraction of the cDBS amplitude.")
    sessions: Int = Field(1, ge=1, le=MOST_HELD)

    @model_validator(mode="after")
    def _one_amplitude(self) -> HeldIn:
        if (self.amplitude_ma is None) == (self.amplitude_fraction is None):
            raise ValueError("give either amplitude_ma or amplitude_fraction")
        return self


class PlanIn(PlanOptions):
    """A plan to draft."""

    policy_ids: list[Id] = Field(
        default_factory=list,
        max_length=20,
        description="Policies to test, in `repeats` sessions each; none for a visit of random sessions alone.",
    )
    held: list[HeldIn] = Field(
        default_factory=list,
        max_length=5,
        description="Sessions held near an amplitude, at or above the participant's lower bound; they count as the random arm.",
    )
    overrides: list[OverrideIn] = Field(
        default_factory=list, max_length=20, description="For each unsafe policy the reason of a clinician who may approve plans."
    )
    limits: list[LimitIn] = Field(
        default_factory=list,
        max_length=20,
        description="Lowest amplitudes; a policy to be tested with care takes that of its verdict where none is given, and none below it.",
    )


class Approval(Signing):
    """A signature under a draft."""

    plan_id: Id | None = Field(None, description="Which draft was read; a guard against signing one that was replaced meanwhile.")


class PlanEstimateOut(EstimateSummary):
    """Estimate of a policy in the pinned ranking."""

    method: str


class PlannedHoldOut(Model):
    """One sustained amplitude."""

    start: int = Field(description="First step.")
    steps: int
    amplitude: float = Field(description="Fraction of the cDBS amplitude.")
    log_density: float | None = Field(description="Given the session's level and the bound in force; null where nothing is drawn.")


class BoundOut(Model):
    """Amplitudes of one side, mA."""

    side: str | None
    cdbs_ma: float
    lowest_ma: float = Field(description="No step is below it.")
    low_ma: float = Field(description="Below it the session stays for five minutes at most, at its end.")


class PlannedDesignOut(Model):
    """Design of a random session."""

    design: SessionDesign
    level: float | None = Field(description="Of the session, fraction of the cDBS amplitude; null where it has none.")
    seed: int | None
    lower_bound: float
    period_s: float
    holds: list[PlannedHoldOut] = Field(description="In order; empty in the paper's design, where the device draws again at every step.")
    bounds: list[BoundOut] = Field(
        description="As they stood when the plan was approved, in a draft as of today; empty where the cDBS amplitude is not known."
    )


class PlannedSessionOut(Model):
    """One session of a plan."""

    position: int
    start_minute: float = Field(description="From the first session's start.")
    controller: Controller | None = Field(description="Null while the key of a blinded plan is sealed, with all that would reveal it.")
    policy_id: int | None
    policy: str | None
    minutes: float
    washout_minutes: float
    break_minutes: float
    medication: str
    estimate: PlanEstimateOut | None
    predicted_energy: float | None = Field(description="Mean squared amplitude fraction; cDBS = 1.")
    verdict: str | None = Field(
        description="Verdict of the ranking when the plan was drafted, the strictest where the plan rests on an older one. "
        "Null for what is not ranked, but `unsafe` after a serious adverse event that no clinician has cleared."
    )
    min_fraction: float | None = Field(description="Lowest amplitude of the session, fraction of the cDBS amplitude.")
    override_reason: str | None = Field(description="Why a clinician plans an unsafe policy all the same.")
    repeat: int = Field(description="Which session of this policy or controller within the visit, from 1.")
    label: str | None = Field(description="What a blinded visit calls it.")
    hemisphere: Hemisphere | None = Field(description="Side whose amplitude the controller sets; null where none is stated.")
    cdbs_ma: float | None = Field(description="The clinical amplitude that the limits were set for; null where it was not known.")
    min_ma: float | None = Field(
        description="No amplitude is below it, mA; null in plans of older versions, and where no limit could be set."
    )
    max_ma: float | None = Field(description="No amplitude is above it, mA.")
    ramp_ma_per_s: float | None = Field(description="Fastest change, mA/s.")
    design: PlannedDesignOut | None = Field(description="Of a random session: what it shall try; null in plans of older versions.")


class PlanEvaluationOut(Model):
    """The ranking that a plan rests on."""

    id: int
    created_at: datetime
    method: str
    horizon_steps: int
    gamma: float
    snapshot_id: int


class PlanWarningOut(Model):
    """Warning for the person who signs or runs a plan. Programs read the code; the text may be reworded."""

    code: Code
    policy_id: int | None = Field(description="Whom it is about; null for the whole plan.")
    text: str


class KeyOut(Model):
    """The key of a blinded plan: which letter is which controller."""

    sealed: bool = Field(description="Until it is opened, sessions show their letters and the limits that apply to all alike.")
    opened_at: datetime | None
    opened_by: str | None
    reason: str | None = Field(description="Null after an emergency for which it is not given yet.")
    emergency: bool


class KeyOpening(Model):
    """Reason why the key of a blinded plan is opened."""

    reason: Text = Field("", max_length=1000, description="Needed but in an emergency, after which it is given by a second call.")
    emergency: Bool = False


class Move(Model):
    """Move of a tested session: it changes places with the tested one before or after it, so many times."""

    position: Id
    earlier: Bool
    places: Int = Field(1, ge=1, le=20, description="How many tested sessions it passes.")


class Removal(Model):
    """Reason why a visit in which nothing was done is removed."""

    reason: Text = Field(max_length=1000)


class PlanOut(Model):
    """The plan of a visit."""

    id: int
    visit_id: int
    visit: int
    date: dt.date | None
    participant: str
    status: str = Field(description="draft, approved or superseded.")
    seed: int | None = Field(description="Of the order's draw; null while the key of a blinded plan is sealed.")
    note: str
    created_at: datetime
    created_by: str
    approved_at: datetime | None
    approved_by: str | None
    signature: SignatureOut | None = Field(description="The newest under this plan, standing or not.")
    signature_state: Literal["none", "stands", "broken", "not_kept"] = Field(
        description="Whether it is valid; `broken` when anything signed has changed since, `not_kept` for plans of earlier versions."
    )
    starts_at: dt.time | None
    order: Order
    block: int = Field(description="Visits before this one that followed the same square.")
    key: KeyOut | None = Field(description="Of a blinded plan; null for others.")
    total_minutes: float
    evaluation: PlanEvaluationOut | None
    stale: bool = Field(description="The ranking no longer speaks about the study as it is.")
    warnings: list[PlanWarningOut]
    sessions: list[PlannedSessionOut]
