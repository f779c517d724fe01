"""API types of the analysis."""

from __future__ import annotations

from pydantic import Field

from app.platform.web.schemas import Model
from app.tables.sessions import Controller
from ml.outcomes import ANY


class GroupOut(Model):
    """One metric under one controller."""

    controller: Controller
    label: str
    n: int = Field(description="Sessions with a value.")
    median: float | None
    q1: float | None
    q3: float | None
    values: list[float]
    session_ids: list[int] = Field(description="Session of each value.")


class ComparisonOut(Model):
    """One controller against cDBS: two-sided Wilcoxon rank-sum test."""

    controller: Controller
    label: str
    p_value: float | None = Field(description="Unadjusted, as in the paper; null where there is not enough data.")
    p_holm: float | None = Field(description="Adjusted for all comparisons of this answer.")
    method: str | None = Field(description="exact, or normal approximation.")
    n_controller: int
    n_cdbs: int
    difference: float | None = Field(description="Hodges-Lehmann estimate of controller less cDBS, in the metric's unit.")
    low: float | None
    high: float | None
    level: float = Field(description="Coverage of low to high.")
    note: str = Field(description="The check that failed; empty where the test was made.")


class PolicyMetricOut(Model):
    """One metric of one policy: its sessions, and their comparison with cDBS."""

    policy_id: int
    group: GroupOut
    comparison: ComparisonOut


class MetricOut(Model):
    """One of the five metrics."""

    metric: str = Field(description=f"energy, mean_beta, {ANY}.")
    title: str
    unit: str
    groups: list[GroupOut]
    comparisons: list[ComparisonOut]
    policies: list[PolicyMetricOut] = Field(description="The same by policy; p-values unadjusted, with no value of p_holm.")
    notes: list[str]


class ControllerOut(Model):
    """One controller's share of the study."""

    controller: Controller
    label: str
    sessions: int
    minutes: float
    energy_saving_percent: float | None = Field(description="Against the mean energy of the cDBS sessions.")


class ExcludedOut(Model):
    """A session left out of the analysis."""

    session_id: int
    visit: int
    ordinal: int
    reason: str


class MissingValueOut(Model):
    """A metric that a session which counts does not have."""

    session_id: int
    visit: int
    ordinal: int
    metric: str
    reason: str


class ContradictionOut(Model):
    """A session whose amplitudes are not those of its controller; it counts until somebody corrects it."""

    session_id: int
    visit: int
    ordinal: int
    controller: Controller
    mean_fraction: float = Field(description="Mean amplitude fraction of its steps; cDBS = 1.")
    text: str


class FiveMetricsOut(Model):
    """The five metrics of each controller against cDBS."""

    participant: str
    sessions: int = Field(description="Sessions that count.")
    controllers: list[ControllerOut]
    metrics: list[MetricOut]
    excluded: list[ExcludedOut]
    missing: list[MissingValueOut]
    warnings: list[ContradictionOut]
    limits: list[str]
