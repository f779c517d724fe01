"""Data that give no reason to believe an order of policies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.ope.outcomes.model import fit_end_model
from ml.ope.posterior.estimator import Posterior, PosteriorConfig
from ml.ope.posterior.held_out import HeldOut
from ml.ope.posterior.skill import ordering_skill
from ml.policies.policy import ConstantPolicy
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer
from tests.ml.ope.posterior.known_system import KnownSystem

BUFFER = KnownSystem().buffer()
N = len(BUFFER.sessions)
DOSES = np.array([s.amplitude.mean() for s in BUFFER.sessions])
RNG = np.random.default_rng(0)
OBSERVED = -0.8 + 0.5 * DOSES + 0.05 * RNG.standard_normal(N)


EQUAL = np.full(N, OBSERVED.mean())


def skill(predicted, levels=None, buffer=BUFFER, equal=EQUAL):
    found = HeldOut({"a": np.zeros(N)}, {"a": np.asarray(predicted)}, OBSERVED, {"a": 1.0})
    return ordering_skill(buffer, found, equal, fit_end_model(buffer), np.zeros(N) if levels is None else levels)


def test_predictions_that_follow_what_happened_are_skill() -> None:
    found = skill(OBSERVED + 0.05 * RNG.standard_normal(N))
    assert (found.told, found.reasons) == (True, ())
    assert found.held_out_correlation > 0.8


def test_a_contrast_between_controllers_with_the_wrong_sign_is_named() -> None:
    found = skill(-0.8 - 0.5 * DOSES)
    assert not found.told
    assert "contrasts_not_reproduced" in found.reasons


def test_levels_of_random_sessions_that_go_with_their_dose_are_named() -> None:
    assert "levels_follow_dose" in skill(OBSERVED, levels=2.0 * DOSES + 0.02 * RNG.standard_normal(N)).reasons
    assert "levels_follow_dose" not in skill(OBSERVED, levels=RNG.standard_normal(N)).reasons


def test_few_sessions_tell_nothing() -> None:
    few = replace(BUFFER, sessions=BUFFER.sessions[:4])
    found = HeldOut({"a": np.zeros(4)}, {"a": OBSERVED[:4]}, OBSERVED[:4], {"a": 1.0})
    assert ordering_skill(few, found, EQUAL[:4], fit_end_model(few), np.zeros(4)).reasons == ("too_few_left_out_sessions",)


def of_visits_alone(seed: int) -> ReplayBuffer:
    """Simulate sessions that differ in the level of their visit, in beta and in outcomes, and answer to nothing."""
    buffer, rng = KnownSystem(depth=0.0).buffer(seed=seed), np.random.default_rng([seed, 9])
    level, rating = np.exp(0.2 * rng.standard_normal(4)), rng.standard_normal(4)
    sessions = []
    for s in buffer.sessions:
        qoc = Qoc(2.5 + 0.1 * rng.standard_normal(), int(np.clip(np.round(6 + rating[s.visit] + rng.standard_normal()), 1, 10)), 0.0)
        sessions.append(replace(s, beta=s.beta * level[s.visit], lead_beta=s.lead_beta * level[s.visit], qoc=qoc))
    return replace(buffer, sessions=tuple(sessions), settings=replace(buffer.settings, xi_beta=1.0))


def told(buffer: ReplayBuffer) -> bool:
    found = Posterior(PosteriorConfig(draws=24)).fit(buffer).evaluate({"half": ConstantPolicy(0.5)}, 40)
    return bool(found["half"].details["skill"]["told"])


def test_levels_of_visits_are_no_skill() -> None:
    assert not any(told(of_visits_alone(seed)) for seed in range(2))


@pytest.mark.slow
def test_noise_is_taken_for_skill_in_no_more_than_a_fifth() -> None:
    """Four questions with two standard errors each, by their measured rate (`MARGIN`)."""
    assert sum(told(of_visits_alone(seed)) for seed in range(20)) <= 4


def test_a_reduction_of_errors_by_chance_is_no_skill() -> None:
    """Half of the sessions are predicted a little better than by their mean, the others a little worse."""
    bare = replace(BUFFER, sessions=tuple(replace(s, qoc=Qoc()) for s in BUFFER.sessions))
    sign = np.where(np.arange(N) % 2, 1.0, -1.02)
    found = skill(OBSERVED - (OBSERVED - EQUAL) * (1 - 0.1 * sign), buffer=bare)
    assert found.reasons == ("no_better_than_equal",)


def test_outcomes_that_follow_the_dose_are_skill_where_beta_says_nothing() -> None:
    assert skill(EQUAL).told


def test_outcomes_are_asked_whether_or_not_they_count_in_the_reward_at_the_end() -> None:
    """Verdicts rest on each of them, so that one that follows the dose is skill among others that are noise."""
    unweighted = replace(BUFFER, settings=replace(BUFFER.settings, c2=0.0, c3=0.0, c4=0.0))
    assert skill(EQUAL, buffer=unweighted).told
    rng = np.random.default_rng(4)
    noisy = [
        replace(s, qoc=replace(s.qoc, rating=int(rng.integers(1, 11)), tremor_percent=float(rng.uniform(0, 60)))) for s in BUFFER.sessions
    ]
    assert skill(EQUAL, buffer=replace(BUFFER, sessions=tuple(noisy))).told
    noise = [replace(s, qoc=replace(s.qoc, grasp_hz=float(rng.uniform(1, 3)))) for s in noisy]
    assert not skill(EQUAL, buffer=replace(BUFFER, sessions=tuple(noise))).told
