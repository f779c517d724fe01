"""The paper's metrics of estimates against actual returns, with session-bootstrap intervals.

A pair is a policy at a visit: an estimate made before, and the mean return of its sessions there. Sessions are what is resampled, so that
a policy of one session, whose resampled mean never varies, still drops out of some resamples. `ml.ope.compare.metrics` gives the values,
the arrays here the same metrics of every resample at once. Source: Gao et al. 2023, appendix on the metrics of off-policy evaluation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.analysis.calibration.schemas import AccuracyOut, MethodMetricOut
from ml.ope.compare.metrics import accuracy
from ml.ope.estimate import LEVEL
from ml.statistics.bootstrap import percentile_interval, resamples

Floats = NDArray[np.float64]

DRAWS = 500
FEWEST_SESSIONS = 3
"""Sessions below which no interval is given."""

DEFINED_SHARE = 0.5
"""Least share of resamples in which a metric must be defined for its interval to be given."""


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
    """Percentile bootstrap of a mean over sessions; None below `FEWEST_SESSIONS`."""
    values = np.asarray(returns, dtype=np.float64)
    if values.size < FEWEST_SESSIONS:
        return None
    interval = percentile_interval(values[resamples(values.size, 1000, 0)].mean(1), level)
    return interval.low, interval.high


def accuracies(method: str, pairs: Sequence[Pair]) -> list[AccuracyOut]:
    """Metrics of one method: over all visits, then of each visit."""
    visits = sorted({p.visit for p in pairs})
    return [_over_visits(method, pairs)] + [_of_visit(method, [p for p in pairs if p.visit == v], v) for v in visits]


def _of_visit(method: str, pairs: Sequence[Pair], visit: int) -> AccuracyOut:
    estimated, means = np.array([p.predicted for p in pairs]), _resampled(pairs)
    found = accuracy([p.actual for p in pairs], estimated)
    metric = _metric(means, sum(len(p.returns) for p in pairs))
    alone = "" if len(pairs) > 1 else "a ranking needs at least 2 policies at the visit; there is 1"
    again = _repeated(pairs)
    ties = alone or "all actual returns, or all estimates, are equal"
    return AccuracyOut(
        method=method,
        visit=visit,
        policies=len(pairs),
        sessions=sum(len(p.returns) for p in pairs),
        mae=metric(found.mae, lambda m: _mae(m, estimated)),
        mae_of_range=metric(None if alone else found.mae_of_range, lambda m: _mae(m, estimated) / _range(m), ties),
        rank_correlation=metric(found.rank_correlation, lambda m: rank_correlations(m, estimated), ties),
        rank_p=found.rank_p,
        regret=metric(None if alone else found.regret, lambda m: regrets(m, estimated), alone, again),
        regret_of_range=metric(None if alone else found.regret_of_range, lambda m: regrets(m, estimated) / _range(m), ties, again),
        regret_as_paper=metric(
            None if alone else found.regret_as_paper, lambda m: regrets(m, estimated) / _best(m), alone or "max V is 0", again
        ),
        coverage=_covered(pairs),
    )


def _over_visits(method: str, pairs: Sequence[Pair]) -> AccuracyOut:
    """MAE and rank correlation over all pairs; regret, which chooses among the policies of one visit, as the mean over visits."""
    estimated, means = np.array([p.predicted for p in pairs]), _resampled(pairs)
    visits = np.array([p.visit for p in pairs])
    sessions = sum(len(p.returns) for p in pairs)
    found = accuracy([p.actual for p in pairs], estimated)
    metric = _metric(means, sessions)
    several = [visits == v for v in np.unique(visits) if (visits == v).sum() > 1]
    none = "" if several else "a ranking needs at least 2 policies at one visit; no visit has them"
    alone = "" if len(pairs) > 1 else "at least 2 policies are needed; there is 1"
    now = means[:1]

    def mean_regret(over: Callable[[Floats], Floats] | None) -> Callable[[Floats], Floats]:
        def of(m: Floats) -> Floats:
            values = [regrets(m[:, own], estimated[own]) / (1.0 if over is None else over(m[:, own])) for own in several]
            return _nan_mean(np.stack(values, axis=1))

        return of

    def regret(over: Callable[[Floats], Floats] | None, reason: str = "") -> MethodMetricOut:
        if none:
            return MethodMetricOut(value=None, low=None, high=None, missing=none)
        return metric(_finite(mean_regret(over)(now)[0]), mean_regret(over), reason, _repeated(pairs))

    return AccuracyOut(
        method=method,
        visit=None,
        policies=len(pairs),
        sessions=sessions,
        mae=metric(found.mae, lambda m: _mae(m, estimated)),
        mae_of_range=metric(None if alone else found.mae_of_range, lambda m: _mae(m, estimated) / _range(m), alone or "all are equal"),
        rank_correlation=metric(found.rank_correlation, lambda m: rank_correlations(m, estimated), alone or "all are equal"),
        rank_p=found.rank_p,
        regret=regret(None),
        regret_of_range=regret(_range, "all actual returns of every visit are equal"),
        regret_as_paper=regret(_best, "max V is 0 at every visit"),
        coverage=_covered(pairs),
    )


def rank_correlations(means: Floats, estimated: Floats) -> Floats:
    """Spearman's correlation of every row of means [D, C] with the estimates [C]; NaN cells are left out; NaN where one side is flat."""
    there = np.isfinite(means)
    ours, theirs = _ranks(means, there), _ranks(np.where(there, estimated, np.nan), there)
    top = np.nansum(ours * theirs, axis=1)
    scale = np.sqrt(np.nansum(ours**2, axis=1) * np.nansum(theirs**2, axis=1))
    return np.asarray(np.divide(top, scale, out=np.full(len(means), np.nan), where=scale > 1e-12), dtype=np.float64)


