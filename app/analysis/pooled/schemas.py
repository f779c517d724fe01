"""API types of all participants together."""

from __future__ import annotations

from pydantic import Field

from app.analysis.primary.schemas import AverageOut, VerdictOut
from app.platform.web.schemas import Model
from app.tables.sessions import Controller


class OfParticipantOut(Model):
    """One participant's own result."""

    participant: str
    result: AverageOut


class SummaryOut(Model):
    """Random-effects summary of the participants that have a result; it claims nothing about other people."""

    estimate: float | None
    low: float | None
    high: float | None
    between_sd: float | None
    predicted_low: float | None
    predicted_high: float | None
    participants: int
    smallest_sign_p: float | None = Field(description="The smallest two-sided p that a sign test of so many participants can have.")
    text: str


class PooledMetricOut(Model):
    """One metric of one controller."""

    controller: Controller
    metric: str
    each: list[OfParticipantOut]
    together: SummaryOut


class StepTimeOut(Model):
    """Time of one kind of compute step."""

    job: str
    step: str
    n: int
    median_s: float
    longest_s: float


class TimeTestedOut(Model):
    """Minutes of one controller in one participant."""

    participant: str
    controller: Controller
    sessions: int
    minutes: float


class ParticipantVerdictsOut(Model):
    """The verdicts of one participant."""

    participant: str
    verdicts: list[VerdictOut]


class PooledOut(Model):
    """All participants that the caller may read."""

    verdicts: list[ParticipantVerdictsOut]
    metrics: list[PooledMetricOut]
    trial_time: list[TimeTestedOut]
    computation_time: list[StepTimeOut]
