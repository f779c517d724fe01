"""Sizes of effects: Cliff's delta within visits, and the stimulation energy that a controller saves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from ml.statistics.bootstrap import resamples
from ml.statistics.within_visits.averages import primary
from ml.statistics.within_visits.contrasts import (
    Average,
    Measurements,
    Reason,
    Unavailable,
    VisitContrasts,
    average,
    visit_contrasts,
)

Floats = NDArray[np.float64]

BOOTSTRAP_FROM = 5
"""Visits from which the interval of the saving is a bootstrap of visits; fewer have too few different resamples."""


class SavingMethod(StrEnum):
    """Method by which the interval of a saving was computed."""

    STUDENT = "t"
    BOOTSTRAP = "bootstrap_t"


@dataclass(frozen=True)
class Saving:
    """Stimulation energy saved against the same visit's cDBS.

    Attributes:
        percent: average over visits. low, high: its interval of `level`, per cent; at most 100.
        p_value: one-sided, of no saving.
        by_visit: per cent, [V]. visits: numbers of these visits.
    """

    percent: float
    low: float
    high: float
    level: float
    p_value: float
    by_visit: tuple[float, ...]
    visits: tuple[int, ...]
    method: SavingMethod


def cliffs_delta(data: Measurements, level: float = 0.95) -> Average | Unavailable:
    """Estimate Cliff's delta within visits: how much more often the controller's value is the higher one than the lower one (Cliff 1993).

    Returns:
        The average over visits, between -1 and 1 with its interval cut there; or why there is none, as in `visits.primary`.
    """
    wins = primary(replace(data, bounded=True), level, "win_probability")  # a share of pairs ends at 0 and 1, whatever the metric
    if isinstance(wins, Unavailable):
        return wins
    low, high = max(-1.0, 2 * wins.low - 1), min(1.0, 2 * wins.high - 1)
    return replace(wins, estimate=2 * wins.estimate - 1, low=low, high=high, standard_error=2 * wins.standard_error, null=0.0)


def saving_contrasts(energy: Measurements) -> VisitContrasts | Unavailable:
    """Compute the share of energy saved at every visit: one less the ratio of the arms' means.

    Args:
        energy: energy of every session in one unit, or relative to cDBS. `resolution` in the same unit.

    Returns:
        The shares, or why there is none: as in `visit_contrasts`, or a visit whose cDBS sessions have no energy.
    """
    plain = visit_contrasts(energy)
    if isinstance(plain, Unavailable):
        return plain
    means = energy.cells.means(energy.value[energy.cells.rows])[:, 1]
    if not (means > 0).all():
        return Unavailable(Reason.NOT_IDENTIFIED)
    return replace(plain, contrast=-plain.contrast / means, floor=plain.floor / means**2)


def energy_saving(energy: Measurements, level: float = 0.95, *, draws: int = 1999, seed: int = 0) -> Saving | Unavailable:
    """Estimate the energy saved on average over visits. From five visits on the interval is a bootstrap of visits. With fewer, or where
    visits differ by less than the energy's resolution, it uses t.

    The bootstrap is that of Student's ratio (Efron and Tibshirani 1993, chapter 12.5). Percentile and BCa intervals of five visits cover
    far less than they state.

    Args:
        energy: as in `saving_contrasts`.
        level: coverage of the interval. draws: resamples. seed: of them.

    Returns:
        The saving, or why there is none: as in `visits.average`.
    """
    shares = saving_contrasts(energy)
    if isinstance(shares, Unavailable):
        return shares
    whole = average(shares, level)
    if isinstance(whole, Unavailable):
        return whole
    visits, by_visit = tuple(shares.visit.tolist()), tuple((100 * shares.contrast).tolist())
    low, high, p, method = whole.low, whole.high, whole.p_above(0.0), SavingMethod.STUDENT
    # where the visits vary less than the resolution, resampling shows nothing of their spread
    if shares.visits >= BOOTSTRAP_FROM and float(shares.contrast.var(ddof=1)) > float(shares.floor.mean()):
        ratios = student_ratios(shares.contrast, draws, seed)
        top, bottom = np.quantile(ratios, [(1 + level) / 2, (1 - level) / 2])
        low = whole.estimate - float(top) * whole.standard_error
        high = whole.estimate - float(bottom) * whole.standard_error
        p = float((1 + np.sum(ratios >= whole.estimate / whole.standard_error)) / (ratios.size + 1))
        method = SavingMethod.BOOTSTRAP
    high = min(float(high), max(1.0, whole.estimate))  # no controller saves more than all of it
    return Saving(100 * whole.estimate, 100 * float(low), 100 * high, level, p, by_visit, visits, method)


def student_ratios(values: Floats, draws: int, seed: int) -> Floats:
    """Compute Student's ratio of resamples of values [V] about their mean; resamples with a single distinct value have none."""
    drawn = values[resamples(values.size, draws, seed)]
    spread = drawn.std(axis=1, ddof=1)
    usable = spread > 1e-12 * max(1.0, float(np.abs(values).max()))
    ratios: Floats = (drawn.mean(1)[usable] - values.mean()) / (spread[usable] / np.sqrt(values.size))
    return ratios
