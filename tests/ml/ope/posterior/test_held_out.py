"""Predictions of left-out sessions and the weights of structures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from ml.ope.lead import dose_before
from ml.ope.posterior.held_out import OWN_VARIANCE, SHRINK, held_out, log_density, weights_of
from ml.ope.posterior.structures import STRUCTURES, fit_linear, no_answer
from ml.ope.scale import learn_scale


def test_a_lead_in_every_session_takes_the_weight_and_luck_in_one_does_not() -> None:
    rng = np.random.default_rng(0)
    base = rng.normal(-30, 3, 20)
    everywhere = weights_of({"good": base + 2.0, "bad": base}, 0)
    assert everywhere["good"] > 0.99
    lucky = base.copy()
    lucky[3] += 6.0
    once = weights_of({"lucky": lucky, "plain": base}, 0)
    # exp(6) = 403 to 1 by the sum alone; the bootstrap and the learning rate leave the other structure its share
    assert 0.2 < once["plain"] < 0.5
    assert sum(once.values()) == pytest.approx(1)


def test_structures_that_cannot_be_told_apart_share_alike() -> None:
    base = np.random.default_rng(1).normal(size=12)
    assert weights_of({"a": base, "b": base.copy()}, 0) == pytest.approx({"a": 0.5, "b": 0.5})
    assert weights_of({"a": base[:1], "b": base[:1]}, 0) == {"a": 0.5, "b": 0.5}


def test_the_density_of_block_sums_is_the_shrunk_normals() -> None:
    rng = np.random.default_rng(2)
    runs, seen = rng.normal(size=(40, 3)) @ np.array([[2, 0.5, 0], [0, 1, 0.2], [0, 0, 3.0]]), np.array([0.3, -1.0, 2.0])
    covariance = (1 - SHRINK) * np.cov(runs.T)
    np.fill_diagonal(covariance, np.cov(runs.T).diagonal() + OWN_VARIANCE)
    assert log_density(seen, runs) == pytest.approx(multivariate_normal(runs.mean(0), covariance).logpdf(seen))


def test_an_answer_to_the_amplitude_predicts_left_out_sessions_better_than_none(known_buffer) -> None:
    scale, before = learn_scale(known_buffer), dose_before(known_buffer)
    fits = [fitter(known_buffer, scale, 10, 0, before) for fitter in STRUCTURES.values()]
    found = held_out(known_buffer, scale, [*fits, no_answer(fit_linear(known_buffer, scale, 10, 0, before), known_buffer)], 0)
    assert set(found.weights) == {*STRUCTURES, "equal"}
    assert found.weights["equal"] < 0.02
    for key in STRUCTURES:
        assert np.corrcoef(found.predicted[key], found.observed)[0, 1] > 0.7