def regrets(means: Floats, estimated: Floats) -> Floats:
    """Raw regret@1 of every row of means [D, C]: the best mean less that of the highest estimate among the cells there; NaN below two."""
    there = np.isfinite(means)
    best = np.where(there, means, -np.inf).max(1)
    chosen = np.argmax(np.where(there, estimated, -np.inf), axis=1)
    return np.asarray(np.where(there.sum(1) > 1, best - means[np.arange(len(means)), chosen], np.nan), dtype=np.float64)


def _resampled(pairs: Sequence[Pair]) -> Floats:
    """Means of the pairs, [1 + DRAWS, C]: first of all sessions, then of sessions drawn with replacement; NaN where none was drawn."""
    returns = np.concatenate([np.asarray(p.returns, dtype=np.float64) for p in pairs])
    member = np.repeat(np.arange(len(pairs)), [len(p.returns) for p in pairs])[:, None] == np.arange(len(pairs))
    counts = np.stack([np.bincount(pick, minlength=returns.size) for pick in resamples(returns.size, DRAWS, 0)])
    counts = np.concatenate([np.ones((1, returns.size)), counts])
    drawn = counts @ member
    return np.asarray(np.divide((counts * returns) @ member, drawn, out=np.full(drawn.shape, np.nan), where=drawn > 0), dtype=np.float64)


def _metric(means: Floats, sessions: int) -> Callable[..., MethodMetricOut]:
    """Makes a metric of its value and of the function that gives it for every resample."""

    def make(value: float | None, of: Callable[[Floats], Floats], missing: str = "", spread_known: bool = True) -> MethodMetricOut:
        if value is None:
            return MethodMetricOut(value=None, low=None, high=None, missing=missing)
        if not spread_known:
            return MethodMetricOut(value=value, low=None, high=None)
        with np.errstate(divide="ignore", invalid="ignore"):
            draws = of(means[1:])
        draws = draws[np.isfinite(draws)]
        if sessions < FEWEST_SESSIONS or draws.size < DEFINED_SHARE * (len(means) - 1):
            return MethodMetricOut(value=value, low=None, high=None)
        interval = percentile_interval(draws, LEVEL)
        return MethodMetricOut(value=value, low=interval.low, high=interval.high)

    return make


def _repeated(pairs: Sequence[Pair]) -> bool:
    """Whether most policies have several sessions: else resamples never change which of two is better, and a regret seems sure."""
    return sum(len(p.returns) > 1 for p in pairs) > 0.5 * len(pairs)


def _covered(pairs: Sequence[Pair]) -> MethodMetricOut:
    return MethodMetricOut(value=float(np.mean([p.low <= p.actual <= p.high for p in pairs])), low=None, high=None)


def _ranks(values: Floats, there: NDArray[np.bool_]) -> Floats:
    """Mean ranks of every row less their mean, NaN where a cell is missing; NaN compares as neither less nor equal."""
    less = (values[:, None, :] < values[:, :, None]).sum(2)
    equal = (values[:, None, :] == values[:, :, None]).sum(2)
    ranks = np.where(there, less + 0.5 * (equal + 1), np.nan)
    return np.asarray(ranks - _nan_mean(ranks)[:, None], dtype=np.float64)


def _mae(means: Floats, estimated: Floats) -> Floats:
    return _nan_mean(np.abs(means - estimated))


def _range(means: Floats) -> Floats:
    there = np.isfinite(means)
    spread = np.where(there, means, -np.inf).max(1) - np.where(there, means, np.inf).min(1)
    return np.asarray(np.where(spread > 0, spread, np.nan), dtype=np.float64)


def _best(means: Floats) -> Floats:
    best = np.where(np.isfinite(means), means, -np.inf).max(1)
    return np.asarray(np.where(best != 0, best, np.nan), dtype=np.float64)


def _nan_mean(values: Floats) -> Floats:
    """Mean of the known values of every row; NaN where none is known."""
    there = np.isfinite(values)
    count = there.sum(1)
    return np.asarray(np.where(count > 0, np.where(there, values, 0.0).sum(1) / np.maximum(count, 1), np.nan), dtype=np.float64)


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
