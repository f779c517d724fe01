"""API types of jobs of every kind."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field

from app.evaluation.estimates.methods import Methods
from app.evaluation.schemas import EvaluateParams
from app.learning.schemas import DistilParams, SweepParams, TrainParams
from app.platform.web.schemas import Int, Model, Number


class PipelineParams(SweepParams):
    """What `pipeline` takes: everything between two visits in one job."""

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
        """The training stage."""
        names = (*SweepParams.model_fields, "updates", "actor_lr_low", "actor_lr_high", "seed")
        return TrainParams(**{name: getattr(self, name) for name in names})

    def distillation(self) -> DistilParams:
        """The distillation stage."""
        return DistilParams(preset=self.preset, sigma=self.sigma, updates=self.distil_updates, seed=self.seed)

    def evaluation(self) -> EvaluateParams:
        """The evaluation stage: every policy that is not retired, the new ones among them."""
        return EvaluateParams(preset=self.preset, methods=self.methods, horizon_steps=self.horizon_steps, seed=self.seed)


class TrainJob(TrainParams):
    """Train policies."""

    kind: Literal["train"]


class DistillJob(DistilParams):
    """Distil policies."""

    kind: Literal["distill"]


class EvaluateJob(EvaluateParams):
    """Estimate and rank policies."""

    kind: Literal["evaluate"]


class PipelineJob(PipelineParams):
    """Snapshot, train, distil, estimate, rank."""

    kind: Literal["pipeline"]


JobIn = Annotated[TrainJob | DistillJob | EvaluateJob | PipelineJob, Field(discriminator="kind")]


class JobStepOut(Model):
    """One step of a job."""

    key: str
    title: str
    status: str
    progress: float
    message: str
    attempts: int
    started_at: datetime | None
    finished_at: datetime | None


class JobOut(Model):
    """A job."""

    id: str
    kind: str
    participant: str | None
    status: str
    progress: float
    message: str
    params: dict[str, Any]
    result: dict[str, Any] | None
    error: str | None
    code_version: str
    created_at: datetime
    created_by: str
    started_at: datetime | None
    finished_at: datetime | None
    cancel_requested_at: datetime | None
    steps: list[JobStepOut]
