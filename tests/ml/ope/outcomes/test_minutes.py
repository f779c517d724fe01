"""Sessions by minute against plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.ope.outcomes.minutes import (
    ABOVE,
    AMPLITUDE,
    BETA,
    DOSE,
    ENERGY,
    OVER,
    SHAPES,
    TOLERATED,
    by_minute,
    minute_bounds,
    of_buffer,
    step_features,
)
from ml.trajectories import ReplayBuffer, SessionTrajectory

SETTINGS = MdpSettings(xi_beta=1.0)


def test_minutes_are_counted_from_the_end_and_hold_the_means_of_their_known_steps():
    rng = np.random.default_rng(0)
    beta, a = rng.uniform(0.5, 1.5, 75), rng.uniform(0, 1, 75)
    beta[50], a[60] = np.nan, np.nan
    assert minute_bounds(75, 2.0) == [(0, 15), (15, 45), (45, 75)]
    found = by_minute(beta, a, SETTINGS)
    np.testing.assert_allclose(found.share, np.array([15, 30, 28]) / 73)
    np.testing.assert_allclose(found.late, np.array([0, 30, 28]) / 58)
    rows = [k for k in range(45, 75) if k not in (50, 60)]
    last = found.features[2]
    assert last[AMPLITUDE] == pytest.approx(np.mean([a[k] for k in rows]))
    assert last[ENERGY] == pytest.approx(np.mean([a[k] ** 2 for k in rows]))
    assert last[BETA] == pytest.approx(np.mean([beta[k] for k in rows]))
    assert last[ABOVE] == pytest.approx(np.mean([beta[k] >= 1.0 for k in rows]))
    assert last[OVER] == pytest.approx(np.mean([max(0, a[k] ** 2 - TOLERATED) / (1 - TOLERATED) for k in rows]))
    for j, (half, steep) in enumerate(SHAPES[1:], start=1):
        hill = [(1 + half**steep) * a[k] ** steep / (half**steep + a[k] ** steep) for k in rows]
        assert last[DOSE + j] == pytest.approx(np.mean(hill))


def test_every_dose_shape_rises_from_0_without_stimulation_to_1_at_cdbs():
    a = np.linspace(0, 1, 51)
    found = step_features(np.ones(51), a, 1.0)[:, DOSE:]
    np.testing.assert_allclose(found[0], 0, atol=1e-12)
    np.testing.assert_allclose(found[-1], 1)
    assert (np.diff(found, axis=0) > 0).all()


def test_a_shorter_session_has_no_share_in_minutes_that_it_did_not_last():
    sessions = tuple(SessionTrajectory(i, 1, "other", np.ones(10), np.ones(steps), np.full(steps, 0.5)) for i, steps in enumerate((90, 30)))
    found = of_buffer(ReplayBuffer(SETTINGS, sessions, "uV", "table"))
    np.testing.assert_allclose(found.share, [[1 / 3, 1 / 3, 1 / 3], [0, 0, 1]])
    np.testing.assert_allclose(found.late, [[0, 0.5, 0.5], [0, 0, 1]])
    np.testing.assert_allclose(found.means[:, AMPLITUDE], 0.5)


def test_a_session_without_a_known_step_has_features_of_zero_and_no_nan():
    found = by_minute(np.full(60, np.nan), np.full(60, 0.5), SETTINGS)
    assert np.isfinite(found.features).all()
    np.testing.assert_allclose(found.share.sum(), 1)
