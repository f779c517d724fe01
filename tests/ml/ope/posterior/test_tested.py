"""Tested sessions as differences to the same visit's cDBS: means, standard errors and exclusions, by hand and by closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ml.mdp import MdpSettings
from ml.ope.posterior.tested import LEAST_ERROR, PRIOR_FREEDOM, Spread, TestSession, differences_to_cdbs, spread_of_random
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory


def of(policy: str | None, visit: int, **values: float) -> TestSession:
    return TestSession(policy, visit, values)


def widened(freedom: float) -> float:
    """Compute the half-width of the central 68.3 % of Student's t, as that of the standard normal is 1."""
    return float(stats.t.ppf(stats.norm.cdf(1.0), freedom))


def test_each_policy_is_held_against_cdbs_of_its_own_visit_with_the_pooled_noise() -> None:
    """cDBS differs by 10 between the visits; within a visit and arm sessions differ by 2: each group of two has a square sum of 2."""
    sessions = [
        of(None, 1, rating=4.0), of(None, 1, rating=6.0), of("7", 1, rating=7.0), of("7", 1, rating=9.0),
        of(None, 2, rating=14.0), of(None, 2, rating=16.0), of("7", 2, rating=15.0),
    ]  # fmt: skip
    first, second = differences_to_cdbs(sessions).tests
    assert (first.policy_name, first.visit, first.n_sessions, second.visit, second.n_sessions) == ("7", 1, 2, 2, 1)
    assert (first.differences, second.differences) == ({"rating": 3.0}, {"rating": 0.0})
    noise = np.sqrt((2 + 2 + 2) / 3) * widened(3)
    assert first.standard_errors["rating"] == pytest.approx(noise * np.sqrt(1 / 2 + 1 / 2))
    assert second.standard_errors["rating"] == pytest.approx(noise * np.sqrt(1 + 1 / 2))


def test_a_visit_without_cdbs_says_nothing_and_its_sessions_are_counted() -> None:
    sessions = [of("7", 3, rating=9.0), *(of(None, v, rating=r) for v, r in ((1, 4.0), (1, 6.0), (2, 5.0), (2, 5.5), (2, 6.0)))]
    found = differences_to_cdbs(sessions)
    assert (found.tests, found.without_cdbs, found.of_unknown_noise) == ((), 1, 0)


def test_where_nothing_ran_twice_at_a_visit_the_spread_over_visits_is_the_noise() -> None:
    sessions = [of(None, v, rating=r) for v, r in ((1, 4.0), (2, 6.0), (3, 8.0), (4, 6.0))] + [of("7", 1, rating=5.0)]
    (only,) = differences_to_cdbs(sessions).tests
    assert only.standard_errors["rating"] == pytest.approx(np.sqrt(8 / 3) * widened(3) * np.sqrt(2))


def test_one_cdbs_session_a_visit_lets_the_tests_of_the_third_count() -> None:
    """The visit as it is laid out for one or two policies. Two degrees of freedom, and days in them: the error is wide, and there."""
    sessions = [of(None, v, rating=r) for v, r in ((1, 4.0), (2, 6.0), (3, 8.0))] + [of("a", 3, rating=5.0), of("b", 3, rating=9.0)]
    found = differences_to_cdbs(sessions)
    assert [(t.policy_name, t.differences["rating"]) for t in found.tests] == [("a", -3.0), ("b", 1.0)]
    assert [t.standard_errors["rating"] for t in found.tests] == pytest.approx([np.sqrt(8 / 2) * widened(2) * np.sqrt(2)] * 2)
    assert found.of_unknown_noise == 0


def test_random_sessions_tell_the_noise_of_a_first_visit_with_one_session_each() -> None:
    sessions = [of(None, 1, rating=8.0), of("7", 1, rating=5.0)]
    unknown = differences_to_cdbs(sessions)
    assert (unknown.tests, unknown.of_unknown_noise) == ((), 1)
    (only,) = differences_to_cdbs(sessions, {"rating": Spread(4.0, 6)}).tests
    assert only.standard_errors["rating"] == pytest.approx(2.0 * widened(6) * np.sqrt(2))


