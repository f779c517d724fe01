"""Scores of estimates of candidates in one world, and their means, medians and worst deciles over worlds.

Shares are of the range of the candidates' true returns. Source of the metrics: Gao et al. 2023 (rank correlation, regret), SCOPE-RL
(SharpeRatio@k), Gneiting and Raftery 2007 (interval score).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ml.ope.compare.metrics import spearman

LEVEL = 0.90
TOP = 3
TEST_DRAWS = 50
FEWEST_SUPPORTED = 3
LARGEST_SHARPE = 10.0
"""SharpeRatio@k is cut here: three policies of one return have no spread to divide by."""


@dataclass(frozen=True)
class Told:
    """A method's interval of one difference of returns, and what is true of it.

    Attributes:
        low, high: of `LEVEL`. truth: the true difference. standard_error: of the truth.
    """

    low: float
    high: float
    truth: float
    standard_error: float

    @property
    def told(self) -> bool:
        """True where the interval excludes 0."""
        return self.low > 0 or self.high < 0

    @property
    def right(self) -> bool | None:
        """True where the sign that the interval shows is the true one; None where it shows none or the truth is within its error of 0."""
        if not self.told or abs(self.truth) < 2 * self.standard_error:
            return None
        return (self.low > 0) == (self.truth > 0)


def interval_score(low: np.ndarray, high: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Compute the width plus 2 / (1 - LEVEL) times the distance by which the truth is missed; small is good. Any shape."""
    penalty = 2 / (1 - LEVEL)
    return (high - low) + penalty * np.maximum(low - truth, 0) + penalty * np.maximum(truth - high, 0)


def world_scores(truth: Sequence[float], estimates: Sequence[Mapping[str, Any]], cdbs: float) -> dict[str, float | None]:
    """Compute metrics over all candidates of one world and, with " supported" behind their names, over those that the method supports.

    The latter are None below three of them, and where their true returns do not differ.

    Args:
        truth: true returns on new days, [P]. estimates: `value, low, high, supported` of each. cdbs: true return of cDBS.
    """
    supported = np.array([bool(e.get("supported", True)) for e in estimates])
    v = np.asarray(truth, dtype=np.float64)
    whole = _scores(v, estimates, cdbs)
    few = supported.sum() < FEWEST_SUPPORTED or np.ptp(v[supported]) == 0
    chosen = [e for e, kept in zip(estimates, supported, strict=True) if kept]
    part = dict.fromkeys(whole) if few else _scores(v[supported], chosen, cdbs)
    return {**whole, **{f"{metric} supported": value for metric, value in part.items()}, "supported": float(supported.mean())}


def _scores(v: np.ndarray, estimates: Sequence[Mapping[str, Any]], cdbs: float) -> dict[str, float]:
    """Score candidates of true returns [P], ordered by their estimates."""
    said, low, high = (np.array([e[k] for e in estimates], dtype=np.float64) for k in ("value", "low", "high"))
    spread = float(np.ptp(v))
    top = np.argsort(-said, kind="stable")
    first, best = int(top[0]), v[top[:TOP]]
    missed = not low[first] <= v[first] <= high[first]
    return {
        "rank": spearman(v, said) or 0.0,
        "regret": float(v.max() - v[first]) / spread,
        "sharpe": min(max(best.max() - cdbs, 0.0) / max(float(best.std()), 1e-9), LARGEST_SHARPE),
        "mae": float(np.abs(said - v).mean()) / spread,
        "interval score": float(interval_score(low, high, v).mean()) / spread,
        "width": float(np.median(high - low)) / spread,
        "coverage": float(np.mean((low <= v) & (v <= high))),
        "worst first": float(bool(v[first] <= v.min()) and missed),
    }


def scores_of_tests(
    truth: Sequence[float], spread_of_returns: Sequence[float], cdbs: float, sessions: int, draws: int = 50
) -> dict[str, Any]:
    """Compute mean metrics of testing every candidate itself, each in its share of `sessions`, each on a day of its own."""
    rng, v = np.random.default_rng(0), np.asarray(truth)
    error = np.asarray(spread_of_returns) / np.sqrt(max(sessions / v.size, 1.0))
    found = []
    for _ in range(TEST_DRAWS):
        said = v + error * rng.standard_normal(v.size)
        rows = [{"value": s, "low": s - 1.645 * e, "high": s + 1.645 * e} for s, e in zip(said, error, strict=True)]
        found.append(world_scores(truth, rows, cdbs))
    return {k: float(np.mean([f[k] for f in found])) for k in found[0] if found[0][k] is not None}


def over_worlds(values: Sequence[float | None], *, worst_is_low: bool) -> dict[str, float]:
    """Compute the mean with its standard error, median and worst decile; NaN where no world has the metric."""
    x = np.array([v for v in values if v is not None], dtype=np.float64)
    if x.size == 0:
        return dict.fromkeys(("mean", "error", "median", "decile"), float("nan"))
    error = float(x.std(ddof=1) / np.sqrt(x.size)) if x.size > 1 else float("nan")
    return {
        "mean": float(x.mean()),
        "error": error,
        "median": float(np.median(x)),
        "decile": float(np.quantile(x, 0.1 if worst_is_low else 0.9)),
    }


def signs(told: Sequence[Told]) -> tuple[float, float]:
    """Compute the share of right signs among those shown, and the share of differences without one; NaN without any."""
    right = [t.right for t in told if t.right is not None]
    return (float(np.mean(right)) if right else float("nan")), (1 - float(np.mean([t.told for t in told])) if told else float("nan"))
