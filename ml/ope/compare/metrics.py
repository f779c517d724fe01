"""Metrics of off-policy estimates against actual returns. Source: Gao et al. 2023, appendix on OPE metrics; Fu et al. 2021."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

EXACT_PERMUTATIONS_UP_TO = 8
"""Policies up to which every permutation is counted (8! = 40 320)."""


@dataclass(frozen=True)
class Accuracy:
    """Metrics over policies.

    Attributes:
        mae: mean absolute error.
        mae_of_range: mae divided by max V - min V; None where that is no larger than the least range that counts.
        rank_correlation: Spearman's rho; None where one side has no spread.
        rank_p: two-sided permutation p-value of rho; None with rho.
        regret: raw regret@1, V of the best policy less V of the policy with the best estimate.
        regret_of_range: regret / (max V - min V); None as mae_of_range.
        regret_as_paper: regret / max V, as the paper writes it. Its sign turns when max V < 0: use the other two. None where |max V| is no
            larger than the least range that counts, for it explodes near 0.
        n: policies.
    """

    mae: float
    mae_of_range: float | None
    rank_correlation: float | None
    rank_p: float | None
    regret: float
    regret_of_range: float | None
    regret_as_paper: float | None
    n: int


def accuracy(actual: ArrayLike, estimated: ArrayLike, seed: int = 0, least_range: float = 0.0) -> Accuracy:
    """Compute all metrics of one method.

    Args:
        actual: actual return of each policy, shape [P].
        estimated: estimated return of each policy, shape [P].
        seed: of the sampled permutations, used when P > 8.
        least_range: what actual returns must differ by for a share of their range to be given, such as the noise of a session.

    Raises:
        ValueError: shapes differ, no policy, or a value that is not finite.
    """
    v = np.asarray(actual, dtype=np.float64)
    e = np.asarray(estimated, dtype=np.float64)
    if v.shape != e.shape or v.ndim != 1 or v.size == 0:
        raise ValueError(f"one actual and one estimated return per policy are needed, not {v.shape} and {e.shape}")
    if not (np.isfinite(v).all() and np.isfinite(e).all()):
        raise ValueError("actual and estimated returns must be finite numbers")
    spread = float(v.max() - v.min())
    mae = float(np.abs(v - e).mean())
    regret = float(v.max() - v[int(np.argmax(e))])
    rho = spearman(v, e)
    return Accuracy(
        mae=mae,
        mae_of_range=mae / spread if spread > least_range else None,
        rank_correlation=rho,
        rank_p=None if rho is None else spearman_p(v, e, seed=seed),
        regret=regret,
        regret_of_range=regret / spread if spread > least_range else None,
        regret_as_paper=regret / float(v.max()) if abs(v.max()) > least_range else None,
        n=v.size,
    )


def spearman(x: ArrayLike, y: ArrayLike) -> float | None:
    """Compute Spearman's rank correlation with mean ranks for ties; None where one side has no spread."""
    rx, ry = _centred_ranks(x), _centred_ranks(y)
    scale = float(np.sqrt(np.sum(rx**2) * np.sum(ry**2)))
    return float(np.sum(rx * ry) / scale) if scale > 0 else None


def spearman_p(x: ArrayLike, y: ArrayLike, *, draws: int = 20_000, seed: int = 0) -> float:
    """Compute the two-sided permutation p-value of Spearman's rho: exact up to 8 policies, else from random permutations and the
    observed order."""
    rx, ry = _centred_ranks(x), _centred_ranks(y)
    observed = abs(float(np.sum(rx * ry))) - 1e-9
    if rx.size <= EXACT_PERMUTATIONS_UP_TO:
        orders = np.array(list(permutations(range(rx.size))))
        return float(np.mean(np.abs(ry[orders] @ rx) >= observed))
    rng = np.random.default_rng(seed)
    hits = sum(abs(float(np.sum(rx * rng.permutation(ry)))) >= observed for _ in range(draws))
    return (hits + 1) / (draws + 1)


def _centred_ranks(values: ArrayLike) -> NDArray[np.float64]:
    ranks = scipy.stats.rankdata(np.asarray(values, dtype=np.float64))
    return np.asarray(ranks - ranks.mean(), dtype=np.float64)
