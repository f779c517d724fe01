"""DualDICE: the ratio of a policy's discounted state-action distribution to the logged one. Source: Nachum et al. 2019.

min over nu, max over zeta of E_D[(nu(s, a) - gamma nu(s', pi(s'))) zeta(s, a) - zeta^2 / 2] - (1 - gamma) E[nu(s_0, pi(s_0))]; at the
saddle zeta is the ratio. All policies and ensemble members are trained together as one stack of small networks.

There are two approximations, both stated in the estimate. The method knows no horizon, so its average reward is multiplied by the
discounted length of the session. And r_end follows from averages under the *discounted* distribution, which leans towards the session's
beginning.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ml.ope.estimate import Estimate, checked_horizon, require_two_sessions
from ml.ope.flags import Flag
from ml.ope.fqe.estimator import value_estimate, within_reach
from ml.ope.fqe.steps import TargetActions, UsableSteps, ValueFeatures, usable_steps
from ml.ope.lead import dose_before
from ml.ope.outcomes.model import EndModel, fit_end_model
from ml.ope.registry import Size
from ml.ope.support.coverage import AmplitudeSupport
from ml.policies.policy import Policy
from ml.progress import Report, silent
from ml.statistics.bootstrap import resamples
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

AVERAGE = 0.995
"""Decay of the running average of zeta's weights, which is what is read: the saddle is circled, not reached."""

LARGEST_GAP = 0.25
"""A larger `flow_gap`: the training has not converged, and the estimate speaks for no policy."""

ONE = 0.5413248546129181
"""softplus of this is 1: where zeta starts."""


@dataclass(frozen=True, kw_only=True)
class DiceConfig:
    """Settings of DualDICE.

    Attributes:
        members: networks per policy, each on its own resample of the sessions (the first on all of them).
        hidden: sizes of the hidden layers. updates: of both networks. batch: steps per update.
        learning_rate: of Adam, for both. refits: session resamples of the weighted average. seed: of weights, batches, resamples.
    """

    members: int = 2
    hidden: tuple[int, ...] = (32, 32)
    updates: int = 1500
    batch: int = 256
    learning_rate: float = 1e-3
    refits: int = 300
    seed: int = 0


class StackedMlp:
    """S networks of one shape, evaluated together: weights [S, in, out], inputs [S, B, in], outputs [S, B]."""

    def __init__(self, copies: int, inputs: int, hidden: tuple[int, ...], generator: torch.Generator, last: float = 0.0) -> None:
        sizes = (inputs, *hidden, 1)
        self.layers: list[tuple[Tensor, Tensor]] = []
        for k, (a, b) in enumerate(pairwise(sizes)):
            final = k == len(sizes) - 2
            spread = 1e-2 / np.sqrt(a) if final else 1 / np.sqrt(a)
            weight = (torch.rand(copies, a, b, generator=generator) * 2 - 1) * spread
            bias = torch.full((copies, 1, b), last if final else 0.0)
            self.layers.append((weight.requires_grad_(), bias.requires_grad_()))

    @property
    def parameters(self) -> list[Tensor]:
        """All weights."""
        return [p for layer in self.layers for p in layer]

    def __call__(self, x: Tensor) -> Tensor:
        for k, (weight, bias) in enumerate(self.layers):
            x = torch.baddbmm(bias, x, weight)
            if k < len(self.layers) - 1:
                x = torch.relu(x)
        return x[..., 0]


def saddle(nu_now: Tensor, nu_then: Tensor, nu_first: Tensor, zeta: Tensor, gamma: float) -> Tensor:
    """Compute the objective of every network of the stack, [S], from nu(s, a), nu(s', pi), zeta(s, a) [S, B] and nu(s_0, pi) [S, M]."""
    inner = ((nu_now - gamma * nu_then) * zeta - 0.5 * zeta**2).mean(1)
    return inner - (1 - gamma) * nu_first.mean(1)


