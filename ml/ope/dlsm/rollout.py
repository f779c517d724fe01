"""Free runs of a fitted DLSM under many policies at once, along the decoder alone (eq:decoder, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ml.mdp import MdpSettings, step_reward
from ml.ope.dlsm.linear_part import LinearPart
from ml.ope.dlsm.networks import DlsmNetworks
from ml.ope.linear.dynamics import LinearResponse
from ml.ope.outcomes.minutes import AMPLITUDE, BETA, ENERGY, FEATURES, Minutes, each_feature, minute_bounds, with_shares
from ml.ope.scale import Scale
from ml.policies.policy import Policy, start_sessions
from ml.progress import Report, silent

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Rollouts:
    """Simulated sessions of P policies, M each; shape [P, M] unless stated.

    Attributes:
        return_head: discounted step return by the learnt reward head's mean.
        return_known: discounted step return by the known reward on sampled beta, never on its mean. By the mean, a policy whose mean beta
            is just under the threshold would look perfect.
        outcomes: `ml.ope.estimate.OUTCOMES` in their units, [P, M, K].
        minutes: what outcomes follow in every simulated session.
        actions: one in `keep_every` of all actions, [P, K], for the coverage of the policy's own states.
    """

    return_head: Floats
    return_known: Floats
    outcomes: Floats
    minutes: Minutes
    actions: Floats

    @property
    def sessions(self) -> int:
        """M."""
        return self.outcomes.shape[1]

    @property
    def amplitude(self) -> Floats:
        """Mean a."""
        return self.minutes.means[..., AMPLITUDE]

    @property
    def energy(self) -> Floats:
        """Mean a^2."""
        return self.minutes.means[..., ENERGY]

    @property
    def beta(self) -> Floats:
        """Mean sampled beta, participant's unit."""
        return self.minutes.means[..., BETA]


