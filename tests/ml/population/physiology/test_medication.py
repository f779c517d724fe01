from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ml.population import PARTICIPANTS
from ml.population.days import day_effect
from ml.population.physiology.medication import LONG_DURATION_FLOOR, effect, effect_site_curve


def test_exposure_of_one_tablet_is_dose_times_bioavailability_over_clearance():
    assert np.trapezoid(effect_site_curve(), dx=1 / 120) == pytest.approx(100 * 0.84 / 30.9, rel=1e-3)


def test_the_effect_site_follows_the_differential_equations():
    def rates(_, y):
        gut, central, peripheral, site = y
        flow = 34.6 * (central / 11.4 - peripheral / 27.3)
        return [-2.5 * gut, 2.5 * gut - 30.9 * central / 11.4 - flow, flow, np.log(2) / 0.4 * (central / 11.4 - site)]

    solution = solve_ivp(rates, (0, 6), [84.0, 0, 0, 0], t_eval=[0.5, 1, 2, 6], rtol=1e-9, atol=1e-12)
    assert effect_site_curve()[[60, 120, 240, 720]] == pytest.approx(solution.y[3], rel=1e-6)


def test_levodopa_wears_off_before_noon_comes_back_with_the_second_tablet_and_never_falls_below_the_floor():
    hours = np.linspace(-1, 6, 500)
    twice = effect(PARTICIPANTS["P1"].regimen, hours)
    assert twice.min() >= LONG_DURATION_FLOOR
    assert np.interp(-1, hours, twice) > 0.6
    assert np.interp(2.5, hours, twice) < LONG_DURATION_FLOOR + 0.05
    assert np.interp(4, hours, twice) > 0.6
    once = effect(PARTICIPANTS["P4"].regimen, hours)
    assert np.interp(4, hours, once) < LONG_DURATION_FLOOR + 0.05


def test_participant_2_takes_no_levodopa_and_its_effect_is_constant():
    assert np.array_equal(effect(PARTICIPANTS["P2"].regimen, np.linspace(0, 6, 5)), np.full(5, 0.15))


def test_a_day_is_the_same_for_all_its_sessions_and_another_for_another_visit_or_study():
    assert day_effect(1, 3, 7) == day_effect(1, 3, 7)
    assert len({day_effect(1, 3, 7), day_effect(1, 4, 7), day_effect(1, 3, 8), day_effect(2, 3, 7)}) == 4


def test_days_differ_around_a_slow_progression_of_a_few_per_mille_a_month():
    """Over 4000 runs of the study: means within four standard errors, spreads within 5 %."""
    first, last = ([day_effect(1, visit, study) for study in range(4000)] for visit in (1, 13))
    gains = np.array([[d.log_gain for d in days] for days in (first, last)])
    assert gains.mean(axis=1) == pytest.approx([0.0, 12 * 0.003], abs=4 * 0.08 / np.sqrt(4000))
    assert gains.std(axis=1) == pytest.approx([0.08, 0.08], rel=0.05)
    assert np.std([np.log(d.dose_factor) for d in last]) == pytest.approx(0.25, rel=0.05)
