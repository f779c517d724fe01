from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ml.ope.compare.metrics import accuracy
from ml.ope.dlmm import Dlmm, DlmmConfig, DlmmNetworks
from ml.ope.flags import FEW_END_REWARDS
from ml.policies.policy import ConstantPolicy
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer

TINY = DlmmConfig(latent=2, hidden=(8,), members=2, updates=30, rollouts=8)


def test_the_bound_is_the_exact_log_likelihood_where_encoder_and_prior_agree_and_the_decoder_ignores_z():
    networks = DlmmNetworks(3, TINY).double()
    with torch.no_grad():
        for parameter in networks.parameters():
            parameter.zero_()
        networks.encoder.affine.bias[2:] = np.log(4.0)  # bounded(log 4) = -4 + 5 * 0.8 = 0: q = N(0, I)
    states, actions = torch.zeros(4, 3, dtype=torch.float64), torch.zeros(4, 1, dtype=torch.float64)
    targets = torch.tensor([[0.3, -1.0], [0.0, 0.0], [2.0, 1.0], [-1.0, 0.5]], dtype=torch.float64)
    sigma = torch.tensor(-1.5, dtype=torch.float64).exp()  # bounded(0) = -4 + 5 / 2
    exact = torch.distributions.Normal(torch.zeros(2, dtype=torch.float64), sigma).log_prob(targets).sum(1)
    bound = networks.bound(states, actions, targets, torch.randn(4, 2, dtype=torch.float64))
    torch.testing.assert_close(bound, exact)


def test_the_bound_lies_below_the_likelihood_that_many_samples_of_the_prior_give():
    torch.manual_seed(0)
    networks = DlmmNetworks(3, replace(TINY, hidden=(8,))).double()
    state, action = torch.randn(1, 3, dtype=torch.float64), torch.rand(1, 1, dtype=torch.float64)
    target = torch.randn(1, 2, dtype=torch.float64)
    n = 20_000
    z = torch.randn(n, 2, dtype=torch.float64)
    with torch.no_grad():
        mean, log_std = networks.decoder(torch.cat([z, action.expand(n, 1)], dim=1))
        log_p = torch.distributions.Normal(mean, log_std.exp()).log_prob(target).sum(1)
        marginal = float(torch.logsumexp(log_p, 0) - np.log(n))
        noise = torch.randn(n, 2, dtype=torch.float64)
        bound = networks.bound(state.expand(n, 3), action.expand(n, 1), target.expand(n, 2), noise).mean()
    assert float(bound) < marginal


def test_the_same_seed_gives_the_same_estimates_and_another_seed_others(small_buffer):
    policies = {"low": ConstantPolicy(0.4), "high": ConstantPolicy(0.9)}
    first, again, other = (Dlmm(replace(TINY, seed=s)).fit(small_buffer).evaluate(policies, 20)["low"].value for s in (1, 1, 2))
    assert first == again
    assert first != other


def test_policies_that_act_alike_get_the_same_roll_outs_whatever_stands_beside_them(small_buffer):
    fitted = Dlmm(TINY).fit(small_buffer)
    alone = fitted.evaluate({"half": ConstantPolicy(0.5)}, 20)["half"]
    beside = fitted.evaluate({"full": ConstantPolicy(1.0), "half": ConstantPolicy(0.5)}, 20)["half"]
    assert beside.value == pytest.approx(alone.value, rel=1e-6)


class TwoFaced:
    """0.5 in the logged states, next to nothing in simulated ones."""

    def __init__(self, logged_states):
        self.logged_states = logged_states

    def act(self, states):
        return np.full(len(states), 0.5) if len(states) == self.logged_states else np.linspace(0.0, 0.08, len(states))


def test_a_check_that_fails_in_simulated_sessions_is_shown_beside_a_flag_of_the_logged_ones(small_buffer):
    policies = {"two-faced": TwoFaced(len(small_buffer.transitions().states)), "half": ConstantPolicy(0.5)}
    found = Dlmm(TINY).fit(small_buffer).evaluate(policies, 20)
    flags = {(f.code, f.source): f for f in found["two-faced"].flags}
    assert flags["no_closed_loop", "logged"].value == pytest.approx(0.5)
    assert flags["as_good_as_off", "simulated"].value == 1.0
    assert flags["thin", "simulated"].refuses
    assert not found["two-faced"].supported
    assert [f.code for f in found["half"].flags].count("no_closed_loop") == 1


def test_without_any_qoc_the_estimate_is_the_step_return_and_says_so(small_buffer):
    bare = ReplayBuffer(small_buffer.settings, tuple(replace(s, qoc=Qoc()) for s in small_buffer.sessions), "uV", "table")
    estimate = Dlmm(TINY).fit(bare).evaluate({"half": ConstantPolicy(0.5)}, 20)["half"]
    assert estimate.end_reward is None
    assert estimate.value == pytest.approx(estimate.step_return)
    assert FEW_END_REWARDS in estimate.flags


def test_one_session_is_too_few(small_buffer):
    one = ReplayBuffer(small_buffer.settings, small_buffer.sessions[:1], "uV", "table")
    with pytest.raises(ValueError, match="at least two sessions"):
        Dlmm(TINY).fit(one)


def test_cancelling_stops_a_fit(small_buffer):
    def stop(fraction, message="", **numbers):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Dlmm(TINY).fit(small_buffer, stop)


@pytest.mark.slow
def test_on_a_system_whose_next_beta_follows_the_window_and_the_action_it_ranks_constant_amplitudes(linear_simulator):
    config = DlmmConfig(members=1, updates=1200, rollouts=64, learning_rate=3e-3)
    fitted = Dlmm(config).fit(linear_simulator.buffer(seed=0))
    estimates, truth = fitted.evaluate(linear_simulator.policies(), 300), linear_simulator.truth(n=300)
    names = list(truth)
    step = accuracy([truth[n][0] for n in names], [estimates[n].step_return for n in names])
    assert step.rank_correlation > 0.9
    # The linear system rests at 0.55 / 0.45 - (0.25 / 0.45) a.
    for a in (0.35, 0.65, 1.0):
        assert estimates[f"constant {a}"].predicted["mean_beta"] == pytest.approx((0.55 - 0.25 * a) / 0.45, abs=0.08)
