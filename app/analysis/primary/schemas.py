"""API types of the primary analyses."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from app.platform.web.schemas import Model
from app.study.outcome_fields import VersionOfMargins
from app.tables.sessions import Controller


class AverageOut(Model):
    """An average contrast to cDBS over visits; without visits to tell it, `reason` says why."""

    estimate: float | None
    low: float | None
    high: float | None
    p_value: float | None = Field(description="Two-sided, unadjusted.")
    visits: int
    adjustment: str | None = Field(description="What the contrast is freed from.")
    reason: str | None = Field(description="Code of why there is no number.")
    text: str = Field(description="The same in words; empty where there is a number.")


class VisitRowOut(Model):
    """One visit of a comparison."""

    visit: int
    contrast: float | None = Field(description="Mean of the controller's sessions less that of cDBS; null without both arms.")
    session_ids: list[int]
    cdbs_session_ids: list[int]


class SensitivityOut(Model):
    """An alternative analysis."""

    adjustment: str
    result: AverageOut


class PrimaryComparisonOut(Model):
    """One metric of a controller against the same visit's cDBS."""

    metric: str
    title: str
    unit: str
    primary: AverageOut
    p_adjusted: float | None = Field(description="Holm within the planned family, Benjamini-Hochberg in exploration.")
    cliffs_delta: AverageOut
    energy_saving_percent: AverageOut | None
    van_elteren_p: float | None
    paper_p: float | None = Field(description="The paper's rank-sum test of all sessions, whatever their visit.")
    disagreement: str | None = Field(description="paper_only, primary_only or no_primary.")
    order_imbalance: float | None = Field(description="How much later the controller came, in SDs of the place in the visit.")
    sensitivity: list[SensitivityOut]
    by_visit: list[VisitRowOut]


class TestedOut(Model):
    """A controller or policy with its comparisons."""

    controller: Controller
    policy_id: int | None
    name: str
    role: str = Field(description="planned or exploration.")
    basis: str = Field(description="all, confirmation or selection: which sessions of a policy count.")
    session_ids: list[int]
    selection_session_ids: list[int] = Field(description="Sessions that may have picked the policy, and do not count.")
    comparisons: list[PrimaryComparisonOut]


class OutcomeVerdictOut(Model):
    """Non-inferiority of one outcome; contrasts are turned so that higher is better."""

    outcome: str
    margin: float
    scale: str = Field(
        description="difference: of the visits' means. ordinal: share of pairs that the controller's values win once the margin is added."
    )
    excluded: float = Field(description="What `estimate` must be shown to exceed.")
    estimate: float | None
    low: float | None
    high: float | None
    p_non_inferior: float | None
    failures: int
    missing: int
    text: str


class MarginsLockedOut(VersionOfMargins):
    """The margins that a verdict goes by."""

    locked_at: datetime | None
    locked_by: str | None
    superseded_at: datetime | None = Field(description="When a newer lock followed.")


class VerdictOut(Model):
    """The verdict on one controller."""

    controller: Controller
    confirmatory: bool
    verdict: str = Field(description="non_inferior_and_saving, inferior, inconclusive or not_available.")
    sentence: str
    basis: str
    margins: MarginsLockedOut
    visits: list[int]
    more_visits: int | None
    outcomes: list[OutcomeVerdictOut]
    energy_saving_percent: AverageOut | None
    stopped_session_ids: list[int]
    late_stop_session_ids: list[int] = Field(description="Stopped too, but known only after the lock of the visit: counted as measured.")


class StandingOut(Model):
    """Standing of a policy, in the words of every page."""

    policy_id: int
    sentence: str


class PrimaryOut(Model):
    """Controllers and policies against the same visit's cDBS."""

    participant: str
    level: float
    family: str
    margins: MarginsLockedOut
    verdicts: list[VerdictOut]
    earlier_verdicts: list[VerdictOut] = Field(
        description="Under locks that a newer one followed, oldest first: of the visits that began between the two."
    )
    results: list[TestedOut]
    standings: list[StandingOut] = Field(description="Of each policy: its harms, its own sessions, its prediction.")
