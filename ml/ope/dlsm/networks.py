"""Networks and evidence lower bound of the deep latent sequential model (DLSM).

Source: Gao et al. 2023, section 5 (eq:encoder, eq:decoder, eq:elbo) and Algorithm 1. What differs from the paper is switchable in
`DlsmConfig`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from ml.ope.dlsm.batches import Batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.heads import GaussianHead, gaussian_kl, gaussian_log_prob
from ml.ope.dlsm.linear_part import LinearPart
from ml.ope.dlsm.recurrence import LatentWeights, bounded, lstm, lstm_loop, stochastic_lstm, stochastic_lstm_loop, unbounded
from ml.ope.estimate import OUTCOMES


class LatentRecurrence(nn.Module):
    """h_t = LSTM(h_{t-1}, z_{t-1}, x_t) and z_t ~ N given h_t, with a linear path from (z_{t-1}, x_t) to the mean of z_t.

    The encoder has x_t = (a_{t-1}, s_t), the decoder x_t = a_{t-1}.
    """

    def __init__(self, n_exogenous: int, latent: int, hidden: int, skip: bool = True) -> None:
        super().__init__()
        self.latent, self.hidden = latent, hidden
        bound = 1 / math.sqrt(hidden)

        def weight(*shape: int) -> nn.Parameter:
            return nn.Parameter(torch.empty(*shape).uniform_(-bound, bound))

        self.w_x, self.w_z, self.w_h = weight(n_exogenous, 4 * hidden), weight(latent, 4 * hidden), weight(hidden, 4 * hidden)
        self.bias = nn.Parameter(torch.zeros(4 * hidden))
        with torch.no_grad():
            self.bias[2 * hidden : 3 * hidden] = 1.0  # an LSTM that starts by remembering
        self.a_x, self.a_z = weight(n_exogenous, latent), nn.Parameter(0.5 * torch.eye(latent))
        if not skip:  # the kernels add the path in any case: with zeros that are not learnt it adds nothing
            self.a_x, self.a_z = (nn.Parameter(torch.zeros_like(w), requires_grad=False) for w in (self.a_x, self.a_z))
        self.w_out, self.b_out = weight(hidden, 2 * latent), nn.Parameter(torch.zeros(2 * latent))

    def run(self, x: Tensor, z0: Tensor, eps: Tensor, fast: bool = True) -> tuple[Tensor, Tensor, Tensor]:
        """Draw z_1 ... z_T with means and log standard deviations, each [T, B, Z]; x is [T, B, X], z0 [B, Z], eps [T, B, Z]."""
        weights = LatentWeights(self.w_x, self.bias, self.a_x, self.w_z, self.w_h, self.a_z, self.w_out, self.b_out)
        return (stochastic_lstm if fast else stochastic_lstm_loop)(x, z0, eps, weights)

    def recurrent(self, x: Tensor, z: Tensor, fast: bool = True) -> Tensor:
        """Compute h_1 ... h_T along a path, [T, B, H]; z is z_0 ... z_{T-1}."""
        return (lstm if fast else lstm_loop)(torch.cat([x, z], dim=2), torch.cat([self.w_x, self.w_z]), self.bias, self.w_h)

    def follow(self, x: Tensor, z: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the means and log standard deviations of z_t given the z_{t-1} of another path and its `recurrent`, [T, B, Z]."""
        given = torch.cat([x, z], dim=2)
        head, raw = (h @ self.w_out + self.b_out).chunk(2, dim=2)
        return given @ torch.cat([self.a_x, self.a_z]) + head, bounded(raw)

    def step(self, x: Tensor, z: Tensor, h: Tensor, c: Tensor, eps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take one step of a roll-out: z_t, h_t, c_t."""
        gates = torch.addmm(self.bias, x, self.w_x).addmm_(z, self.w_z).addmm_(h, self.w_h)
        i, f, o = torch.sigmoid(gates[:, self.hidden :]).chunk(3, dim=1)
        c = torch.addcmul(i * torch.tanh(gates[:, : self.hidden]), f, c)
        h = o * torch.tanh(c)
        head, raw = torch.addmm(self.b_out, h, self.w_out).chunk(2, dim=1)
        return x @ self.a_x + z @ self.a_z + head + bounded(raw).exp() * eps, h, c


@dataclass(frozen=True)
class Noise:
    """Standard normal draws of one evaluation: z_0 [B, Z]; encoder and decoder paths [T, B, Z]. `start`: first step of the free run."""

    first: Tensor
    encoder: Tensor
    decoder: Tensor
    start: int = 0


@dataclass(frozen=True)
class Terms:
    """Parts of the evidence lower bound per session, [B] each: log-likelihoods and divergences, summed over usable or living steps."""

    states: Tensor
    rewards: Tensor
    outcomes: Tensor
    kl_first: Tensor
    kl_path: Tensor

    def bound(self) -> Tensor:
        """Compute the evidence lower bound per session, [B]."""
        return self.states + self.rewards + self.outcomes - (self.kl_first + self.kl_path)


class DlsmNetworks(nn.Module):
    """Encoder, decoder and heads of a DLSM.

    Heads: p(s_0 | z_0); p(s_t | z_t) for t >= 1, of the whole window or of its newest beta alone; p(r_{t-1} | z_t); p(r_end | z_T) and one
    of each QoC. The newest beta alone loses nothing, because the older ones are known from s_{t-1}. With `action_emission` the heads of
    steps see a_{t-1} too.
    """

    def __init__(self, window: int, config: DlsmConfig) -> None:
        super().__init__()
        self.window, self.config = window, config
        z, hidden, heads = config.latent, config.hidden, config.heads
        self.state_width = window if config.state_terms == "window" else 1
        extra = 1 if config.action_emission else 0
        self.linear: LinearPart | None = None
        self.first = GaussianHead(window, z, heads)
        self.encoder = LatentRecurrence(1 + window, z, hidden, config.skip)
        self.decoder = LatentRecurrence(1, z, hidden, config.skip)
        self.first_state = GaussianHead(z, window, heads)
        self.state = GaussianHead(z + extra, self.state_width, heads)
        self.reward = GaussianHead(z + extra, 1, heads)
        self.outcome = GaussianHead(z if config.end_features == "final" else 2 * z, len(OUTCOMES), ())

    def start_at_zero(self) -> None:
        """Leave the prediction of beta to the linear part, with its own noise; the head then learns to differ."""
        with torch.no_grad():
            self.state.affine.weight.zero_()
            self.state.affine.bias.copy_(torch.tensor([0.0, unbounded(0.0)]))

    def noise(self, steps: int, sessions: int, generator: torch.Generator) -> Noise:
        """Draw fresh noise."""
        dtype = self.decoder.bias.dtype
        z = self.config.latent
        first = torch.randn(sessions, z, generator=generator, dtype=dtype)
        encoder = torch.randn(steps, sessions, z, generator=generator, dtype=dtype)
        decoder = torch.randn(steps, sessions, z, generator=generator, dtype=dtype)
        block = self.config.overshoot
        start = block * int(torch.randint(max(1, steps // block), (), generator=generator)) if block else 0
        return Noise(first, encoder, decoder, start)

    def head_input(self, z: Tensor, actions: Tensor) -> Tensor:
        """Return what the heads of steps see, [..., Z (+ 1)]; actions come without the last axis."""
        return torch.cat([z, actions.unsqueeze(-1)] if self.config.action_emission else [z], dim=-1)

    def posterior_terms(self, batch: Batch, noise: Noise, fast: bool = True) -> Terms:
        """Compute the terms of theorem 1: reconstruction from samples of the encoder, decoder following the encoder's path."""
        z0, kl_first, first_states = self._first(batch, noise)
        a = batch.actions.unsqueeze(-1)
        z, mean_q, log_std_q = self.encoder.run(torch.cat([a, batch.states[1:]], dim=2), z0, noise.encoder, fast)
        before = torch.cat([z0.unsqueeze(0), z[:-1]])
        h = self.decoder.recurrent(a, before, fast)
        kl = gaussian_kl(mean_q, log_std_q, *self.decoder.follow(a, before, h)).sum(2)
        if self.config.free_bits:
            kl = kl.clamp(min=self.config.free_bits)
        kl_path = (kl * batch.alive).sum(0)
        states, rewards, outcomes = self._reconstruct(batch, z, fast)
        return Terms(first_states + states, rewards, outcomes, kl_first, kl_path)

    def free_running_terms(self, batch: Batch, noise: Noise, fast: bool = True) -> Terms:
        """Compute the terms of algorithm 1 to the letter: reconstruction along the decoder's own path, its actions replayed.

        z_0 comes from the prior or from q(z_0 | s_0) by `start`. The encoder beyond t = 0 would only see its divergence from the decoder,
        which is 0 at the optimum whatever the data: it is omitted.
        """
        z0, kl_first, first_states = self._first(batch, noise)
        start = noise.first if self.config.start == "prior" else z0
        a = batch.actions.unsqueeze(-1)
        if noise.start:
            noise = replace(noise, decoder=self._along_posterior(batch, noise, z0, fast))
            batch = replace(batch, usable=batch.usable * (torch.arange(len(a)) >= noise.start).unsqueeze(1))
            start = z0
        z, _, _ = self.decoder.run(a, start, noise.decoder, fast)
        states, rewards, outcomes = self._reconstruct(batch, z, fast)
        return Terms(first_states + states, rewards, outcomes, kl_first, torch.zeros_like(kl_first))

    def _along_posterior(self, batch: Batch, noise: Noise, z0: Tensor, fast: bool) -> Tensor:
        """Compute the decoder's noise, [T, B, Z], with that in the first `start` steps under which its own run is the encoder's path."""
        a = batch.actions.unsqueeze(-1)
        with torch.no_grad():
            z, _, _ = self.encoder.run(torch.cat([a, batch.states[1:]], dim=2), z0, noise.encoder, fast)
            before = torch.cat([z0.unsqueeze(0), z[:-1]])
            mean, log_std = self.decoder.follow(a, before, self.decoder.recurrent(a, before, fast))
            return torch.cat([((z - mean) * torch.exp(-log_std))[: noise.start], noise.decoder[noise.start :]])

    def loss(self, batch: Batch, noise: Noise, fast: bool = True) -> Tensor:
        """Compute the training objective, negated, per living step of the batch."""
        c = self.config
        total = self.posterior_terms(batch, noise, fast).bound().sum()
        if c.objective == "sum":
            total = total + self.free_running_terms(batch, noise, fast).bound().sum()
        return -total / batch.alive.sum()

    def _first(self, batch: Batch, noise: Noise) -> tuple[Tensor, Tensor, Tensor]:
        """Draw z_0 ~ q(z_0 | s_0); compute KL(q(z_0 | s_0) || N(0, I)) and log p(s_0 | z_0), [B, Z], [B], [B]."""
        mean, log_std = self.first(batch.states[0])
        z0 = mean + log_std.exp() * noise.first
        kl = gaussian_kl(mean, log_std, torch.zeros_like(mean), torch.zeros_like(log_std)).sum(1)
        log_prob = gaussian_log_prob(batch.states[0], *self.first_state(z0)).sum(1) * batch.first_known
        return z0, kl, log_prob

    def _reconstruct(self, batch: Batch, z: Tensor, fast: bool) -> tuple[Tensor, Tensor, Tensor]:
        """log p of s_1 ... s_T, of r_0 ... r_{T-1} and of the outcomes along z_1 ... z_T, [B] each."""
        seen = self.head_input(z, batch.actions)
        targets = batch.states[1:, :, -self.state_width :]
        if self.config.residual:
            targets = self._left(batch).unsqueeze(2)
        states = self.state.log_prob(seen, targets, fast)
        learnt = self.config.reward_terms
        rewards = self.reward.log_prob(seen, batch.rewards.unsqueeze(2), fast) if learnt else torch.zeros_like(states)
        outcomes = self._outcome_terms(batch, z)
        return (states * batch.usable).sum(0), (rewards * batch.usable).sum(0), outcomes.sum(1)

    def _outcome_terms(self, batch: Batch, z: Tensor) -> Tensor:
        """log p of the measured outcomes, [B, 4]; without `qoc_terms` the QoCs leave no gradient in z."""
        given = self.end_input(z, batch.lengths, batch.alive)
        terms = gaussian_log_prob(batch.outcomes, *self.outcome(given))
        if not self.config.qoc_terms:
            aside = gaussian_log_prob(batch.outcomes, *self.outcome(given.detach()))
            terms = torch.cat([terms[:, :1], aside[:, 1:]], dim=1)
        return terms * batch.outcome_mask

    def end_input(self, z: Tensor, lengths: Tensor, alive: Tensor) -> Tensor:
        """Select z_T of each session, with `pooled` also the mean of z_1 ... z_T; z is [T, B, Z]."""
        final = z.gather(0, (lengths - 1).view(1, -1, 1).expand(1, -1, z.shape[2])).squeeze(0)
        if self.config.end_features == "final":
            return final
        pooled = (z * alive.unsqueeze(2)).sum(0) / lengths.unsqueeze(1)
        return torch.cat([final, pooled], dim=1)

    def replay(self, batch: Batch, draws: int, generator: torch.Generator) -> Replay:
        """Run the decoder from q(z_0 | s_0) under the actions of the batch, `draws` per session."""
        steps, sessions = batch.size
        wide = [batch.actions.repeat(1, draws), batch.alive.repeat(1, draws)]
        noise = self.noise(steps, sessions * draws, generator)
        mean, log_std = self.first(batch.states[0].repeat(draws, 1))
        z0 = mean + log_std.exp() * noise.first
        a = wide[0].unsqueeze(-1)
        z, _, _ = self.decoder.run(a, z0, noise.decoder)
        seen = self.head_input(z, wide[0])
        state_mean, state_log_std = self.state(seen)
        if self.linear is not None:
            state_mean = self._with_linear(batch, draws, state_mean, state_log_std, generator)
            state_log_std = state_log_std + math.log(self.linear.noise)
        reward = self.reward(seen)[0].squeeze(2)
        end = self.outcome(self.end_input(z, batch.lengths.repeat(draws), wide[1]))[0]

        def by_draw(values: Tensor) -> Tensor:
            return values.view(*values.shape[:-1], draws, sessions)

        return Replay(
            by_draw(state_mean[:, :, -1]),
            by_draw(state_log_std[:, :, -1]),
            by_draw(reward),
            end.view(draws, sessions, len(OUTCOMES)),
        )

    def _left(self, batch: Batch) -> Tensor:
        if batch.left is None:
            raise ValueError("a residual model learns from what its linear part leaves: the batch has none")
        return batch.left

    def _with_linear(self, batch: Batch, draws: int, mean: Tensor, log_std: Tensor, generator: torch.Generator) -> Tensor:
        """Compute the means of beta given the simulated past, [T, draws B, 1], from what the heads say of its linear prediction."""
        if self.linear is None or batch.resting is None:
            raise ValueError("free runs of a residual model need the batch of its own linear part")
        drawn = torch.randn(mean.shape[:2], generator=generator, dtype=mean.dtype)
        parts = (batch.states[0].repeat(draws, 1), batch.resting.repeat(1, draws), mean[:, :, 0], log_std[:, :, 0].exp(), drawn)
        found = self.linear.run(*(p.numpy().astype(np.float64) for p in parts))
        return torch.as_tensor(found, dtype=mean.dtype).unsqueeze(2)


@dataclass(frozen=True)
class Replay:
    """Free runs: mean and log standard deviation of the newest beta and mean reward, [T, draws, B]; outcomes, [draws, B, 4]."""

    beta_mean: Tensor
    beta_log_std: Tensor
    reward: Tensor
    outcomes: Tensor
