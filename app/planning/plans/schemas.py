"""API types of visit plans."""

from __future__ import annotations

import datetime as dt
from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from app.evaluation.schemas import EstimateSummary
from app.platform.web.schemas import Bool, Int, Model, Number, Text
from app.study.models import Controller, Hemisphere

Id = Annotated[Int, Field(ge=1)]
Milliamperes = Annotated[Number, Field(ge=0, le=25.5)]


class PlanOptions(Model):
    """How a visit day shall be laid out; what is left out takes the default."""

    minutes_per_session: Number = Field(10.0, ge=5, le=20, description="Length of every session but no-DBS, minutes.")
    total_minutes: Number = Field(120.0, gt=0, le=1440, description="From the first session's start to the last one's end, at most.")
    washout_minutes: Number = Field(5.0, ge=0, le=120, description="Pause on the clinical stimulation after each session but the last.")
    no_dbs: Bool = Field(False, description="One session without stimulation, 5 minutes, at the end.")
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
    evaluation_id: Id | None = Field(None, description="Ranking that the choice rests on; the participant's newest where not given.")
    note: Text = Field("", max_length=4000)
    reason: Text | None = Field(
        None, max_length=1000, description="Why an approved plan is replaced; needed then, recorded in the audit trail."
    )


class OverrideIn(Model):
    """Why an unsafe policy is planned all the same."""

    policy_id: Id
    reason: Text = Field(max_length=1000)


class LimitIn(Model):
    """The lowest amplitude under which a policy may run."""

    policy_id: Id
    min_fraction: Number = Field(gt=0, le=1, description="Fraction of the cDBS amplitude.")


class PlanIn(PlanOptions):
    """A plan to draft."""

    policy_ids: list[Id] = Field(
        default_factory=list, max_length=20, description="Policies to test, each in one session; none for a visit of random sessions alone."
    )
    overrides: list[OverrideIn] = Field(
        default_factory=list, max_length=20, description="For each unsafe policy the reason of a clinician who may approve plans."
    )
    limits: list[LimitIn] = Field(
        default_factory=list,
        max_length=20,
        description="Lowest amplitudes; a policy to be tested with care takes that of its verdict where none is given, and none below it.",
    )


class Approval(Model):
    """A signature under a draft."""

    password: Text = Field(max_length=1000, description="The signer's own, asked for again.")
    plan_id: Id | None = Field(None, description="Which draft was read; a guard against signing one that somebody replaced meanwhile.")


class SignatureOut(Model):
    """Who signed, when, and with which meaning."""

    signer: str
    signed_at: datetime
    meaning: str
    sha256: str = Field(description="Of the canonical JSON of all that was signed.")


class PlanEstimateOut(EstimateSummary):
    """What the pinned ranking states of a policy."""

    method: str


class PlannedHoldOut(Model):
    """One amplitude that is held."""

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
    """What a random session shall try."""

    design: Literal["paper", "stratified", "ladder"]
    level: float | None = Field(description="Of the session, fraction of the cDBS amplitude; null where it has none.")
    seed: int | None
    lower_bound: float
    period_s: float
    holds: list[PlannedHoldOut] = Field(description="In order; empty in the paper's design, where the device draws anew every step.")
    bounds: list[BoundOut] = Field(
        description="As they stood when the plan was approved, in a draft as of today; empty where the cDBS amplitude is not known."
    )


class PlannedSessionOut(Model):
    """One session of a plan."""

    position: int
    start_minute: float = Field(description="From the first session's start.")
    controller: Controller
    policy_id: int | None
    policy: str | None
    minutes: float
    washout_minutes: float
    estimate: PlanEstimateOut | None
    predicted_energy: float | None = Field(description="Mean squared amplitude fraction; cDBS = 1.")
    verdict: str | None = Field(description="What the ranking said of the policy when the plan was drafted; null for what is not ranked.")
    min_fraction: float | None = Field(description="Lowest amplitude of the session, fraction of the cDBS amplitude.")
    override_reason: str | None = Field(description="Why a clinician plans an unsafe policy all the same.")
    repeat: int = Field(description="Which session of this policy or controller within the visit, from 1.")
    label: str | None = Field(description="What a blinded visit calls it.")
    hemisphere: Hemisphere | None = Field(description="Side whose amplitude the controller sets; null where none is stated.")
    cdbs_ma: float | None = Field(description="The clinical amplitude that the limits were set for; null where it was not known.")
    min_ma: float | None = Field(description="No amplitude is below it, mA; null in plans of before, and where no limit could be set.")
    max_ma: float | None = Field(description="No amplitude is above it, mA.")
    ramp_ma_per_s: float | None = Field(description="Fastest change, mA/s.")
    design: PlannedDesignOut | None = Field(description="Of a random session: what it shall try; null in plans of before.")


class PlanEvaluationOut(Model):
    """The ranking that a plan rests on."""

    id: int
    created_at: datetime
    method: str
    horizon_steps: int
    gamma: float
    snapshot_id: int


class PlanOut(Model):
    """The plan of a visit."""

    id: int
    visit_id: int
    visit: int
    date: dt.date | None
    participant: str
    status: str = Field(description="draft, approved or superseded.")
    seed: int
    note: str
    created_at: datetime
    created_by: str
    approved_at: datetime | None
    approved_by: str | None
    signature: SignatureOut | None = Field(description="The newest under this plan, standing or not.")
    signature_state: Literal["none", "stands", "broken", "not_kept"] = Field(
        description="Whether it stands; `broken` when anything that was signed has changed since, `not_kept` for plans of earlier versions."
    )
    total_minutes: float
    evaluation: PlanEvaluationOut | None
    stale: bool = Field(description="The ranking no longer speaks about the study as it is.")
    warnings: list[str]
    sessions: list[PlannedSessionOut]
