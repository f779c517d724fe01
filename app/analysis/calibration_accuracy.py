"""API types of the calibration: what was predicted before a visit against what the visit brought."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from app.evaluation.ranking.assessment import QUANTITIES
from app.platform.web.schemas import Model
from ml.ope import LEVEL, accuracy
from ml.outcomes import enumerated
from ml.statistics.bootstrap import percentile_interval, resamples


class QuantityOut(Model):
    """One quantity of one method, policy and visit: predicted, and the mean over the sessions that have it."""

    name: str = Field(description=f"{enumerated([f'`{name}`' for name in QUANTITIES], 'or')}.")
    predicted: float
    actual: float
    sessions: int


class PredictionOut(Model):
    """Prediction of a policy by one method before a visit."""

    method: str
    supported: bool
    parts: Literal["return", "steps"] = Field(
        description="`steps`: the method had no r_end to learn, so it is compared with the step returns alone."
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
    reference: str | None = Field(description="`cdbs` for sessions of cDBS, shown next to the policies; null for policies.")
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


# The paper's metrics of estimates against actual returns, with intervals over visits.
#
# A pair is a policy at a visit: what the visit's plan had predicted of it, and the mean return of its sessions there. A policy tested at
# two visits is two pairs. Visits are what is resampled, whole: sessions of one day share medication, sleep and the state of the
# participant. `ml.ope.compare.metrics` gives the values, the arrays here the same metrics of every resample at once. Nothing is divided
# by a range, or a best return, that is no larger than the least distinguishable difference (`least_range`). Source: Gao et al. 2023,
# appendix on the metrics of off-policy evaluation.

Floats = NDArray[np.float64]

DRAWS = 500
FEWEST_SESSIONS = 3
"""Sessions of a policy at a visit below which no interval of their mean is given."""
FEWEST_VISITS = 5
"""Visits below which no interval of a metric is given: percentiles of three resampled visits cover 62 % where they say 90 %."""

DEFINED_SHARE = 0.5
"""Least share of resamples in which a metric must be defined for its interval to be given."""
SMALL_SHARE = 0.05
"""Where no policy has two sessions at a visit, returns closer than this share of the largest one count as equal."""
LEAST_SHARE = 0.01
"""The same where policies have several: few sessions can chance to agree, or be the same session entered twice."""
WITHIN_NOISE = "the actual returns lie closer together than sessions of one policy do"


@dataclass(frozen=True)
class Pair:
    """One policy at one visit.

    Attributes:
        visit: number. predicted, low, high: the estimate and its interval. returns: actual return of each session, not empty.
    """

    visit: int
    predicted: float
    low: float
    high: float
    returns: tuple[float, ...]

    @property
    def actual(self) -> float:
        """Mean return of the sessions."""
        return float(np.mean(self.returns))


def mean_interval(returns: Sequence[float], level: float = LEVEL) -> tuple[float, float] | None:
    """Bootstrap a mean over sessions (percentile interval); None below `FEWEST_SESSIONS`."""
    values = np.asarray(returns, dtype=np.float64)
    if values.size < FEWEST_SESSIONS:
        return None
    interval = percentile_interval(values[resamples(values.size, 1000, 0)].mean(1), level)
    return interval.low, interval.high


def least_range(pairs: Sequence[Pair]) -> float:
    """Return the range of actual returns that must be exceeded for a share of it to mean something, in units of the return.

    It is the pooled standard deviation between sessions of one policy at one visit. Where no policy has two, or they agree by chance, it is
    a small share of the largest return.
    """
    largest = max(abs(p.actual) for p in pairs)
    repeated = [np.asarray(p.returns) for p in pairs if len(p.returns) > 1]
    if not repeated:
        return SMALL_SHARE * largest
    pooled = float(np.sqrt(sum(((r - r.mean()) ** 2).sum() for r in repeated) / sum(r.size - 1 for r in repeated)))
    return max(pooled, LEAST_SHARE * largest)


def accuracies(method: str, pairs: Sequence[Pair]) -> list[AccuracyOut]:
    """Compute the metrics of one method: over all visits, then of each visit, which has no interval."""
    visits = sorted({p.visit for p in pairs})
    floor = least_range(pairs)
    return [_over_visits(method, pairs, floor)] + [_of_visit(method, [p for p in pairs if p.visit == v], v, floor) for v in visits]


def _of_visit(method: str, pairs: Sequence[Pair], visit: int, floor: float) -> AccuracyOut:
    found = accuracy([p.actual for p in pairs], [p.predicted for p in pairs], least_range=floor)
    alone = "" if len(pairs) > 1 else "a ranking needs at least 2 policies at the visit; there is 1"
    return AccuracyOut(
        method=method,
        visit=visit,
        policies=len(pairs),
        sessions=sum(len(p.returns) for p in pairs),
        mae=_plain(found.mae),
        mae_of_range=_plain(None if alone else found.mae_of_range, alone or WITHIN_NOISE),
        rank_correlation=_plain(found.rank_correlation, alone or "all actual returns, or all estimates, are equal"),
        rank_p=found.rank_p,
        regret=_plain(None if alone else found.regret, alone),
        regret_of_range=_plain(None if alone else found.regret_of_range, alone or WITHIN_NOISE),
        regret_as_paper=_plain(None if alone else found.regret_as_paper, alone or "the best actual return is next to 0"),
        coverage=_covered(pairs),
    )


def _over_visits(method: str, pairs: Sequence[Pair], floor: float) -> AccuracyOut:
    """Compute MAE and rank correlation over all pairs; regret, which chooses among the policies of one visit, as the mean over visits."""
    found = accuracy([p.actual for p in pairs], [p.predicted for p in pairs], least_range=floor)
    by_visit = [[p for p in pairs if p.visit == v] for v in sorted({p.visit for p in pairs})]
    means, estimated, drawn = _resampled(by_visit)
    metric = _metric(len(by_visit))
    alone = "" if len(pairs) > 1 else "at least 2 policies are needed; there is 1"

    def regret(name: str, reason: str) -> MethodMetricOut:
        each = np.array([_regret_of(own, floor, name) for own in by_visit])
        if not any(len(own) > 1 for own in by_visit):
            reason = "a ranking needs at least 2 policies at one visit; no visit has them"
        return metric(_finite(_nan_mean(each[None])[0]), _nan_mean(each[drawn]), reason)

    return AccuracyOut(
        method=method,
        visit=None,
        policies=len(pairs),
        sessions=sum(len(p.returns) for p in pairs),
        mae=metric(found.mae, _mae(means, estimated)),
        mae_of_range=metric(None if alone else found.mae_of_range, _mae(means, estimated) / _range(means, floor), alone or WITHIN_NOISE),
        rank_correlation=metric(found.rank_correlation, rank_correlations(means, estimated), alone or "all are equal"),
        rank_p=found.rank_p,
        regret=regret("regret", ""),
        regret_of_range=regret("regret_of_range", f"at every visit {WITHIN_NOISE}"),
        regret_as_paper=regret("regret_as_paper", "the best actual return of every visit is next to 0"),
        coverage=_covered(pairs),
    )


def _regret_of(pairs: Sequence[Pair], floor: float, name: str) -> float:
    """Compute one form of regret@1 among the policies of a visit; NaN where it has none."""
    if len(pairs) < 2:
        return float("nan")
    value = getattr(accuracy([p.actual for p in pairs], [p.predicted for p in pairs], least_range=floor), name)
    return float("nan") if value is None else float(value)


def rank_correlations(means: Floats, estimated: Floats) -> Floats:
    """Compute Spearman's correlation of every row of means [D, C] with its estimates; ignore NaN cells; NaN where one side is flat."""
    there = np.isfinite(means)
    ours, theirs = _ranks(means, there), _ranks(np.where(there, estimated, np.nan), there)
    top = np.nansum(ours * theirs, axis=1)
    scale = np.sqrt(np.nansum(ours**2, axis=1) * np.nansum(theirs**2, axis=1))
    return np.asarray(np.divide(top, scale, out=np.full(len(means), np.nan), where=scale > 1e-12), dtype=np.float64)


