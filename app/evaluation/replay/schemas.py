"""API types of the comparison of policies on a recorded session."""

from __future__ import annotations

from pydantic import Field

from app.platform.web.schemas import Model


class AskedOut(Model):
    """What one policy would have asked for."""

    policy_id: int
    name: str
    fraction: list[float | None] = Field(
        description="Of the cDBS amplitude, per step; null where no whole window of beta had come, and cDBS would have been on."
    )
    mean_fraction: float | None = Field(description="Over the steps with an answer.")
    energy: float | None = Field(description="Mean squared fraction; cDBS is 1.")
    nearly_off: float | None = Field(description="Share of the steps below 0.2 of the cDBS amplitude.")


class DifferenceOut(Model):
    """How far two policies are apart, over the steps that both answer."""

    policy_id: int
    other_id: int
    mean_fraction: float = Field(description="Of the first less the second.")
    apart: float = Field(description="Share of the steps in which they are more than 0.05 of the cDBS amplitude apart.")
    most_at_s: float = Field(description="Begin of the step in which they are furthest apart, seconds of the session.")
    most: float = Field(description="Of the first less the second in that step.")


class ReplayOut(Model):
    """Policies over a recorded session's beta: what they would have asked, not what would have happened."""

    participant: str
    session_id: int
    visit: int
    period_s: float
    beta_unit: str
    cdbs_amplitude_ma: float | None
    t_s: list[float] = Field(description="Begin of each step, seconds of the session.")
    beta: list[float | None] = Field(description="Over the step before, as known when the amplitude was asked for.")
    recorded_fraction: list[float | None] = Field(description="What stimulated in fact.")
    asked: list[AskedOut]
    differences: list[DifferenceOut]
