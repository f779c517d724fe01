"""Number of sessions that would decide: against the closed form of a normal mean, and at its limits."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from ml.designs import LOW_AMPLITUDE, NEAR_SPREAD, Bound, near_session
from ml.mdp import MdpSettings
from ml.ope.posterior import verdict
from ml.ope.posterior.further_sessions import (
    Further,
    Needed,
    Place,
    reachable,
    return_noise,
    session_noise,
    sessions_to_tell,
    worth_exploring,
    worth_holding,
)
from ml.ope.posterior.support import LATE_STEPS, NEAR
from ml.ope.posterior.verdict import Levels
from ml.population.virtual import world
from ml.qoc import Qoc
from ml.returns import actual_return
from ml.trajectories import ReplayBuffer, SessionTrajectory
from tests.ml.ope.posterior.draws import RANKS


@pytest.fixture(autouse=True)
def plain_chances(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chances are the shares of draws, as the closed forms have them."""
    monkeypatch.setattr(verdict, "CALIBRATION", ((0.0, 0.0), (1.0, 1.0)))


def normal_draws(mean: float, sd: float) -> np.ndarray:
    """Compute draws without chance."""
    return np.asarray(norm.ppf(RANKS, mean, sd))


def told_share(mean: float, sd: float, noise: float, n: int) -> float:
    """Compute in closed form how often n sessions, up to four after one of cDBS, decide P(within) >= 0.8 or <= 0.2, one normal outcome.

    The posterior given the data is normal with variance v = 1 / (1 / sd^2 + 1 / (noise^2 (1 / n + 1 / visits))); its mean is normal
    around `mean` with variance sd^2 - v; P(within) = Phi(posterior mean / sqrt(v)).
    """
    v = 1 / (1 / sd**2 + 1 / (noise**2 * (1 / n + 1 / -(-n // 4))))
    spread = np.sqrt(sd**2 - v)
    return float(norm.sf(norm.ppf(0.8) * np.sqrt(v), mean, spread) + norm.cdf(norm.ppf(0.2) * np.sqrt(v), mean, spread))


@pytest.mark.parametrize(("mean", "sd", "noise"), [(1.0, 3.0, 1.0), (0.5, 4.0, 2.0), (2.0, 4.0, 1.5)])
def test_the_number_is_that_of_the_closed_form(mean: float, sd: float, noise: float) -> None:
    found = sessions_to_tell({"rating": normal_draws(mean, sd)}, {"rating": noise}, Levels())
    shares = {n: told_share(mean, sd, noise, n) for n in (1, 2, 3, 4, 6, 8, 12, 16, 24)}
    # 200 futures: the share has a standard error of 0.03
    surely, hardly = (next((n for n, p in shares.items() if p >= level), None) for level in (0.86, 0.74))
    assert hardly is not None
    assert found is not None
    assert hardly <= found.sessions <= (surely or 24)


def test_noisier_sessions_take_more_of_them_and_hopeless_ones_give_no_number() -> None:
    gaps = {"tremor_percent": normal_draws(3.0, 10.0)}
    quiet, loud = (sessions_to_tell(gaps, {"tremor_percent": noise}, Levels()) for noise in (2.0, 15.0))
    assert quiet is not None
    assert loud is None or loud.sessions > quiet.sessions
    assert sessions_to_tell(gaps, {"tremor_percent": 1000.0}, Levels()) is None
    assert sessions_to_tell(gaps, {}, Levels()) is None, "without the noise of a session no number is told"


def test_an_unsupported_policy_needs_two_sessions_on_two_visits_whatever_is_predicted() -> None:
    sure = {"rating": normal_draws(5.0, 0.5)}
    noise = {"rating": 1.0}
    assert sessions_to_tell(sure, noise, Levels()) == Needed(1, 1)
    assert sessions_to_tell(sure, noise, Levels(), supported=False) == Needed(2, 2)
    assert sessions_to_tell(sure, noise, Levels(), supported=False, near=(1, 1)) == Needed(1, 1), "on another visit than that one"
    assert sessions_to_tell(sure, noise, Levels(), supported=False, near=(3, 1)) == Needed(1, 1)


def test_sessions_that_show_nothing_of_the_policy_would_not_tell() -> None:
    gaps = {"rating": normal_draws(1.0, 2.0)}
    rng = np.random.default_rng(0)
    alike = gaps["rating"] + rng.normal(0, 0.1, len(RANKS))
    of_something_else = rng.permutation(gaps["rating"])
    noise = {"rating": 0.5}
    assert sessions_to_tell(gaps, noise, Levels(), shown={"rating": alike}) is not None
    assert sessions_to_tell(gaps, noise, Levels(), shown={"rating": of_something_else}) is None


def test_what_would_not_surely_save_energy_is_told_by_no_session() -> None:
    gaps, noise = {"rating": normal_draws(1.0, 1.5)}, {"rating": 0.5}
    rng = np.random.default_rng(0)
    assert sessions_to_tell(gaps, noise, Levels(), saved=np.full(len(RANKS), 0.3)) is not None
    assert sessions_to_tell(gaps, noise, Levels(), saved=rng.normal(0.1, 0.3, len(RANKS))) is None


@pytest.mark.parametrize("dose", [0.44, 0.5, 0.6, 0.75, 0.9])
def test_what_is_named_is_held_so_near_that_it_supports_the_policy(dose: float) -> None:
    found = reachable(dose, Place(Bound(0.3), 300, 2.0))
    assert found is not None
    assert found.level >= dose - NEAR_SPREAD
    for seed in range(50):
        a = near_session(found.level, 300, 2.0, Bound(0.3), seed, 0).amplitudes
        assert abs(a.mean() - dose) <= NEAR[0]
        assert abs(a[-LATE_STEPS:].mean() - dose) <= NEAR[1]


def test_a_dose_that_no_session_may_hold_is_not_named() -> None:
    assert reachable(0.4, Place(Bound(0.3), 300, 2.0)) is None, "of ten minutes the first five are above 0.6"
    assert reachable(0.4, Place(Bound(0.3), 150, 2.0)) is not None, "five minutes may be low all along"
    assert reachable(0.45, Place(Bound(0.6), 300, 2.0)) is None, "below B"


def test_slots_hold_what_would_tell_soonest_and_the_same_sessions_once() -> None:
    soon, same, late = Further(2, 1, 0.7), Further(2, 1, 0.72), Further(6, 2, 0.5)
    waiting = {"late": (late, 0.7), "soon": (soon, 0.6), "likelier": (same, 0.75)}
    found = worth_holding(waiting, 4)
    assert [(h.names, h.fraction, h.here) for h in found] == [(("likelier", "soon"), 0.72, 2), (("late",), 0.5, 2)]
    assert [h.here for h in worth_holding(waiting, 10)] == [2, 3], "half of the sessions that must be of two visits"
    assert worth_holding(waiting, 0) == worth_holding({}, 4) == ()


def test_exploring_holds_the_lowest_amplitude_that_a_whole_session_may_hold() -> None:
    (found,) = worth_exploring(Place(Bound(0.3)), 3)
    assert (found.here, found.further) == (3, None)
    for seed in range(20):
        assert near_session(found.fraction, 300, 2.0, Bound(0.3), seed, 0).amplitudes.min() >= LOW_AMPLITUDE
    assert worth_exploring(Place(Bound(0.9)), 3) == worth_exploring(Place(Bound(0.3)), 0) == ()


def buffer_of(*rows: tuple[int, str, int | None]) -> ReplayBuffer:
    """Build sessions of visit, controller and rating."""
    beta = np.ones(5)
    sessions = [
        SessionTrajectory(i, visit, controller, np.ones(3), beta, beta, Qoc(rating=rating))
        for i, (visit, controller, rating) in enumerate(rows)
    ]
    return ReplayBuffer(MdpSettings(xi_beta=1.0, window=3), tuple(sessions), "uV", "table")


def test_the_noise_of_a_session_is_that_within_controller_and_visit() -> None:
    """Visits and controllers differ by 5 points, sessions of one group by 2: squares of 2 in each of three groups of two."""
    rows = [(1, "cdbs", 7), (1, "cdbs", 9), (2, "cdbs", 2), (2, "cdbs", 4), (2, "rl", 8), (2, "rl", 10), (3, "cdbs", None)]
    assert session_noise(buffer_of(*rows)) == {"rating": pytest.approx(np.sqrt(2.0))}


def test_random_sessions_count_only_where_the_others_are_too_few() -> None:
    random = [(1, "random", 1), (1, "random", 9), (1, "random", 1), (1, "random", 9)]
    assert session_noise(buffer_of(*random, (1, "cdbs", 7))) == {"rating": pytest.approx(np.sqrt(64 / 3))}
    steady = [(1, "cdbs", 7), (1, "cdbs", 7), (2, "cdbs", 7), (2, "cdbs", 8), (2, "cdbs", 8)]
    assert session_noise(buffer_of(*random, *steady))["rating"] < 1


def test_the_noise_of_a_return_is_never_taken_as_none_because_cdbs_ran_too_seldom() -> None:
    """One cDBS session a visit, as a plan with one or two policies has: the random sessions, wider by their doses, speak instead."""
    buffer = world("A", 2).data("stratified")
    cdbs = [s for s in buffer.sessions if s.controller == "cdbs"]
    first = [next(s for s in cdbs if s.visit == visit) for visit in {s.visit for s in cdbs}]
    random = [s for s in buffer.sessions if s.controller == "random"]
    seldom = replace(buffer, sessions=(*random, *first))
    groups = defaultdict(list)
    for s in random:
        groups[s.visit].append(actual_return(s, buffer.settings, 300).value)
    expected = np.sqrt(sum(np.sum((np.array(g) - np.mean(g)) ** 2) for g in groups.values()) / sum(len(g) - 1 for g in groups.values()))
    assert return_noise(seldom, 300) == pytest.approx(float(expected))
    assert 0 < return_noise(replace(buffer, sessions=tuple(cdbs)), 300) == return_noise(buffer, 300), "cDBS alone where it ran often"


def test_too_few_sessions_tell_no_noise() -> None:
    assert session_noise(buffer_of((1, "cdbs", 7), (1, "cdbs", 9), (2, "cdbs", 3))) == {}
