"""API types of the calibration: what was predicted before a visit against what the visit brought."""

from __future__ import annotations

from datetime import date, datetime
from typing import Literal

from pydantic import Field

from app.evaluation.ranking.actual import QUANTITIES
from app.platform.web.schemas import Model
from ml.outcomes import enumerated


class QuantityOut(Model):
    """One quantity of one method, policy and visit: predicted, and the mean over the sessions that have it."""

    name: str = Field(description=f"{enumerated([f'`{name}`' for name in QUANTITIES], 'or')}.")
    predicted: float
    actual: float
    sessions: int


class PredictionOut(Model):
    """What one method had said of a policy before a visit."""

    method: str
    supported: bool
    parts: Literal["return", "steps"] = Field(
        description="`steps`: the method had no r_end to learn, so it is held against the step returns alone."
    )
    predicted: float
    low: float
    high: float
    level: float
    actual: float
    actual_low: float | None = Field(description="Session bootstrap of the mean; null below three sessions.")
    actual_high: float | None
    sessions: int = Field(description="Sessions behind `actual`.")
    session_returns: list[float]
    quantities: list[QuantityOut]


class TestedPolicyOut(Model):
    """One policy at one visit, and the evaluation that had been made of it before."""

    __test__ = False

    visit: int
    visit_date: date | None
    evaluation_id: int
    evaluated_at: datetime
    policy_id: int
    name: str
    kind: str
    reference: str | None = Field(description="`cdbs` for sessions of cDBS, shown beside the policies; null for policies.")
    horizon_steps: int
    gamma: float
    sessions: int
    sessions_left_out: list[str] = Field(description="Sessions without a return, and why.")
    predictions: list[PredictionOut]


class MethodMetricOut(Model):
    """One metric with its interval over resampled visits (null below three); null with the reason in `missing`."""

    value: float | None
    low: float | None
    high: float | None
    missing: str = ""


class AccuracyOut(Model):
    """The paper's metrics of one method: of one visit, or of all (`visit` null)."""

    method: str
    visit: int | None
    policies: int = Field(description="Pairs of a policy and a visit.")
    sessions: int
    mae: MethodMetricOut
    mae_of_range: MethodMetricOut
    rank_correlation: MethodMetricOut
    rank_p: float | None = Field(description="Two-sided permutation p-value of the rank correlation.")
    regret: MethodMetricOut = Field(description="Raw regret@1: the best actual return less that of the policy with the best estimate.")
    regret_of_range: MethodMetricOut
    regret_as_paper: MethodMetricOut = Field(description="Regret over the best actual return: turns its sign where that is negative.")
    coverage: MethodMetricOut = Field(description="Share of actual means within the estimate's interval.")


class QuantityErrorOut(Model):
    """Mean absolute error of one method for one quantity, over policies and visits."""

    method: str
    name: str
    mae: float
    policies: int


class CalibrationOut(Model):
    """Predicted against actual."""

    participant: str
    beta_unit: str | None
    level: float
    methods: list[str]
    policies: list[TestedPolicyOut]
    metrics: list[AccuracyOut]
    quantities: list[QuantityErrorOut]
    missing: str | None = Field(description="The check that failed where there is nothing to compare.")
    left_out: list[str] = Field(description="What ran and could not be compared, and why.")
