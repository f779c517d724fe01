"""API types of learning."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from app.platform.schemas import Int, Model, Number, Text

Preset = Literal["full", "quick"]
_CONTROL = r"\x00-\x1f\x7f-\x9f"


def _printable(name: str) -> str:
    if re.search(f"[{_CONTROL}]", name):
        raise ValueError("a policy's name has no control characters, the zero character and line breaks among them")
    if not name.strip():
        raise ValueError("a policy's name has at least one visible character")
    return name


PolicyName = Annotated[
    str,
    Field(max_length=100, json_schema_extra={"pattern": rf"^[^{_CONTROL}]*[^\s{_CONTROL}][^{_CONTROL}]*$"}),
    AfterValidator(_printable),
]
PolicyIds = Annotated[list[Annotated[Int, Field(ge=1)]], Field(max_length=50)]


class TrainParams(Model):
    """What `train` takes. What is left out comes from the preset."""

    preset: Preset = Field("full", description="`full`: sizes for a study; `quick`: for a first look.")
    policies: PolicyIds = Field(default_factory=list, description="Fine-tune from each of these; empty: train from scratch.")
    count: Int = Field(6, ge=1, le=24, description="Policies to train from scratch; the paper trains 6.")
    updates: Int | None = Field(None, ge=1, le=1_000_000, description="Gradient steps of each policy.")
    batch: Int | None = Field(None, ge=1, le=4096, description="Transitions per gradient step.")
    actor_lr_low: Number | None = Field(None, gt=0, le=1, description="Lowest learning rate of the policies.")
    actor_lr_high: Number | None = Field(None, gt=0, le=1, description="Highest; in between they are spread evenly in the logarithm.")
    critic_lr: Number | None = Field(None, gt=0, le=1, description="Learning rate of the critic.")
    seed: Int = Field(0, ge=0, le=10**6, description="Seed of the first policy; the next ones count up.")


class DistilParams(Model):
    """What `distill` takes."""

    preset: Preset = Field("full", description="`full`: sizes for a study; `quick`: for a first look.")
    policies: PolicyIds = Field(default_factory=list, description="Teachers; empty: every trained policy without a student.")
    sigma: Number | None = Field(None, ge=0, le=10, description="Noise of synthetic states, as a share of beta's standard deviation.")
    updates: Int | None = Field(None, ge=1, le=1_000_000, description="Gradient steps of each student.")
    hidden: list[Annotated[Int, Field(ge=1, le=1024)]] | None = Field(
        None, min_length=1, max_length=6, description="Student's hidden layers."
    )
    seed: Int = Field(0, ge=0, le=10**6)


class SnapshotSessionOut(Model):
    """One session of a snapshot, or why it was left out."""

    session_id: int
    beta_trace_id: int | None
    amplitude_trace_id: int | None
    decode_version: int | None
    qoc_id: int | None
    cdbs_amplitude_ma: float | None
    steps: int | None
    left_out_reason: str | None


class SnapshotOut(Model):
    """A buffer snapshot."""

    id: int
    participant: str
    settings_version: int
    pins_sha256: str
    file_sha256: str
    sessions: int
    steps: int
    median_steps: int
    beta_unit: str
    beta_source: str
    created_at: datetime
    created_by: str
    members: list[SnapshotSessionOut]


class PolicyOut(Model):
    """A policy."""

    id: int
    participant: str
    name: str
    kind: str
    algorithm: str
    teacher_id: int | None
    parent_id: int | None
    snapshot_id: int | None
    settings_version: int
    job_id: str | None
    config: dict[str, Any]
    seed: int | None
    metrics: dict[str, Any]
    onnx_sha256: str
    code_version: str
    created_at: datetime
    created_by: str
    retired_reason: str | None


class PolicyLabel(Model):
    """The name of a new policy, as a form sends it."""

    name: PolicyName


class PolicyChange(Model):
    """Retire a policy, or take it back; nothing else of a policy ever changes."""

    retired_reason: Text | None = Field(max_length=1000, description="Why it is no longer to be ranked or planned; null takes it back.")
