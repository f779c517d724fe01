"""Tested sessions as differences to the same visit's cDBS: means, standard errors and what is left out, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ml.ope.posterior.tested import LEAST_ERROR, TestSession, differences_to_cdbs


def of(policy: str | None, visit: int, **values: float) -> TestSession:
    return TestSession(policy, visit, values)


def test_each_policy_is_held_against_cdbs_of_its_own_visit_with_the_pooled_noise() -> None:
    """cDBS differs by 10 between the visits; within a visit and arm sessions differ by 2: each group of two has a square sum of 2."""
    sessions = [
        of(None, 1, rating=4.0), of(None, 1, rating=6.0), of("7", 1, rating=7.0), of("7", 1, rating=9.0),
        of(None, 2, rating=14.0), of(None, 2, rating=16.0), of("7", 2, rating=15.0),
    ]  # fmt: skip
    first, second = differences_to_cdbs(sessions)
    assert (first.policy_name, first.visit, first.n_sessions, second.visit, second.n_sessions) == ("7", 1, 2, 2, 1)
    assert (first.differences, second.differences) == ({"rating": 3.0}, {"rating": 0.0})
    noise = np.sqrt((2 + 2 + 2) / 3)
    assert first.standard_errors["rating"] == pytest.approx(noise * np.sqrt(1 / 2 + 1 / 2))
    assert second.standard_errors["rating"] == pytest.approx(noise * np.sqrt(1 + 1 / 2))


def test_a_visit_without_cdbs_says_nothing() -> None:
    sessions = [of("7", 3, rating=9.0), *(of(None, v, rating=r) for v, r in ((1, 4.0), (1, 6.0), (2, 5.0), (2, 5.5), (2, 6.0)))]
    assert differences_to_cdbs(sessions) == []


def test_where_nothing_ran_twice_at_a_visit_the_spread_over_visits_is_the_noise() -> None:
    sessions = [of(None, v, rating=r) for v, r in ((1, 4.0), (2, 6.0), (3, 8.0), (4, 6.0))] + [of("7", 1, rating=5.0)]
    (only,) = differences_to_cdbs(sessions)
    assert only.standard_errors["rating"] == pytest.approx(np.sqrt(8 / 3) * np.sqrt(2))


def test_a_quantity_of_unknown_noise_is_left_out_and_equal_sessions_prove_no_more_than_their_resolution() -> None:
    cdbs = [of(None, 1, energy=1.0, rating=5.0) for _ in range(4)]
    (only,) = differences_to_cdbs([*cdbs, of("7", 1, energy=0.4, rating=5.0, grasp_hz=2.0)])
    assert set(only.differences) == {"energy", "rating"}
    assert only.differences["energy"] == pytest.approx(-0.6)
    assert only.standard_errors["energy"] == pytest.approx(LEAST_ERROR["energy"] * np.sqrt(1 + 1 / 4))
