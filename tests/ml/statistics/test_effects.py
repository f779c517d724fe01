"""Sizes of effects against counts of pairs and against the t interval; coverage of the bootstrap where it is used."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from ml.statistics.effects import SavingMethod, cliffs_delta, energy_saving, saving_contrasts
from ml.statistics.within_visits.contrasts import Measurements, Reason, Unavailable


def energies(shares, each=2, unit=1.0):
    """Build cDBS at `unit`, the controller saving a share at each visit."""
    visit = np.repeat(np.arange(len(shares)), 2 * each)
    arms = np.tile(np.repeat([False, True], each), len(shares))
    return Measurements.of(unit * np.where(arms, 1 - np.array(shares)[visit], 1.0), visit, arms)


def test_cliffs_delta_is_pairs_won_less_pairs_lost_averaged_over_visits():
    data = Measurements.of([1, 2, 3, 2, 9, 8, 8], [1, 1, 1, 1, 2, 2, 2], [0, 0, 1, 1, 0, 1, 0])
    first = np.sign(np.subtract.outer([3, 2], [1, 2])).mean()
    assert cliffs_delta(data).estimate == pytest.approx((first + -0.5) / 2)


def test_cliffs_delta_stays_within_its_range_even_where_every_pair_is_won():
    visit, arms = np.repeat([1, 2, 3], 4), np.tile([False, True], 6)
    found = cliffs_delta(Measurements.of(np.where(arms, 5.0, 1.0) + 0.1 * np.arange(12), visit, arms))
    assert (found.estimate, found.high) == (1.0, 1.0)
    assert 0 < found.low < 1
    assert found.p_value < 0.05


def test_below_five_visits_the_saving_has_the_t_interval():
    shares = [0.30, 0.42, 0.35, 0.38]
    found, expected = energy_saving(energies(shares)), ttest_1samp(shares, 0.0, alternative="two-sided")
    ends = expected.confidence_interval(0.95)
    assert found.method is SavingMethod.STUDENT
    assert (found.percent, found.low, found.high) == pytest.approx((36.25, 100 * ends.low, 100 * ends.high))
    assert found.p_value == pytest.approx(expected.pvalue / 2)
    assert found.by_visit == pytest.approx([30, 42, 35, 38])


def test_the_saving_does_not_depend_on_the_unit_of_energy():
    shares = [0.30, 0.42, 0.35, 0.38, 0.31, 0.2]
    one, other = energy_saving(energies(shares)), energy_saving(energies(shares, unit=37.0))
    assert (one.percent, one.low, one.high) == pytest.approx((other.percent, other.low, other.high))
    assert one.method is SavingMethod.BOOTSTRAP
    assert energy_saving(energies(shares)) == one


@pytest.mark.parametrize("visits", [5, 8])
def test_the_bootstrap_interval_covers_what_it_states(visits):
    rng = np.random.default_rng(visits)
    hits = []
    for seed in range(600):
        found = energy_saving(energies(rng.normal(0.4, 0.1, visits), each=1), draws=599, seed=seed)
        hits.append(found.low <= 40 <= found.high)
    assert 0.92 <= np.mean(hits) <= 0.98


def test_what_has_no_saving_has_a_typed_reason():
    assert energy_saving(energies([0.3, 0.3, 0.3])) == Unavailable(Reason.NO_VARIANCE)
    assert energy_saving(energies([0.3])) == Unavailable(Reason.TOO_FEW_VISITS, 1, 2)
    assert saving_contrasts(energies([0.3, 0.2], unit=0.0)) == Unavailable(Reason.NOT_IDENTIFIED)
    assert energy_saving(Measurements.of([], [], [])).reason is Reason.NO_SESSION


def test_a_stated_resolution_gives_equal_savings_an_interval():
    data = energies([0.3, 0.3, 0.3])
    coarse = Measurements.of(data.value, data.visit, data.tested, resolution=0.02)
    found = energy_saving(coarse)
    assert found.low < 30 < found.high
    assert found.p_value < 0.01


def test_a_saving_that_never_varies_is_held_against_the_resolution():
    exact = energies([0.4] * 6)
    assert energy_saving(exact) == Unavailable(Reason.NO_VARIANCE)
    found = energy_saving(Measurements.of(exact.value, exact.visit, exact.tested, resolution=0.05))
    # floor of one visit: 0.05^2 / 12 * (1/2 + 1/2); t with 5 degrees of freedom
    half = 2.570582 * 0.05 / 12**0.5 / 6**0.5
    assert (found.percent, found.method) == (pytest.approx(40.0), SavingMethod.STUDENT)
    assert (found.low, found.high) == pytest.approx((40 - 100 * half, 40 + 100 * half), abs=1e-4)