def test_the_prior_weighs_as_much_as_its_degrees_of_freedom() -> None:
    """Scaled inverse chi-square: (n0 s0^2 + sum of squares) / (n0 + n); Satterthwaite's degrees of freedom of that sum."""
    sessions = [of(None, 1, rating=r) for r in (4.0, 5.0, 6.0)] + [of("7", 1, rating=5.0)]
    (only,) = differences_to_cdbs(sessions, {"rating": Spread(4.0, 6)}).tests
    squares, prior = 2.0, PRIOR_FREEDOM * 4.0
    freedom = (squares + prior) ** 2 / (squares**2 / 2 + prior**2 / 6)
    sd = np.sqrt((squares + prior) / (2 + PRIOR_FREEDOM)) * widened(freedom)
    assert only.standard_errors["rating"] == pytest.approx(sd * np.sqrt(1 + 1 / 3))


@pytest.mark.parametrize(("n_cdbs", "prior"), [(2, None), (3, None), (5, None), (1, 4), (1, 8)])
def test_a_difference_lies_within_its_standard_error_as_often_as_it_says(n_cdbs: int, prior: int | None) -> None:
    """Student's t: noise of 2 points, one session of the policy, `n_cdbs` of cDBS; or a prior alone, of as many degrees of freedom."""
    rng, sets = np.random.default_rng(5), 4000
    within = 0
    for _ in range(sets):
        sessions = [of(None, 1, rating=float(r)) for r in rng.normal(6.0, 2.0, n_cdbs)] + [of("7", 1, rating=float(rng.normal(5.0, 2.0)))]
        known = {"rating": Spread(4.0 * float(rng.chisquare(prior)) / prior, prior)} if prior is not None else None
        (only,) = differences_to_cdbs(sessions, known).tests
        within += abs(only.differences["rating"] + 1.0) < only.standard_errors["rating"]
    # the floor of a rating widens a few of the smallest errors, least of all where there are few degrees of freedom
    assert within / sets == pytest.approx(0.683, abs=0.03)


def test_a_quantity_of_unknown_noise_is_left_out_and_equal_sessions_prove_no_more_than_their_resolution() -> None:
    cdbs = [of(None, 1, energy=1.0, rating=5.0) for _ in range(4)]
    found = differences_to_cdbs([*cdbs, of("7", 1, energy=0.4, rating=5.0, grasp_hz=2.0), of(None, 1, grasp_hz=2.5)])
    (only,) = found.tests
    assert set(only.differences) == {"energy", "rating"}
    assert found.of_unknown_noise == 1
    assert only.differences["energy"] == pytest.approx(-0.6)
    assert only.standard_errors["energy"] == pytest.approx(LEAST_ERROR["energy"] * np.sqrt(1 + 1 / 4))


def drawn(number: int, visit: int, amplitude: float, qoc: Qoc, **more: object) -> SessionTrajectory:
    steps = np.full(30, amplitude)
    return SessionTrajectory(number, visit, "random", np.full(5, 40.0), np.full(30, 40.0), steps, qoc, **more)  # type: ignore[arg-type]


def test_the_spread_of_random_sessions_is_what_visits_and_a_line_over_the_dose_leave() -> None:
    """Grasp rises by 2 Hz per unit of energy from other levels at two visits; what is added is orthogonal to both: squares of 4 x 0.01."""
    added = iter((0.1, -0.1, -0.1, 0.1, 0.0, 0.0, 0.0))
    sessions = []
    for visit, level, energies in ((1, 1.0, (0.2, 0.4, 0.6, 0.8)), (2, 1.5, (0.3, 0.5, 0.9))):
        for energy in energies:
            grasp = level + 2.0 * energy + next(added)
            sessions.append(drawn(len(sessions), visit, float(np.sqrt(energy)), Qoc(grasp, None, 10.0)))
    sessions.append(drawn(90, 1, 0.7, Qoc(0.0, 1, 100.0), stopped_as=Qoc(0.0, 1, 100.0)))
    found = spread_of_random(ReplayBuffer(MdpSettings(window=5, xi_beta=50.0), tuple(sessions), "mV", "table"), 30)
    assert set(found) == {"grasp_hz", "tremor_percent"}, "energy is the dose, no rating was given, and no return is known without it"
    assert found["grasp_hz"].freedom == 7 - 2 - 1
    assert found["grasp_hz"].variance == pytest.approx(0.04 / 4)
    assert found["tremor_percent"].variance == pytest.approx(0.0, abs=1e-9)