def ratios(now: Floats, then: Floats, first: Floats, shares: Floats, gamma: float, config: DiceConfig, report: Report = silent) -> Floats:
    """Compute zeta at every logged step, [P, M, N].

    Args:
        now: inputs at (s, a), [N, F]. then: at (s', pi(s')), [P, N, F]. first: at (s_0, pi(s_0)), [P, m, F].
        shares: probability of drawing each step, one row per member, [M, N].
        gamma: discount per step. config: sizes, updates, rates.

    Raises:
        ValueError: the training left the finite numbers.
    """
    policies, members, steps = len(then), len(shares), len(now)
    g = torch.Generator().manual_seed(config.seed)
    nu = StackedMlp(policies * members, now.shape[1], config.hidden, g)
    zeta = StackedMlp(policies * members, now.shape[1], config.hidden, g, ONE)
    x_now, x_then, x_first = (torch.as_tensor(v, dtype=torch.float32) for v in (now, then, first))
    starts = x_first.repeat_interleave(members, 0)
    rng = np.random.default_rng(config.seed)
    optimizers = [torch.optim.Adam(net.parameters, lr=config.learning_rate, foreach=True) for net in (nu, zeta)]
    kept = [p.detach().clone() for p in zeta.parameters]
    cumulative = np.cumsum(shares, axis=1)
    for update in range(config.updates):
        drawn = np.stack([np.searchsorted(c, rng.random(config.batch) * c[-1]) for c in cumulative]).clip(max=steps - 1)
        index = torch.as_tensor(drawn)
        batch_now = x_now[index].repeat(policies, 1, 1)
        batch_then = x_then[:, index].flatten(0, 1)
        weight = torch.nn.functional.softplus(zeta(batch_now))
        objective = saddle(nu(batch_now), nu(batch_then), nu(starts), weight, gamma).sum()
        gradients = torch.autograd.grad(objective, [*nu.parameters, *zeta.parameters])
        half = len(nu.parameters)
        for net, slope, sign, optimizer in ((nu, gradients[:half], 1, optimizers[0]), (zeta, gradients[half:], -1, optimizers[1])):
            for parameter, value in zip(net.parameters, slope, strict=True):
                parameter.grad = sign * value
            optimizer.step()
        torch._foreach_lerp_(kept, [p.detach() for p in zeta.parameters], 1 - AVERAGE)
        if update % 50 == 0:
            if not torch.isfinite(objective):
                raise ValueError("DualDICE did not converge on these data: its objective is no longer a finite number")
            report((update + 1) / config.updates, "fitting density ratios", dice_objective=float(objective.detach()) / len(starts))
    with torch.no_grad():
        for parameter, value in zip(zeta.parameters, kept, strict=True):
            parameter.copy_(value)
        everything = torch.nn.functional.softplus(zeta(x_now.expand(policies * members, -1, -1)))
    result: Floats = everything.numpy().astype(np.float64).reshape(policies, members, steps)
    if not np.isfinite(result).all():
        raise ValueError("DualDICE did not converge on these data: its ratios are no longer finite numbers")
    return result


def flow_gap(zeta: Floats, now: Floats, then: Floats, first: Floats, gamma: float) -> float:
    """Compute by how much the ratios of one policy break the equation that defines them; 0 at the saddle.

    E_D[zeta f(s, a)] = (1 - gamma) E[f(s_0, pi)] + gamma E_D[zeta f(s', pi(s'))] for every f. It is tested for every input, in its standard
    deviations over the logged steps, and for 1, which requires that ratios average to 1. The largest gap of all counts, over members.
    Ratios that are nearly 0 everywhere break the second alone. Training that stopped short leaves them where gamma is near 1.

    Args:
        zeta: [M, N]. now, then: inputs at (s, a) and (s', pi(s')), [N, F]. first: at (s_0, pi(s_0)), [m, F].
    """
    spread = np.where(now.std(0) > 1e-9, now.std(0), 1.0)
    flows = zeta @ ((now - gamma * then) / spread) / len(now) - (1 - gamma) * (first / spread).mean(0)
    return float(max(np.abs(flows).max(), np.abs(zeta.mean(1) - 1).max()))


@dataclass(frozen=True)
class DualDice:
    """The estimator."""

    config: DiceConfig = field(default_factory=DiceConfig)
    method: str = "dual_dice"

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedDualDice:
        """Prepare the inputs; the networks belong to policies and are trained in `evaluate`.

        Raises:
            ValueError: fewer than two sessions with usable steps, or no session with a complete s_0.
        """
        table, c = usable_steps(buffer, otherwise=dose_before(buffer)), self.config
        require_two_sessions("DualDICE", len(np.unique(table.session)))
        draws = resamples(table.sessions, c.refits, c.seed)
        inputs = ValueFeatures(table, 0, c.seed)
        report(1.0, "inputs of the density ratios")
        return FittedDualDice(self.method, c, buffer, table, inputs, draws, fit_end_model(buffer, draws=c.refits, seed=c.seed))


