"""API types of evaluation."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Literal

from pydantic import ConfigDict, Field

from app.evaluation.methods import Methods
from app.learning.schemas import PolicyIds, Preset
from app.platform.web.schemas import Int, Model
from app.study.outcome_fields import fields_model
from ml.outcomes import FIELDS


class EvaluateParams(Model):
    """Parameters of `evaluate`."""

    preset: Preset = Field("full", description="`full`: sizes for a study; `quick`: for a first look.")
    policies: PolicyIds = Field(default_factory=list, description="Policies to rank; empty: every one that is not retired.")
    methods: Methods
    horizon_steps: Int | None = Field(None, ge=1, le=100_000, description="H; the snapshot's median session length where not given.")
    seed: Int = Field(0, ge=0, le=10**6)


RANKING_KINDS = ("pipeline", "next_generation", "evaluate")
"""Kinds of job that end with a ranking."""


class ReasonOut(Model):
    """A finding as values, for programs; `code` says what was found."""

    code: str
    value: float | None = Field(description="What was measured; null where the finding has no number.")
    limit: float | None = Field(description="Limit that the value is compared with.")
    unit: str


class FlagOut(ReasonOut):
    """A finding about an estimate or a policy, with its sentence."""

    text: str = Field(description="For people. Its wording may change; programs read the other fields.")


class EstimateSummary(Model):
    """Members that every view of an estimate has."""

    value: float
    low: float
    high: float
    level: float
    supported: bool
    flags: list[FlagOut]


class EstimateOut(EstimateSummary):
    """One method's estimate of E[r_end + sum over t < H of gamma^t r_t], unnormalised."""

    standard_error: float | None
    step_return: float | None
    end_reward: float | None
    predicted: dict[str, float]
    n: int | None


class _VisitSteps(Model):
    visit: int = Field(description="Its number.")
    energy_difference: float | None
    mean_beta_difference: float | None


if TYPE_CHECKING:
    _VisitMeans = _VisitSteps
else:
    _VisitMeans = fields_model("_VisitMeans", lambda o: {f"{o.field}_difference": (float | None, ...)}, _VisitSteps)


class VisitDifferences(_VisitMeans):
    """Mean of a policy's sessions of one visit less that of the visit's cDBS; energy as a share of the latter."""


class _Steps(Model):
    sessions: int
    sessions_with_return: int
    mean_return: float | None
    mean_step_return: float | None
    mean_end_reward: float | None
    stopped: int = Field(description="Sessions among them that were stopped for the participant's sake.")
    energy: float | None
    mean_beta: float | None
    energy_difference: float | None = Field(description="To the cDBS of the same visits, as a share of it; null without such cDBS.")
    mean_beta_difference: float | None = Field(description="To the cDBS of the same visits.")
    visits: list[VisitDifferences] = Field(default_factory=list, description="Visits that had cDBS too, by number.")


if TYPE_CHECKING:
    _Means = _Steps
else:
    _Means = fields_model("_Means", lambda o: {o.field: (float | None, ...), f"{o.field}_difference": (float | None, ...)}, _Steps)


class TestedBefore(_Means):
    """Results of a policy where it ran: actual returns with the H and gamma of the estimates, and differences to the same visit's cDBS."""

    __test__ = False


Decision = Literal["test", "test_with_care", "same_as_cdbs", "undecided", "likely_worse", "unsafe", "cannot_tell"]
Standing = Literal["test", "test_with_care", "same_as_cdbs", "undecided", "likely_worse", "unsafe", "not_advised", "cannot_tell"]


class GainOut(Model):
    """Estimated return less that of cDBS, by one method; what both share cancels."""

    value: float
    low: float = Field(description="Lower end of the two-sided interval: the one-sided lower 95 % bound where the level is 0.9.")
    high: float
    level: float


