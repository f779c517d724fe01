"""The posterior against closed forms, and the power against studies that are carried on as it says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import nct, t

from ml.statistics.power import MOST_VISITS, Posterior, Target, posterior, power, success
from ml.statistics.within_visits.averages import primary
from ml.statistics.within_visits.contrasts import Measurements, Reason, Unavailable, VisitContrasts


def study(visits=8, each=4, effect=0.5, between=0.5, seed=0):
    rng = np.random.default_rng(seed)
    visit, arms = np.repeat(np.arange(visits), 2 * each), np.tile([False, True], visits * each)
    slope = effect + between * rng.standard_normal(visits)
    return Measurements.of(rng.standard_normal(visits)[visit] + slope[visit] * arms + rng.standard_normal(visit.size), visit, arms)


def test_with_many_visits_the_posterior_finds_effect_and_both_deviations():
    found = posterior(study(visits=200, effect=0.7, between=0.8), draws=4000)
    assert found.effect.mean() == pytest.approx(0.7, abs=0.12)
    assert found.effect.std() == pytest.approx(np.sqrt((0.8**2 + 0.5) / 200), rel=0.12)
    assert found.between.mean() == pytest.approx(0.8, abs=0.15)
    assert found.within.mean() == pytest.approx(1.0, abs=0.05)


def test_the_posterior_covers_the_effect_in_few_visits():
    hits = []
    for seed in range(300):
        found = posterior(study(visits=4, effect=0.5, between=0.7, seed=seed), draws=600, seed=seed)
        low, high = np.quantile(found.effect, (0.05, 0.95))
        hits.append(low <= 0.5 <= high)
    assert 0.85 <= np.mean(hits) <= 0.98


def test_known_deviations_and_no_visit_yet_give_the_power_of_the_t_test():
    draws = 20_000
    nothing = VisitContrasts(*(np.zeros(0, dtype=np.int64),), *(np.zeros(0),), *(np.zeros(0, dtype=np.int64),) * 2, np.zeros(1), 0.0)
    known = Posterior(np.full(draws, 1.0), np.full(draws, 0.6), np.full(draws, 0.8), nothing)
    found = success(known, Target(0.0, "greater", 0.05, 2), 4).mean(0)
    sd = np.sqrt(0.6**2 + 0.8**2 / 2)
    for visits in (3, 6):
        critical = t.ppf(0.95, visits - 1)
        assert found[visits - 1] == pytest.approx(nct.sf(critical, visits - 1, np.sqrt(visits) / sd), abs=0.012)
    assert found[0] == 0.0


@pytest.mark.parametrize("alternative", ["greater", "two_sided"])
def test_of_a_bounded_metric_the_power_is_that_of_the_larger_p(alternative):
    seen, effects = np.array([0.9, 1.0, 1.1, -0.3]), np.linspace(0.0, 1.5, 61)
    ones, floor, shown = np.ones(4, dtype=np.int64), np.zeros(4), {}
    for bounded in (True, False):
        of = Posterior(effects, np.zeros(61), np.zeros(61), VisitContrasts(np.arange(4), seen, ones, ones, floor, 0.0, bounded))
        shown[bounded] = success(of, Target(0.1, alternative, 0.05, 2), 3)
        for effect, row in zip(effects, shown[bounded], strict=True):
            for k in (1, 5):  # further visits show just the effect
                value = np.c_[np.zeros(4 + k), [*(seen - 0.1), *np.full(k, effect - 0.1)]].ravel()
                found = primary(Measurements.of(value, np.repeat(np.arange(4 + k), 2), [0, 1] * (4 + k), bounded=bounded))
                assert row[k - 1] == ((found.p_above(0.0) if alternative == "greater" else found.p_value) < 0.05)
    assert (shown[False] & ~shown[True]).any(), "the larger p is to cost something here"
    assert not (shown[True] & ~shown[False]).any()


def test_sessions_do_not_replace_visits_where_visits_differ():
    found = power(study(visits=3, between=1.5, seed=4), Target(), sessions_per_arm=2)
    generous = power(study(visits=3, between=1.5, seed=4), Target(), sessions_per_arm=1000)
    assert found.limit == generous.limit
    assert np.allclose(generous.power, generous.limit, atol=0.03)
    assert found.limit[0] < found.limit[5]
    assert found.limit[0] < 0.9


def test_sessions_do_help_where_they_are_what_varies():
    quiet = study(visits=5, each=8, effect=0.9, between=0.0, seed=1)
    one, many = (power(quiet, Target(), sessions_per_arm=n) for n in (1, 50))
    assert sum(many.power) > sum(one.power)
    assert len(one.power) == len(one.more_visits) == MOST_VISITS


def test_no_test_is_counted_on_before_there_are_enough_visits():
    found = power(study(visits=1, effect=20.0, between=0.0), Target(0.0, "greater", 0.05, least_visits=4))
    assert found.power[:2] == (0.0, 0.0)
    assert found.power[2] > 0


def test_nothing_to_plan_from_is_a_typed_reason():
    assert power(Measurements.of([1, 2], [1, 1], [0, 1]), Target()) == Unavailable(Reason.TOO_FEW_SESSIONS)
    assert power(Measurements.of([], [], []), Target()).reason is Reason.NO_SESSION
    same = Measurements.of(np.ones(8), np.repeat([1, 2], 4), [0, 1] * 4)
    assert power(same, Target()).reason is Reason.ALL_EQUAL
    days_differ = Measurements.of(np.repeat([1.0, 2.0], 4), np.repeat([1, 2], 4), [0, 1] * 4)
    assert power(days_differ, Target()).reason is Reason.NO_VARIANCE
    with pytest.raises(ValueError, match="at least one session"):
        power(study(), Target(), sessions_per_arm=0)
