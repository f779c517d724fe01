"""Outcomes of a session from its summaries: levels of visits, severity, and r_end as the sum of its parts."""

from __future__ import annotations

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.ope.linear.end_outcomes import SUMMARIES, fit_end_model, summarise
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory

W, T = 10, 40
SETTINGS = MdpSettings(xi_beta=2.0, c2=10.0, c3=0.0, c4=0.0)


def buffer_of(doses, grasps, visits, tremors=None, settings=SETTINGS, beta=None):
    sessions = []
    for i, (dose, grasp, visit) in enumerate(zip(doses, grasps, visits, strict=True)):
        level = np.full(W + T, 1.0 if beta is None else beta[i])
        tremor = None if tremors is None else float(tremors[i])
        qoc = Qoc(grasp_hz=float(grasp), rating=7, tremor_percent=tremor)
        sessions.append(SessionTrajectory(i, int(visit), "other", level[:W], level[W:], np.full(T, float(dose)), qoc=qoc))
    return ReplayBuffer(settings, tuple(sessions), "uV", "table")


def at(dose, beta=1.0, xi=2.0):
    return summarise(np.full(T, beta), np.full(T, float(dose)), xi)


def slope(model, low=0.5, high=0.9):
    return float((model.predict(at(high)) - model.predict(at(low)))[1] / (high - low))


def test_a_good_day_is_not_taken_for_a_good_amplitude():
    # Low amplitudes were tried on two good days, high ones on two bad days; within a day more amplitude is better.
    rng = np.random.default_rng(0)
    visits = np.repeat([1, 2, 3, 4], 6)
    doses = np.where(visits <= 2, 0.45, 0.85) + np.tile([-0.1, -0.06, -0.02, 0.02, 0.06, 0.1], 4)
    grasps = 2.0 + 1.0 * doses + np.where(visits <= 2, 0.6, -0.6) + 0.02 * rng.standard_normal(24)
    assert np.polyfit(doses, grasps, 1)[0] < -1.0
    model = fit_end_model(buffer_of(doses, grasps, visits))
    assert slope(model) == pytest.approx(1.0, abs=0.25)
    assert model.day_share[1] > 0.8


def test_a_controller_that_gives_more_in_bad_hours_does_not_hide_what_the_amplitude_does():
    rng = np.random.default_rng(1)
    n = 30
    severity = rng.standard_normal(n)
    follows = np.arange(n) % 3 > 0
    doses = np.where(follows, np.clip(0.65 + 0.12 * severity, 0.0, 1.0), rng.choice([0.5, 0.65, 1.0], n))
    grasps = 1.5 + 1.0 * doses - 0.5 * severity + 0.05 * rng.standard_normal(n)
    buffer = buffer_of(doses, grasps, np.arange(n) // 6)
    confounded, adjusted = fit_end_model(buffer), fit_end_model(buffer, severity=severity)
    assert slope(confounded) < 0.3
    assert slope(adjusted) == pytest.approx(1.0, abs=0.2)
    drawn = fit_end_model(buffer, severity=severity, draws=300, seed=2)
    slopes = [slope(drawn.with_weights(w)) for w in drawn.weights]
    assert np.quantile(slopes, 0.05) < 1.0 < np.quantile(slopes, 0.95)


def test_r_end_is_that_of_the_predicted_outcomes_and_each_stays_within_its_range():
    settings = MdpSettings(xi_beta=2.0, c2=10.0, c3=5.0, c4=20.0)
    doses = np.linspace(0.1, 1.0, 16)
    model = fit_end_model(buffer_of(doses, 1 + doses, np.arange(16) // 4, np.clip(120 * (1 - doses), 0, 100), settings))
    found = model.predict(np.stack([at(d) for d in (0.0, 0.5, 1.0)]))
    for row in found:
        assert row[0] == pytest.approx(10 * row[1] + 5 * row[2] - 20 * row[3] / 100)
    assert found[0, 3] == 100.0
    assert model.constants is not None


def test_an_outcome_that_counts_and_was_never_measured_leaves_r_end_unseen():
    settings = MdpSettings(xi_beta=2.0, c2=10.0, c3=0.0, c4=10.0)
    model = fit_end_model(buffer_of([0.4, 0.6, 0.8, 1.0], [1.4, 1.6, 1.8, 2.0], [1, 1, 2, 2], None, settings))
    assert model.seen == (False, True, True, False)
    assert model.constants is None


def test_without_sessions_of_different_amplitude_the_draws_say_that_its_effect_is_not_known():
    rng = np.random.default_rng(3)
    doses = 0.65 + 0.01 * rng.standard_normal(18)
    grasps = 2.0 + 0.2 * rng.standard_normal(18)
    drawn = fit_end_model(buffer_of(doses, grasps, np.arange(18) // 6), draws=200, seed=0)
    ends = [float(drawn.with_weights(w).predict(at(0.2))[1]) for w in drawn.weights]
    near = [float(drawn.with_weights(w).predict(at(0.65))[1]) for w in drawn.weights]
    assert np.std(ends) > 5 * np.std(near)


def test_refits_on_resamples_of_all_sessions_in_order_are_the_fit_at_the_likeliest_variances():
    rng = np.random.default_rng(4)
    doses = rng.uniform(0.3, 1.0, 12)
    buffer = buffer_of(doses, 1 + doses + 0.1 * rng.standard_normal(12), np.arange(12) // 4)
    same = np.tile(np.arange(12), (3, 1))
    refits = fit_end_model(buffer, same)
    assert refits.weights.shape == (3, len(SUMMARIES) + 1, 4)
    np.testing.assert_allclose(refits.weights[0], refits.weights[2])
    np.testing.assert_allclose(
        refits.with_weights(refits.weights[0]).predict(at(0.6))[1], fit_end_model(buffer).predict(at(0.6))[1], atol=0.1
    )