class CheckOut(Model):
    """One check of what the data cover, with the limit that was in force."""

    model_config = ConfigDict(extra="ignore")  # stored with the evaluation: an older or newer one may hold more

    name: str = Field(
        description="`outside_range`, `thin`, `far`, `below_random_bound`, `unseen_dose` (shares of steps), `distance`, "
        "`effective_sessions`, `largest_weight_share`, `horizon_of_ten` (steps)."
    )
    value: float | None = Field(description="Null where the data cannot decide.")
    limit: float | None = Field(description="Null where the value has no limit.")
    at_least: bool = Field(description="Whether the limit is the least value that passes; else it is the greatest.")
    verdict: Literal["passed", "refused", "weights", "noted", "told"] = Field(
        description="`refused`: no method may speak about the policy; `weights`: importance sampling may not; `noted`: a remark that "
        "refuses nothing; `told`: a number without a limit."
    )


class CoverageOut(Model):
    """Coverage of one policy by the data, checked before it was estimated."""

    supported: bool
    sessions: int = Field(description="Sessions that have importance weights.")
    checks: list[CheckOut]
    failing: list[FlagOut] = Field(description="Checks that refuse the policy.")
    notes: list[FlagOut] = Field(description="To be known before it is picked; no refusal.")
    weights_failing: list[FlagOut] = Field(description="Why importance sampling cannot speak about it.")


class RankedPolicy(Model):
    """A policy in the ranking."""

    policy_id: int
    name: str
    kind: str
    algorithm: str
    teacher_id: int | None
    rank: int | None = Field(
        description="1 is best; unsafe policies, and those that the data do not support, come last. Null for references, and for all "
        "policies where the data cannot order them."
    )
    reference: str | None = Field(description="`cdbs`, `best_constant`, `constant`, `proportional` or `cloning`; null for candidates.")
    supported: bool
    probability_best: float | None
    retired: bool
    estimates: dict[str, EstimateOut]
    predicted: dict[str, float] = Field(description=f"By the ranking's method: energy, mean_amplitude, mean_beta, {', '.join(FIELDS)}.")
    flags: list[FlagOut]
    coverage: CoverageOut | None = Field(description="Null for an evaluation that did not check it, and where it could not be checked.")
    tested: TestedBefore | None
    gain: GainOut | None = Field(description="Over cDBS by the ranking's method; null where one of the two has no estimate.")
    decision: Decision | None = Field(description="By stated rules from the posterior and the participant's margins; null for references.")
    decision_reasons: list[ReasonOut] = Field(description="What the decision rests on; empty for references.")
    decision_reason: str = Field(description="The reasons in words.")
    standing: str | None = Field(
        None, description="Harms, own sessions and prediction, in the words of every page; null for references and for blinded assessors."
    )


class RankedSnapshot(Model):
    """Snapshot that the ranking rests on."""

    id: int
    created_at: datetime
    sessions: int
    steps: int
    beta_unit: str
    beta_source: str
    settings_version: int


class RankingOut(Model):
    """Candidate policies from best to worst by the default method, the posterior, and references besides them."""

    participant: str
    evaluation_id: int
    job_id: str | None = Field(description="The job that made it, with its learning curves.")
    first_answer: bool = Field(description="Whether the job stored it before it trained, so that the job's own ranking follows.")
    created_at: datetime
    default_method: str
    methods: list[str]
    failed_methods: dict[str, str] = Field(description="Methods that could not speak, and why.")
    horizon_steps: int
    gamma: float
    snapshot: RankedSnapshot
    stale: bool
    stale_reasons: list[str]
    stale_reason: str | None = Field(description="All of them in one line.")
    notes: list[str] = Field(
        description="What to know before choosing: the best candidate against cDBS, places that are not their value's."
    )
    policies: list[RankedPolicy]
    references: list[RankedPolicy]
    coverage_failed: str | None = Field(description="Why what the data cover could not be checked.")
    choice: None = Field(description="Always null: the posterior ranks, and no method is chosen.")
    hidden: int = Field(0, description="Candidates that the filter leaves out.")


Kind = Literal["trained", "distilled", "external"]


class RankingFilter(Model):
    """Filter of candidates; ranks stay those among all."""

    supported: bool = Field(False, description="Only policies that the data support.")
    kind: Kind | None = Field(None, description="Only policies of this kind.")
    tested: Literal["yes", "no"] | None = Field(None, description="Only policies that ran in a session, or only those that did not.")
