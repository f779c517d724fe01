"""Params of the jobs `pipeline`, `next_generation` and `threshold_rule`; the phases define those of the other kinds."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from sqlalchemy.orm import Session

from app.evaluation.methods import Methods
from app.evaluation.schemas import EvaluateParams
from app.learning import repository
from app.learning.schemas import DEFAULT_SWEEP, Aim, AlgorithmName, Anchor, DistilParams, PolicyIds, Preset, SweepParams, TrainParams
from app.platform.errors import Invalid
from app.platform.web.schemas import Int, Model, Number
from app.study import cdbs_amplitude
from app.tables.participants import Hemisphere, Participant
from ml.policies.closest_rule import AmplitudeRange
from ml.policies.threshold_rule import RuleError

NEXT_GENERATION = "next_generation"
"""The kind that goes on from what did best."""


class PipelineParams(SweepParams):
    """Params of `pipeline`: everything between two visits in one job. The sweep is `DEFAULT_SWEEP` by default."""

    algorithms: Annotated[list[AlgorithmName], Field(min_length=1, max_length=5)] = Field(
        DEFAULT_SWEEP["algorithms"], description="The policies are dealt to these in turn; from scratch only."
    )
    aim: Aim = Field(DEFAULT_SWEEP["aim"], description="What the critics sum; see `train`.")
    critic_memory: bool = Field(DEFAULT_SWEEP["critic_memory"], description="Whether the critics see past amplitudes; see `train`.")
    anchor: Anchor = Field(DEFAULT_SWEEP["anchor"], description="What TD3+BC and ReBRAC hold the policy near; see `train`.")
    updates: Int | None = Field(None, ge=1, le=1_000_000, description="Gradient steps of each policy.")
    actor_lr_low: Number | None = Field(None, gt=0, le=1, description="Lowest learning rate of the policies.")
    actor_lr_high: Number | None = Field(None, gt=0, le=1, description="Highest; in between they are spread evenly in the logarithm.")
    sigma: Number | None = Field(
        None, ge=0, le=10, description="Noise of the distillation's synthetic states, share of beta's standard deviation."
    )
    distil_updates: Int | None = Field(None, ge=1, le=1_000_000, description="Gradient steps of each student.")
    methods: Methods
    horizon_steps: Int | None = Field(None, ge=1, le=100_000, description="H; the snapshot's median session length where not given.")
    seed: Int = Field(0, ge=0, le=10**6, description="Seed of everything in the job.")

    def training(self) -> TrainParams:
        """Return the params of the training stage."""
        names = (*SweepParams.model_fields, "updates", "actor_lr_low", "actor_lr_high", "seed")
        return TrainParams(**{name: getattr(self, name) for name in names})

    def distillation(self) -> DistilParams:
        """Return the params of the distillation stage."""
        return DistilParams(preset=self.preset, sigma=self.sigma, updates=self.distil_updates, seed=self.seed)

    def evaluation(self) -> EvaluateParams:
        """Return the params of the evaluation stage: every policy that is not retired, including the new ones."""
        return EvaluateParams(preset=self.preset, methods=self.methods, horizon_steps=self.horizon_steps, seed=self.seed)


class NextGenerationParams(PipelineParams):
    """Params of `next_generation`: a pipeline that continues from the best tested policies and adds new ones."""

    policies: Annotated[PolicyIds, Field(max_length=0)] = Field(
        default_factory=list, description="Always empty: the job chooses the best tested policies; name policies in a `pipeline` instead."
    )
    parents: Int = Field(2, ge=1, le=6, description="Tested policies to go on from, the best by the posterior.")
    tuned: Int = Field(2, ge=1, le=6, description="Policies to fine-tune from each, at the paper's learning rates from 1e-7 to 1e-5.")
    count: Int = Field(6, ge=1, le=24, description="Policies to train from scratch in addition.")
    actor_lr_low: Number | None = Field(None, gt=0, le=1, description="Lowest learning rate of the policies from scratch.")
    actor_lr_high: Number | None = Field(None, gt=0, le=1, description="Highest; in between they are spread evenly in the logarithm.")


THRESHOLD_RULE = "threshold_rule"
Device = Literal["percept_pc", "percept_rc"]
STEPS_MA: dict[Device, float] = {"percept_pc": 0.1, "percept_rc": 0.01}


class ThresholdRuleParams(Model):
    """Params of `threshold_rule`."""

    policy_id: Int = Field(ge=1, description="Policy to which the closest rule is found.")
    hemisphere: Hemisphere | None = Field(None, description="Side of the cDBS amplitude; needed where a visit states both.")
    min_ma: Number = Field(0.0, ge=0, le=25.5, description="Least amplitude that a rule may use, mA.")
    max_ma: Number | None = Field(None, ge=0, le=25.5, description="Most, mA; the cDBS amplitude where not given, and never above it.")
    device: Device = Field("percept_pc", description="Its amplitudes are multiples of 0.1 mA, those of a `percept_rc` of 0.01 mA.")
    preset: Preset = Field("full", description="`full`: sizes for a study; `quick`: for a first look.")
    seed: Int = Field(0, ge=0, le=10**6)


def rule_within_reach(db: Session, participant_id: int, params: ThresholdRuleParams) -> None:
    """Raise where the policy takes no windows of now, or no amplitude may be used.

    Raises:
        NotFound: no such policy. Invalid: limits that cross, that are above cDBS, or that hold no step of the device.
    """
    repository.policies_named(db, participant_id, [params.policy_id])
    rule_amplitudes(db.get_one(Participant, participant_id), params)


def rule_amplitudes(participant: Participant, params: ThresholdRuleParams) -> tuple[float, AmplitudeRange]:
    """Return the cDBS amplitude in force, mA, and the amplitudes that a rule may use.

    Raises:
        Invalid: the cDBS amplitude is not known, or the limits cannot be used.
    """
    cdbs_ma = cdbs_amplitude.in_force_now(participant, params.hemisphere)
    max_ma = cdbs_ma if params.max_ma is None else params.max_ma
    if max_ma > cdbs_ma + 1e-6:
        raise Invalid(
            f"A highest amplitude of {max_ma:g} mA is above the cDBS amplitude of {cdbs_ma:g} mA.",
            "Lower it: no controller of this study gives more than cDBS.",
            field="max_ma",
        )
    if params.min_ma > max_ma + 1e-6:
        raise Invalid(
            f"The lowest amplitude, {params.min_ma:g} mA, is above the highest one, {max_ma:g} mA.", "Exchange them.", field="min_ma"
        )
    limits = AmplitudeRange(params.min_ma, max_ma, STEPS_MA[params.device])
    try:
        limits.usable  # noqa: B018  (raises)
    except RuleError as error:
        raise Invalid(f"{str(error)[:1].upper()}{str(error)[1:]}.", "Widen the limits, or take the finer step.", field="max_ma") from error
    return cdbs_ma, limits