@dataclass(frozen=True)
class FittedDualDice:
    """Inputs, and the resamples that every policy shares."""

    method: str
    config: DiceConfig
    buffer: ReplayBuffer
    table: UsableSteps
    inputs: ValueFeatures
    draws: Indices
    end: EndModel

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Train the ratios of all policies together, then average the logged rewards under them."""
        horizon = checked_horizon(self.buffer, horizon_steps)
        if not policies:
            return {}
        table = self.table
        targets = [TargetActions.of(table, policy) for policy in policies.values()]
        now = self.inputs(table.states, table.actions, table.memory)
        then = np.stack([self.inputs(table.next_states, t.then, t.memory) for t in targets])
        first = np.stack([self.inputs(table.first_states, t.first, table.first_memory(t.first)) for t in targets])
        gamma = self.buffer.settings.gamma
        zeta = ratios(now, then, first, self._shares(), gamma, self.config, report)
        support = AmplitudeSupport(self.buffer)
        gaps = [flow_gap(z, now, t, f, gamma) for z, t, f in zip(zeta, then, first, strict=True)]
        rows = zip(policies.items(), zeta, gaps, strict=True)
        return {name: self._estimate(policy, z, gap, horizon, support) for (name, policy), z, gap in rows}

    def _shares(self) -> Floats:
        """Compute the probability of each step per member: all sessions for the first, a resample of the sessions for each of the
        others."""
        table = self.table
        times = [np.ones(table.sessions)]
        picks = resamples(table.sessions, max(1, self.config.members - 1), self.config.seed + 1)
        times += [np.bincount(pick, minlength=table.sessions).astype(np.float64) for pick in picks[: self.config.members - 1]]
        rows = np.stack(times)[:, table.session]
        empty = rows.sum(1) == 0
        rows[empty] = 1.0
        return np.asarray(rows / rows.sum(1, keepdims=True), dtype=np.float64)

    def _estimate(self, policy: Policy, zeta: Floats, gap: float, horizon: int, support: AmplitudeSupport) -> Estimate:
        table, settings = self.table, self.buffer.settings
        n, members = table.sessions, len(zeta)
        weighted = np.zeros((members, n, table.rates.shape[1] + 1))
        columns = np.concatenate([table.rates, np.ones((len(table.rates), 1))], axis=1)
        for m in range(members):
            np.add.at(weighted[m], table.session, zeta[m][:, None] * columns)
        length = float(np.sum(settings.gamma ** np.arange(horizon)))
        lengths = np.append(length, np.full(table.rates.shape[1] - 1, horizon))

        def sums(totals: Floats) -> Floats:
            rates = totals[..., :-1] / np.maximum(totals[..., -1:], 1e-300)
            return within_reach(rates * lengths, settings, horizon, (table.scale.beta_low, table.scale.beta_high))

        main = sums(weighted.sum(1)).mean(0)
        refits = np.stack([sums(weighted[d % members][pick].sum(0)) for d, pick in enumerate(self.draws)])
        share = zeta.mean(0) / zeta.mean(0).sum()
        details = {
            "mean_ratio": float(zeta.mean()),
            "flow_gap": gap,
            "effective_steps": float(1 / np.sum(share**2)),
            "member_values": [float(v) for v in sums(weighted.sum(1))[:, 0]],
            "approximations": [
                "the average reward under the discounted distribution times the discounted length of the session",
                "r_end from averages under the discounted distribution",
            ],
        }
        found = value_estimate(self, main, refits, policy, horizon, support, details)
        if gap <= LARGEST_GAP:
            return found
        flag = Flag("not_converged", gap, LARGEST_GAP, "standard deviations", refuses=True)
        return replace(found, supported=False, flags=(*found.flags, flag))


def build(key: str, seed: int, size: Size) -> DualDice:
    """Build the estimator at a size of `ml.ope.registry`."""
    return DualDice(DiceConfig(seed=seed, members=1, updates=300) if size == "demo" else DiceConfig(seed=seed), key)
