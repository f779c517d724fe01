"""Errors of left-out sessions and visits against those of sessions and visits that are truly new, in a known hierarchical model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit

from ml.mdp import MdpSettings
from ml.ope.outcomes.minutes import by_minute
from ml.ope.outcomes.model import fit_end_model
from tests.ml.ope.outcomes.test_model import buffer_of

SETTINGS = MdpSettings(xi_beta=2.0, c2=10.0, c3=2.0, c4=10.0)
STEPS, PER_VISIT, VISITS = 300, 4, 5


def simulated(rng, visits, *, of_days=1.0):
    """Simulate doses, grasp, rating and tremor (%) of the sessions of visits [visits, PER_VISIT]; days move all three."""
    dose = rng.uniform(0.2, 1.0, (visits, PER_VISIT))
    day = of_days * rng.standard_normal((3, visits, 1))
    noise = rng.standard_normal((2, *dose.shape))
    grasp = 1.0 + 0.8 * dose + 0.3 * day[0] + 0.15 * noise[0]
    tremor = 10.0 * rng.binomial(10, expit(2.0 - 5.0 * dose + 0.8 * day[1]))
    rating = np.clip(np.round(4.0 + 3.0 * dose - 0.02 * tremor + 0.7 * day[2] + 0.6 * noise[1]), 1, 10)
    return dose, grasp, rating, tremor


def fitted(dose, grasp, rating, tremor):
    visits = np.repeat(np.arange(len(dose)), PER_VISIT)
    return fit_end_model(buffer_of(dose.ravel(), grasp.ravel(), visits, tremor.ravel(), SETTINGS, rating.ravel(), steps=STEPS))


def outcomes(grasp, rating, tremor):
    return np.stack([10 * grasp + 2 * rating - 10 * tremor / 100, grasp, rating, tremor], axis=-1)


def squared_errors(seed):
    """Compute mean squared errors [4] of held-out sessions, of held-out visits, and of new visits predicted from the same number of
    visits.
    """
    rng = np.random.default_rng([seed, 0x1EF7])
    data, new = simulated(rng, VISITS), simulated(rng, 30)
    model, before = fitted(*data), fitted(*(v[:-1] for v in data))
    dose = new[0].ravel()
    said = before.predict(by_minute(np.ones((len(dose), STEPS)), dose[:, None] * np.ones(STEPS), SETTINGS))
    truly_new = ((said - outcomes(*(v.ravel() for v in new[1:]))) ** 2).mean(0)
    return np.stack([model.by_session.residual**2, model.by_visit.residual**2, truly_new])


def test_left_out_visits_err_as_new_visits_do_and_left_out_sessions_by_less():
    found = np.stack([squared_errors(seed) for seed in range(40)])
    apart = found[:, 1] - found[:, 2]
    error = apart.std(0, ddof=1) / np.sqrt(len(apart))
    assert (np.abs(apart.mean(0)) < 3 * error).all(), (found.mean(0), error)
    assert (error < 0.25 * found[:, 2].mean(0)).all()
    session = found[:, 0] - found[:, 2]
    assert (session.mean(0) < -2 * session.std(0, ddof=1) / np.sqrt(len(session)))[[0, 1, 2]].all()


def test_the_skill_of_a_left_out_visit_is_held_against_the_mean_of_the_other_visits():
    rng = np.random.default_rng(3)
    dose, grasp, rating, tremor = simulated(rng, 4)
    model = fitted(dose, grasp, rating, tremor)
    table = outcomes(grasp, rating, tremor)
    others = np.stack([np.delete(table, v, axis=0).reshape(-1, 4).mean(0) for v in range(4)])[:, None]
    errors = ((model.by_visit.predicted.reshape(table.shape) - table) ** 2).mean((0, 1))
    np.testing.assert_allclose(model.by_visit.residual, np.sqrt(errors))
    np.testing.assert_allclose(model.by_visit.skill, 1 - errors / ((others - table) ** 2).mean((0, 1)))
    told = model.predictability()["grasp_hz"]
    assert told["visit_skill"] == pytest.approx(model.by_visit.skill[1], abs=1e-4)
    assert told["session_error"] == pytest.approx(model.by_session.residual[1], abs=1e-4)


def test_of_a_single_visit_no_day_to_come_can_be_judged():
    rng = np.random.default_rng(4)
    dose, grasp, rating, tremor = (np.reshape(v, (1, -1)) for v in simulated(rng, 3))
    model = fit_end_model(buffer_of(dose[0], grasp[0], np.zeros(12), tremor[0], SETTINGS, rating[0], steps=STEPS))
    assert np.isnan(model.by_visit.predicted).all()
    assert model.predictability()["grasp_hz"]["visit_error"] is None
    assert np.isfinite(model.by_session.predicted).all()


def test_the_rating_of_a_left_out_visit_does_not_know_the_tremor_of_its_sessions():
    # ratings follow the tremor alone, which follows nothing: without the tremor the rating cannot be predicted
    rng = np.random.default_rng(5)
    dose, tremor = rng.uniform(0.2, 1.0, 32), 10.0 * rng.integers(0, 11, 32)
    rating = np.clip(np.round(9.0 - 0.06 * tremor), 1, 10)
    model = fit_end_model(buffer_of(dose, np.full(32, 2.0), np.arange(32) // 8, tremor, replace(SETTINGS, c3=10.0), rating, steps=STEPS))
    assert model.by_visit.skill[2] < 0.3
    assert model.by_session.skill[2] > 0.8