def roll_out(
    networks: DlsmNetworks,
    policies: Sequence[Policy],
    starts: Floats,
    *,
    scale: Scale,
    settings: MdpSettings,
    horizon: int,
    per_policy: int,
    seed: int,
    prior: bool = False,
    before: Floats | None = None,
    report: Report = silent,
) -> Rollouts:
    """Simulate every policy from the same starts with the same noise, so that differences between policies are the policies' own.

    Args:
        networks: a fitted DLSM.
        policies: P policies.
        starts: s_0 of the logged sessions, standardised, [n, W]; trajectory m starts from row m modulo n. With `prior` not used.
        scale, settings: of the buffer.
        horizon: H steps.
        per_policy: M trajectories of each policy.
        seed: of the noise.
        prior: start from z_0 ~ N(0, I) and its own s_0 (paper) instead of q(z_0 | s_0).
        before: dose before each of the starts, [n]; NaN: a policy's first amplitude. For models with a linear part.
        report: called after every block.
    """
    block = max(1, networks.config.block // max(1, len(policies)))
    rng = np.random.default_rng(seed)
    parts = []
    for first in range(0, per_policy, block):
        count = min(block, per_policy - first)
        of = (first + np.arange(count)) % len(starts)
        rows, doses = starts[of], np.full(count, np.nan) if before is None else before[of]
        with torch.inference_mode():
            parts.append(_roll_block(networks, policies, rows, doses, scale, settings, horizon, rng, prior))
        report((first + count) / per_policy, "rolling out policies")
    joined = {
        name: np.concatenate([getattr(p, name) for p in parts], axis=1) for name in ("return_head", "return_known", "outcomes", "actions")
    }
    minutes = (np.concatenate([getattr(p.minutes, name) for p in parts], axis=1) for name in ("features", "share", "late"))
    return Rollouts(**joined, minutes=Minutes(*minutes))


def _roll_block(
    networks: DlsmNetworks,
    policies: Sequence[Policy],
    starts: Floats,
    doses: Floats,
    scale: Scale,
    settings: MdpSettings,
    horizon: int,
    rng: np.random.Generator,
    prior: bool,
) -> Rollouts:
    config, p, m = networks.config, len(policies), len(starts)
    dtype = networks.decoder.bias.dtype

    def shared(*shape: int) -> torch.Tensor:
        """Draw noise for m trajectories, the same for every policy, [P m, ...]."""
        return torch.as_tensor(rng.standard_normal((m, *shape)), dtype=dtype).repeat(p, *([1] * len(shape)))

    if prior:
        z = shared(config.latent)
        mean, log_std = networks.first_state(z)
        window = scale.raw_beta((mean + log_std.exp() * shared(networks.window)).numpy())
    else:
        mean, log_std = networks.first(torch.as_tensor(starts, dtype=dtype).repeat(p, 1))
        z = mean + log_std.exp() * shared(config.latent)
        window = scale.raw_beta(np.tile(starts, (p, 1)))
    window = _limit_beta(window, scale)
    h = torch.zeros(p * m, config.hidden, dtype=dtype)
    c = torch.zeros_like(h)
    pooled = torch.zeros_like(z)
    sums = {name: np.zeros(p * m) for name in ("return_head", "return_known")}
    bounds = minute_bounds(horizon, settings.period_s)
    minute_of = np.repeat(np.arange(len(bounds)), [j - i for i, j in bounds])
    summed = np.zeros((len(bounds), FEATURES, p * m))
    kept, keep_every = [], max(1, horizon // 50)
    linear = None if networks.linear is None else LinearRun(networks.linear, doses, p)
    policies = [start_sessions(policy) for policy in policies]
    for t in range(horizon):
        a = np.concatenate([policy.act(window[i * m : (i + 1) * m]) for i, policy in enumerate(policies)])
        action = torch.as_tensor(a, dtype=dtype)
        z, h, c = networks.decoder.step(action.unsqueeze(1), z, h, c, shared(config.latent))
        pooled += z
        seen = networks.head_input(z, action)
        mean, log_std = networks.state(seen)
        drawn = (mean + log_std.exp() * shared(networks.state_width)).numpy()
        if linear is not None:
            drawn = linear.noise * drawn + linear.predicted(scale.beta(window), a)[:, None]
        if config.decode_all_window:
            window = _limit_beta(scale.raw_beta(drawn), scale)
        else:
            newest = _limit_beta(scale.raw_beta(drawn[:, -1:]), scale)
            window = np.concatenate([window[:, 1:], newest], axis=1)
        discount = settings.gamma**t
        head = networks.reward(seen)[0].squeeze(1).numpy().astype(np.float64)
        sums["return_head"] += discount * (head * scale.reward_std + scale.reward_mean)
        sums["return_known"] += discount * step_reward(settings, window[:, -1], a)
        for total, values in zip(summed[minute_of[t]], each_feature(window[:, -1], a, settings.xi_beta), strict=True):
            total += values
        if t % keep_every == 0:
            kept.append(a)
    end_input = z if config.end_features == "final" else torch.cat([z, pooled / horizon], dim=1)
    outcomes = networks.outcome(end_input)[0].numpy().astype(np.float64) * np.array(scale.outcome_std) + np.array(scale.outcome_mean)
    return Rollouts(
        outcomes=outcomes.reshape(p, m, -1),
        minutes=_minutes(summed, np.bincount(minute_of), p),
        actions=np.stack(kept, axis=1).reshape(p, -1),
        **{name: values.reshape(p, m) for name, values in sums.items()},
    )


class LinearRun:
    """One-step predictions of a linear part for P policies of m trajectories each, step by step."""

    def __init__(self, part: LinearPart, doses: Floats, policies: int) -> None:
        self._part, self._doses, self._policies, self.noise = part, doses, policies, part.noise
        self._response: LinearResponse | None = None
        self._rest = np.empty(0)

    def predicted(self, window: Floats, a: Floats) -> Floats:
        """Predict standardised beta [P m] after the windows [P m, W] under the amplitudes [P m]."""
        amplitudes = a.reshape(self._policies, 1, -1)
        if self._response is None:
            self._response = self._part.response(amplitudes, self._doses)
            lasting = self._part.level + self._response.lasting().reshape(-1)
            self._rest = np.repeat(lasting[:, None], window.shape[1], axis=1)
        now = self._part.level + self._response.step(amplitudes).reshape(-1)
        result = now + (window - self._rest) @ self._part.phi[::-1]
        self._rest = np.concatenate([self._rest[:, 1:], now[:, None]], axis=1)
        return np.asarray(result, dtype=np.float64)


def _minutes(summed: Floats, counts: NDArray[np.int64], policies: int) -> Minutes:
    """Convert sums [minutes, F, P M] over the steps of each minute to sessions [P, M]."""
    means = np.moveaxis(summed / counts[:, None, None], 2, 0)
    means = means.reshape(policies, -1, *means.shape[1:])
    return with_shares(means, np.broadcast_to(counts.astype(np.float64), means.shape[:3]))


def _limit_beta(beta: Floats, scale: Scale) -> Floats:
    """Limit simulated beta to one logged range beyond the logged range, and above zero where the log is: a stop for wild models only."""
    span = scale.beta_high - scale.beta_low
    low = scale.beta_low - span
    return np.clip(beta, max(low, 0.0) if scale.beta_low >= 0 else low, scale.beta_high + span)
