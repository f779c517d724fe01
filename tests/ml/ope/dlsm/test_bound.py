"""The evidence lower bound against exact likelihoods, and the masks against sessions on their own."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ml.ope.dlsm.batches import Batch, make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.heads import gaussian_kl, gaussian_log_prob
from ml.ope.dlsm.networks import DlsmNetworks, Noise
from ml.ope.dlsm.recurrence import LOG_STD_BOUNDS
from ml.ope.scale import learn_scale

LINEAR = DlsmConfig(latent=1, hidden=2, heads=(), action_emission=False, end_features="final", objective="posterior")
NOISES = {"p0": 0.7, "transition": 0.5, "state": 0.4, "reward": 0.6, "outcome": 0.9}


def raw(std):
    low, high = LOG_STD_BOUNDS
    share = (math.log(std) - low) / (high - low)
    return math.log(share / (1 - share))


def linear_gaussian(a, reward_slope):
    """Build z_t = a z_{t-1} + 0.8 u + noise, s_t = 1.3 z_t + noise, r_{t-1} = slope z_t + noise, r_end = 0.5 z_T + noise; q exact
    filtering.
    """
    net = DlsmNetworks(1, LINEAR).double()
    emission, b, q, r = 1.3, 0.8, NOISES["transition"] ** 2, NOISES["state"] ** 2
    gain = q * emission / (emission**2 * q + r)
    gain0 = emission / (emission**2 + r)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.zero_()
        for head, slope, std in (
            (net.first_state, emission, "state"),
            (net.state, emission, "state"),
            (net.reward, reward_slope, "reward"),
        ):
            head.affine.weight[0, 0] = slope
            head.affine.bias[1] = raw(NOISES[std])
        net.outcome.affine.weight[:4, 0] = 0.5
        net.outcome.affine.bias[4:] = raw(NOISES["outcome"])
        net.decoder.a_z[0, 0], net.decoder.a_x[0, 0] = a, b
        net.decoder.b_out[1] = raw(NOISES["transition"])
        net.first.affine.weight[0, 0] = gain0
        net.first.affine.bias[1] = raw(math.sqrt(1 - gain0 * emission))
        net.encoder.a_z[0, 0] = (1 - gain * emission) * a
        net.encoder.a_x[0, 0], net.encoder.a_x[1, 0] = (1 - gain * emission) * b, gain
        net.encoder.b_out[1] = raw(math.sqrt((1 - gain * emission) * q))
    return net


def exact_log_likelihood(a, reward_slope, states, actions, rewards, end):
    """Run the Kalman filter over scalar z with observations (s_t, r_{t-1}) and, at T, r_end. Standardised variables."""
    mean, variance, total = 0.0, 1.0, 0.0

    def update(mean, variance, slope, std, value):
        s = slope**2 * variance + std**2
        k = variance * slope / s
        log_p = -0.5 * math.log(2 * math.pi * s) - 0.5 * (value - slope * mean) ** 2 / s
        return mean + k * (value - slope * mean), variance * (1 - k * slope), log_p

    mean, variance, log_p = update(mean, variance, 1.3, NOISES["state"], states[0])
    total += log_p
    for t, u in enumerate(actions):
        mean, variance = a * mean + 0.8 * u, a**2 * variance + NOISES["transition"] ** 2
        for slope, std, value in ((1.3, "state", states[t + 1]), (reward_slope, "reward", rewards[t])):
            mean, variance, log_p = update(mean, variance, slope, NOISES[std], value)
            total += log_p
    if end is not None:
        total += update(mean, variance, 0.5, NOISES["outcome"], end)[2]
    return total


def bound(net, states, actions, rewards, end, samples=20_000):
    """Compute the mean and standard error of the one-sample bound, over many copies of one session."""
    steps = len(actions)

    def wide(values):
        return torch.as_tensor(values, dtype=torch.float64).unsqueeze(1).expand(-1, samples).contiguous()

    outcomes = torch.zeros(samples, 4, dtype=torch.float64)
    mask = torch.zeros_like(outcomes)
    if end is not None:
        outcomes[:, 0], mask[:, 0] = end, 1.0
    ones = torch.ones(steps, samples, dtype=torch.float64)
    batch = Batch(
        wide(states).unsqueeze(2), wide(actions), wide(rewards), ones, ones, ones[0], torch.full((samples,), steps), outcomes, mask, ones[0]
    )
    with torch.no_grad():
        values = net.posterior_terms(batch, net.noise(steps, samples, torch.Generator().manual_seed(0))).bound()
    return float(values.mean()), float(values.std() / math.sqrt(samples))


def data(seed, steps=6):
    rng = np.random.default_rng(seed)
    return rng.normal(size=steps + 1), rng.uniform(0, 1, steps), rng.normal(size=steps)


@pytest.mark.slow
def test_the_bound_equals_the_exact_log_likelihood_where_the_filtering_encoder_is_the_exact_posterior():
    states, actions, rewards = data(0)
    value, error = bound(linear_gaussian(0.0, 0.0), states, actions, rewards, None)
    exact = exact_log_likelihood(0.0, 0.0, states, actions, rewards, None)
    assert value == pytest.approx(exact, abs=max(5 * error, 1e-6))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_bound_lies_below_the_exact_log_likelihood_and_the_gap_of_the_filtering_encoder_remains(seed):
    states, actions, rewards = data(seed)
    value, error = bound(linear_gaussian(0.9, 0.7), states, actions, rewards, 0.4)
    exact = exact_log_likelihood(0.9, 0.7, states, actions, rewards, 0.4)
    assert value + 5 * error < exact
    assert exact - value < 10


def test_a_wrong_encoder_loosens_the_bound():
    states, actions, rewards = data(1)
    net = linear_gaussian(0.0, 0.0)
    tight, _ = bound(net, states, actions, rewards, None)
    with torch.no_grad():
        net.encoder.a_x[1, 0] *= 0.5
    loose, error = bound(net, states, actions, rewards, None)
    assert loose < tight - 5 * error


def test_the_divergence_is_that_of_torch_and_never_negative():
    g = torch.Generator().manual_seed(0)
    mq, sq, mp, sp = (torch.randn(200, generator=g) for _ in range(4))
    reference = torch.distributions.kl_divergence(torch.distributions.Normal(mq, sq.exp()), torch.distributions.Normal(mp, sp.exp()))
    torch.testing.assert_close(gaussian_kl(mq, sq, mp, sp), reference, rtol=1e-4, atol=1e-5)
    assert gaussian_kl(mq, sq, mp, sp).min() >= 0
    torch.testing.assert_close(gaussian_log_prob(mq, mp, sp), torch.distributions.Normal(mp, sp.exp()).log_prob(mq))


@pytest.mark.parametrize("objective", ["posterior_terms", "free_running_terms"])
@pytest.mark.parametrize("state_terms", ["window", "newest"])
@pytest.mark.parametrize("end_features", ["final", "pooled"])
def test_a_padded_batch_gives_its_sessions_what_each_gets_alone(small_buffer, objective, state_terms, end_features):
    batch = make_batch(small_buffer, learn_scale(small_buffer), torch.float64)
    config = DlsmConfig(latent=3, hidden=5, heads=(4,), state_terms=state_terms, end_features=end_features)
    net = DlsmNetworks(10, config).double()
    noise = net.noise(*batch.size, torch.Generator().manual_seed(1))
    together = getattr(net, objective)(batch, noise)
    lengths = batch.lengths.tolist()
    assert len(set(lengths)) > 3
    for i, t in enumerate(lengths):
        own = Noise(noise.first[[i]], noise.encoder[:t, [i]], noise.decoder[:t, [i]])
        alone = getattr(net, objective)(batch.select([i]), own)
        for name in ("states", "rewards", "outcomes", "kl_first", "kl_path"):
            torch.testing.assert_close(getattr(together, name)[i], getattr(alone, name)[0])


@pytest.mark.parametrize("objective", ["posterior", "sum"])
def test_the_fast_objective_has_the_value_and_gradients_of_the_readable_loop(small_buffer, objective):
    batch = make_batch(small_buffer, learn_scale(small_buffer), torch.float64)
    net = DlsmNetworks(10, DlsmConfig(latent=3, hidden=5, heads=(4,), objective=objective)).double()
    noise = net.noise(*batch.size, torch.Generator().manual_seed(2))
    losses = [net.loss(batch, noise, fast=fast) for fast in (True, False)]
    grads = [torch.autograd.grad(loss, list(net.parameters()), allow_unused=True) for loss in losses]
    torch.testing.assert_close(losses[0], losses[1])
    for a, b in zip(*grads, strict=True):
        assert (a is None) == (b is None)
        if a is not None:
            torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-10)


def test_what_happens_in_unusable_steps_is_not_reconstructed(small_buffer):
    batch = make_batch(small_buffer, learn_scale(small_buffer), torch.float64)
    usable = batch.usable.clone()
    usable[4:9, 2] = 0.0
    garbled = batch.rewards.clone()
    garbled[4:9, 2] = 1e3
    net = DlsmNetworks(10, DlsmConfig(latent=3, hidden=5, heads=(4,))).double()
    noise = net.noise(*batch.size, torch.Generator().manual_seed(3))
    clean = net.posterior_terms(replace(batch, usable=usable), noise)
    dirty = net.posterior_terms(replace(batch, usable=usable, rewards=garbled), noise)
    torch.testing.assert_close(clean.rewards, dirty.rewards)
    assert net.posterior_terms(replace(batch, rewards=garbled), noise).rewards[2] < clean.rewards[2] - 100


def test_the_step_of_a_roll_out_is_the_step_of_training():
    net = DlsmNetworks(10, DlsmConfig(latent=3, hidden=5)).double()
    g = torch.Generator().manual_seed(4)
    x, z0 = torch.rand(6, 2, 1, generator=g, dtype=torch.float64), torch.randn(2, 3, generator=g, dtype=torch.float64)
    eps = torch.randn(6, 2, 3, generator=g, dtype=torch.float64)
    path, _, _ = net.decoder.run(x, z0, eps)
    z, h, c = z0, torch.zeros(2, 5, dtype=torch.float64), torch.zeros(2, 5, dtype=torch.float64)
    for t in range(6):
        z, h, c = net.decoder.step(x[t], z, h, c, eps[t])
        torch.testing.assert_close(z, path[t])
