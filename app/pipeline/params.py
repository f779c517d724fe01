"""Params of the jobs `pipeline` and `next_generation`; the phases define those of the other kinds."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from app.evaluation.methods import Methods
from app.evaluation.schemas import EvaluateParams
from app.learning.schemas import DEFAULT_SWEEP, Aim, AlgorithmName, Anchor, DistilParams, PolicyIds, SweepParams, TrainParams
from app.platform.web.schemas import Int, Number

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
