"""Several participants: each a result of its own, and a random-effects summary that claims nothing about a population.

Sources. Paule and Mandel 1982: variance between participants. Hartung and Knapp 2001: interval. Roever, Knapp and Friede 2015: the factor
that never makes an interval narrower than the normal one. Higgins, Thompson and Spiegelhalter 2009: prediction interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import bdtr, stdtr, stdtrit

from ml.statistics.within_visits.contrasts import Average, Reason, Unavailable

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Summary:
    """A random-effects summary.

    Attributes:
        estimate: average over participants. low, high: its interval of `level`, on t with one degree of freedom fewer than participants.
        p_value: two-sided, of no average effect.
        between_sd: of the effects between participants. heterogeneity: share of the spread that is no sampling error (I^2).
        predicted_low, predicted_high: where the effect in a further participant like these would lie; None with fewer than three
            participants.
        participants: k. sign_p: two-sided sign test of the participants' effects. smallest_sign_p: what k participants can reach at best.
        population_claim: whether the sign test could reach the level at all; False with fewer than six participants at 5 %.
    """

    estimate: float
    low: float
    high: float
    level: float
    p_value: float
    between_sd: float
    heterogeneity: float
    predicted_low: float | None
    predicted_high: float | None
    participants: int
    sign_p: float
    smallest_sign_p: float
    population_claim: bool


def pool(results: Sequence[Average | Unavailable], level: float = 0.95) -> Summary | Unavailable:
    """Summarise the participants that have a result; needs two of them."""
    averages = [r for r in results if isinstance(r, Average)]
    estimates = np.array([r.estimate - r.null for r in averages])
    return pool_estimates(estimates, np.array([r.standard_error for r in averages]), level)


def pool_estimates(estimates: Floats, errors: Floats, level: float = 0.95) -> Summary | Unavailable:
    """Summarise estimates [k] with standard errors [k].

    Raises:
        ValueError: a standard error that is not above zero, or a level outside (0, 1).
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of an interval must be between 0 and 1, not {level}")
    k = estimates.size
    if k < 2:
        return Unavailable(Reason.TOO_FEW_PARTICIPANTS, k, 2)
    if not (errors > 0).all():
        raise ValueError("every estimate needs a standard error above 0")
    tau2 = paule_mandel(estimates, errors)
    weight = 1 / (tau2 + errors**2)
    mean = float(weight @ estimates / weight.sum())
    factor = max(1.0, float(weight @ (estimates - mean) ** 2) / (k - 1))
    error = float(np.sqrt(factor / weight.sum()))
    half = float(stdtrit(k - 1, (1 + level) / 2)) * error
    spread = float(stdtrit(k - 2, (1 + level) / 2)) * float(np.sqrt(tau2 + error**2)) if k > 2 else None
    precision = errors**-2.0
    fixed = precision @ estimates / precision.sum()
    q = float(precision @ (estimates - fixed) ** 2)
    smallest = 2.0 ** (1 - k)
    return Summary(
        mean,
        mean - half,
        mean + half,
        level,
        2 * float(stdtr(k - 1, -abs(mean) / error)),
        float(np.sqrt(tau2)),
        max(0.0, 1 - (k - 1) / q) if q > 0 else 0.0,
        None if spread is None else mean - spread,
        None if spread is None else mean + spread,
        k,
        sign_test(estimates),
        smallest,
        smallest <= 1 - level,
    )


def paule_mandel(estimates: Floats, errors: Floats) -> float:
    """Find the variance between participants at which the weighted sum of squares is its expectation k - 1; 0 where it is already below."""

    def excess(tau2: float) -> float:
        weight = 1 / (tau2 + errors**2)
        mean = weight @ estimates / weight.sum()
        return float(weight @ (estimates - mean) ** 2) - (estimates.size - 1)

    if excess(0.0) <= 0:
        return 0.0
    top = float(np.ptp(estimates)) ** 2 + float(errors.max()) ** 2
    return float(scipy.optimize.brentq(excess, 0.0, top * estimates.size, xtol=1e-14 * top))


def sign_test(values: Floats) -> float:
    """Compute the two-sided p of the sign test: values above and below zero are equally likely. Zeros are excluded."""
    above, below = int(np.sum(values > 0)), int(np.sum(values < 0))
    if above + below == 0:
        return 1.0
    return min(1.0, 2 * float(bdtr(min(above, below), above + below, 0.5)))
