"""Contrasts by sessions of similar doses alone."""

from __future__ import annotations

import numpy as np
import pytest

from ml.ope.posterior.learned.neighbours import SIGNALS, contrasts


def doses(means: np.ndarray) -> np.ndarray:
    return np.stack([means, means, np.zeros(means.size)], axis=1)


def test_a_straight_answer_is_found_whatever_the_levels_of_the_visits() -> None:
    rng = np.random.default_rng(0)
    means, visits = np.tile(np.linspace(0.3, 1.0, 8), 3), np.repeat([1, 2, 3], 8)
    values = 0.9 - 0.5 * means + np.array([0.1, -0.2, 0.05])[visits - 1] + 0.01 * rng.standard_normal(24)
    found = contrasts(doses(means), visits, values, 1.0, doses(np.array([0.4, 0.7, 1.0])), doses(np.ones(1))[0])
    assert found.mean == pytest.approx([0.3, 0.15, 0.0], abs=0.03)
    assert found.sd[2] == pytest.approx(0.0, abs=1e-6)
    assert found.sd[0] < 0.06


def test_far_from_all_sessions_the_error_is_larger() -> None:
    rng = np.random.default_rng(1)
    means, visits = rng.uniform(0.8, 1.0, 12), np.repeat([1, 2, 3], 4)
    found = contrasts(doses(means), visits, 0.1 * rng.standard_normal(12), 1.0, doses(np.array([0.1, 0.9])), doses(np.ones(1))[0])
    assert found.sd[0] > 2 * found.sd[1]


def test_too_few_values_say_nothing() -> None:
    values = np.array([1.0, 2.0, np.nan, np.nan])
    found = contrasts(doses(np.linspace(0.2, 1, 4)), np.ones(4, dtype=np.int64), values, 3.0, doses(np.array([0.4])), doses(np.ones(1))[0])
    assert found.mean.tolist() == [0.0]
    assert found.sd.tolist() == [3.0 * SIGNALS[1]]
