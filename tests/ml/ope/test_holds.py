"""One hold is one decision: weights of sustained draws in closed form, and abstention by name where a policy acts within a hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.designs import Hold
from ml.ope.behaviour import clones
from ml.ope.doubly_robust import DoublyRobust
from ml.ope.fqe.estimator import FqeConfig
from ml.ope.fqe.steps import TargetActions
from ml.ope.holds import abstention
from ml.ope.importance import ImportanceSampling, kernel_log_density
from ml.policies.logged_range import random_bound
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.population.virtual import world
from ml.trajectories import ReplayBuffer

WIDTH = 0.1


def held_buffer(log_density=-0.3):
    """Simulate a buffer of 12 random sessions whose amplitudes last 10 steps each."""
    w = world("A", 2)
    random = [s for s in w.data("paper").sessions if s.controller == "random"]
    rng, sessions = np.random.default_rng(0), []
    for s in random:
        draws = rng.uniform(0.3, 1.0, 30)
        holds = tuple(Hold(10 * i, 10, log_density) for i in range(30))
        sessions.append(replace(s, amplitude=np.repeat(draws, 10), holds=holds))
    return ReplayBuffer(w.settings, tuple(sessions), "uV", "table")


def test_a_hold_is_weighed_once_and_by_its_own_density():
    buffer = held_buffer()
    log_ratio, mask, _ = ImportanceSampling("wis", bandwidth=WIDTH).fit(buffer).log_ratios(ConstantPolicy(0.6), 300)
    a = buffer.sessions[3].amplitude
    assert mask.all()
    np.testing.assert_allclose(log_ratio[3, ::10], kernel_log_density(a[::10], np.full(30, 0.6), WIDTH) + 0.3)
    assert np.count_nonzero(log_ratio[3]) == 30  # a step-by-step weight would count every draw ten times
    assert ImportanceSampling("wis", bandwidth=WIDTH).fit(buffer)._abstentions(ConstantPolicy(0.6), 300) == ()


def test_a_hold_is_weighed_at_its_first_usable_step():
    buffer = held_buffer()
    first = buffer.sessions[0]
    amplitude = first.amplitude.copy()
    amplitude[:3] = np.nan
    gap = replace(buffer, sessions=(replace(first, amplitude=amplitude), *buffer.sessions[1:]))
    log_ratio, mask, _ = ImportanceSampling("wis", bandwidth=WIDTH).fit(gap).log_ratios(ConstantPolicy(0.6), 300)
    assert not mask[0, :3].any()
    assert log_ratio[0, 3] == pytest.approx(float(kernel_log_density(amplitude[3:4], np.array([0.6]), WIDTH)[0]) + 0.3)
    assert np.count_nonzero(log_ratio[0]) == 30


@pytest.mark.parametrize("method", ["wis", "cwpdis"])
def test_importance_sampling_abstains_by_name_for_a_policy_that_acts_within_a_hold(method):
    buffer = held_buffer()
    xi = buffer.settings.xi_beta
    follows = ProportionalPolicy(0.8 * xi, 1.2 * xi, 0.0, 1)
    found = ImportanceSampling(method, bandwidth=WIDTH).fit(buffer).evaluate({"follows": follows, "fixed": ConstantPolicy(0.6)}, 300)
    flag = next(f for f in found["follows"].flags if f.code == "acts_within_hold")
    assert (flag.value, flag.unit, flag.refuses) == (12.0, "sessions", True)
    assert not found["follows"].supported
    assert np.isfinite(found["follows"].value)
    assert "acts_within_hold" not in {f.code for f in found["fixed"].flags}


@pytest.mark.parametrize(("apart", "acts"), [(0.9 * WIDTH, False), (1.1 * WIDTH, True)])
def test_what_moves_by_less_than_the_kernel_can_tell_is_one_decision(apart, acts):
    session = held_buffer().sessions[0]
    steps = np.arange(300)
    moving = np.where(steps % 10 < 5, 0.6, 0.6 + apart)
    assert abstention(session, steps, moving, WIDTH) == ("acts_within_hold" if acts else None)
    between = np.where(steps // 10 % 2 == 0, 0.6, 0.6 + 3 * WIDTH)
    assert abstention(session, steps, between, WIDTH) is None, "what changes where a new draw was made acts within none"


def test_held_draws_of_no_stated_design_have_no_weight():
    buffer = held_buffer(log_density=None)
    found = ImportanceSampling("wis", bandwidth=WIDTH).fit(buffer).evaluate({"fixed": ConstantPolicy(0.6)}, 300)["fixed"]
    flag = next(f for f in found.flags if f.code == "hold_density_unknown")
    assert (flag.value, flag.refuses) == (12.0, True)
    assert not found.supported
    assert found.details["sessions_of_known_density"] == 0
    with pytest.raises(ValueError, match="no session to weigh"):
        ImportanceSampling("wis", only_random=True).fit(buffer)


def test_a_doubly_robust_estimate_is_not_corrected_by_what_cannot_be_weighed():
    xi = held_buffer().settings.xi_beta
    follows = ProportionalPolicy(0.8 * xi, 1.2 * xi, 0.0, 1)
    fitted = DoublyRobust(FqeConfig(refits=2), bandwidth=WIDTH).fit(held_buffer())
    table = fitted.fqe.table
    _, acting = fitted._log_ratios(TargetActions.of(table, follows), 300)
    ratios, fixed = fitted._log_ratios(TargetActions.of(table, ConstantPolicy(0.6)), 300)
    assert not acting.any()
    assert fixed.all()
    assert (np.count_nonzero(ratios, axis=1) == 30).all()


def test_the_bound_of_held_sessions_is_kept_and_they_are_not_taken_for_draws_at_every_step():
    buffer = held_buffer()
    assert random_bound(buffer) == buffer.settings.lower_bound
    assert all(s.uniform_bound is None for s in buffer.sessions)
    stand_in, _ = clones(buffer)["random", None]
    states = buffer.transitions().states[:50]
    np.testing.assert_array_equal(stand_in.act(states), stand_in.act(states))  # a controller that draws again would differ


def test_designed_worlds_carry_the_densities_of_their_design():
    w = world("A", 2)
    random = [s for s in w.data("stratified").sessions if s.controller == "random"]
    assert all(s.holds and all(h.log_density is not None for h in s.holds) for s in random)
    for s in random:
        for h in s.holds:
            assert np.ptp(s.amplitude[h.start : h.start + h.steps]) == 0
    assert all(not s.holds for s in w.data("paper").sessions)