def _resampled(by_visit: Sequence[Sequence[Pair]]) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Draw visits with replacement. Returns the actual means and the estimates of their pairs, [DRAWS, most pairs], NaN where a row has
    fewer, and the drawn visits, [DRAWS, visits].
    """
    drawn = resamples(len(by_visit), DRAWS, 0)
    most = len(by_visit) * max(len(own) for own in by_visit)
    filled = np.full((2, len(by_visit), most // len(by_visit)), np.nan)
    for v, own in enumerate(by_visit):
        filled[0, v, : len(own)] = [p.actual for p in own]
        filled[1, v, : len(own)] = [p.predicted for p in own]
    means, estimated = filled[:, drawn].reshape(2, DRAWS, most)
    return means, estimated, drawn


def _metric(visits: int) -> Callable[..., MethodMetricOut]:
    """Return a function that makes a metric of its value and of that of every resample."""

    def make(value: float | None, draws: Floats, missing: str = "") -> MethodMetricOut:
        if value is None:
            return _plain(None, missing)
        known = draws[np.isfinite(draws)]
        if visits < FEWEST_VISITS or known.size < DEFINED_SHARE * draws.size:
            return _plain(value)
        interval = percentile_interval(known, LEVEL)
        return MethodMetricOut(value=value, low=interval.low, high=interval.high)

    return make


def _plain(value: float | None, missing: str = "") -> MethodMetricOut:
    """Make a metric without an interval, or with the reason why there is no value."""
    return MethodMetricOut(value=value, low=None, high=None, missing=missing if value is None else "")


def _covered(pairs: Sequence[Pair]) -> MethodMetricOut:
    return MethodMetricOut(value=float(np.mean([p.low <= p.actual <= p.high for p in pairs])), low=None, high=None)


def _ranks(values: Floats, there: NDArray[np.bool_]) -> Floats:
    """Compute mean ranks of every row less their mean, NaN where a cell is missing; NaN compares as neither less nor equal."""
    less = (values[:, None, :] < values[:, :, None]).sum(2)
    equal = (values[:, None, :] == values[:, :, None]).sum(2)
    ranks = np.where(there, less + 0.5 * (equal + 1), np.nan)
    return np.asarray(ranks - _nan_mean(ranks)[:, None], dtype=np.float64)


def _mae(means: Floats, estimated: Floats) -> Floats:
    return _nan_mean(np.abs(means - estimated))


def _range(means: Floats, floor: float) -> Floats:
    """Compute the range of every row; NaN where it is no larger than the floor."""
    there = np.isfinite(means)
    spread = np.where(there, means, -np.inf).max(1) - np.where(there, means, np.inf).min(1)
    return np.asarray(np.where(spread > floor, spread, np.nan), dtype=np.float64)


def _nan_mean(values: Floats) -> Floats:
    """Average the known values of every row; NaN where none is known."""
    there = np.isfinite(values)
    count = there.sum(1)
    return np.asarray(np.where(count > 0, np.where(there, values, 0.0).sum(1) / np.maximum(count, 1), np.nan), dtype=np.float64)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
