"""Off-policy evaluation by the deep latent MDP model (DLMM), the one-step predecessor of the DLSM.

Source: Gao et al. 2023, appendix C.2 (after Gao et al., ICCPS 2022): a variational auto-encoder of single transitions,
    prior p(z) = N(0, I),  encoder q(z_t | s_t),  decoder p(s_{t+1}, r_t | z_t, a_t),
trained by the evidence lower bound of log p(s_{t+1}, r_t) and rolled out by encoding every predicted state again. It carries nothing from
one step to the next but the window of beta itself. It cannot predict end-of-session outcomes: those come from the linear model's regression
on a session's minutes, so that the comparison is fair. Only the newest beta of s_{t+1} is decoded; the others are known from s_t.
Everything enters standardised; the reward is the decoder's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtri
from torch import Tensor, nn

from ml.mdp import step_reward
from ml.ope.dlsm.batches import Batch, make_batch
from ml.ope.dlsm.heads import GaussianHead, gaussian_kl, gaussian_log_prob
from ml.ope.estimate import LEVEL, OUTCOMES, Estimate, checked_horizon, require_two_sessions
from ml.ope.flags import FEW_END_REWARDS
from ml.ope.outcomes.minutes import by_minute
from ml.ope.outcomes.model import EndModel, fit_end_model
from ml.ope.registry import Size
from ml.ope.scale import Scale, learn_scale, session_folds
from ml.ope.support.coverage import AmplitudeSupport, flags_of
from ml.policies.policy import Policy, start_sessions
from ml.progress import Report, part_of, silent
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

DRAWS = 200


@dataclass(frozen=True, kw_only=True)
class DlmmConfig:
    """Settings; the paper gives none of the sizes.

    Attributes:
        latent: size of z. hidden: layers of encoder and decoder.
        members: models, one seed and one group of held-out sessions each.
        updates, batch, learning_rate: of Adam, over single transitions.
        patience: checks, one every 100 updates, without a better held-out bound before stopping.
        held_out: share of the sessions that a member does not learn from.
        rollouts: trajectories per policy and member. seed: first seed.
    """

    latent: int = 8
    hidden: tuple[int, ...] = (64, 64)
    members: int = 3
    updates: int = 2000
    batch: int = 256
    learning_rate: float = 1e-3
    patience: int = 4
    held_out: float = 0.2
    rollouts: int = 128
    seed: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return all settings, by name."""
        return asdict(self)


class DlmmNetworks(nn.Module):
    """Encoder q(z_t | s_t), [N, W] -> [N, Z], and decoder of (newest beta of s_{t+1}, r_t) given (z_t, a_t), [N, Z + 1] -> [N, 2]."""

    def __init__(self, window: int, config: DlmmConfig) -> None:
        super().__init__()
        self.encoder = GaussianHead(window, config.latent, config.hidden)
        self.decoder = GaussianHead(config.latent + 1, 2, config.hidden)

    def bound(self, states: Tensor, actions: Tensor, targets: Tensor, noise: Tensor) -> Tensor:
        """Compute the evidence lower bound of log p(s_{t+1}, r_t) per transition, [N]; states [N, W], actions [N, 1], targets [N, 2], noise
        [N, Z]."""
        mean, log_std = self.encoder(states)
        kl = gaussian_kl(mean, log_std, torch.zeros_like(mean), torch.zeros_like(log_std)).sum(1)
        out_mean, out_log_std = self.decoder(torch.cat([mean + log_std.exp() * noise, actions], dim=1))
        return gaussian_log_prob(targets, out_mean, out_log_std).sum(1) - kl

    def draw(self, states: Tensor, actions: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Draw the newest beta and compute the mean reward, [N] each; noise [N, Z + 1]."""
        mean, log_std = self.encoder(states)
        z = mean + log_std.exp() * noise[:, :-1]
        out_mean, out_log_std = self.decoder(torch.cat([z, actions], dim=1))
        return out_mean[:, 0] + out_log_std[:, 0].exp() * noise[:, -1], out_mean[:, 1]


@dataclass(frozen=True)
class _Transitions:
    """Usable steps as rows: states [N, W], actions [N, 1], targets (newest beta, reward) [N, 2], session of each row [N]."""

    states: Tensor
    actions: Tensor
    targets: Tensor
    session: NDArray[np.int64]

    def rows(self, index: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor]:
        """Select some rows."""
        chosen = torch.from_numpy(index)
        return self.states[chosen], self.actions[chosen], self.targets[chosen]


def _transitions(batch: Batch) -> _Transitions:
    """Collect the rows of the usable steps of a padded batch."""
    step, session = torch.nonzero(batch.usable > 0, as_tuple=True)
    targets = torch.stack([batch.states[step + 1, session, -1], batch.rewards[step, session]], dim=1)
    return _Transitions(batch.states[step, session], batch.actions[step, session].unsqueeze(1), targets, session.numpy())


@dataclass(frozen=True)
class Dlmm:
    """The estimator."""

    config: DlmmConfig = field(default_factory=DlmmConfig)
    method: str = "dlmm"

    @property
    def successive_members(self) -> int:
        """Members that learn one after the other, each with a learning curve of its own."""
        return self.config.members

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedDlmm:
        """Train the members; seconds each, so nothing is kept in `checkpoint_dir`.

        Raises:
            ValueError: fewer than two sessions with usable steps.
        """
        require_two_sessions("the DLMM", sum(bool(s.usable().any()) for s in buffer.sessions))
        c = self.config
        scale = learn_scale(buffer)
        rows = _transitions(make_batch(buffer, scale))
        folds = session_folds(buffer.sessions, max(2, round(1 / c.held_out)), c.seed)
        members = tuple(
            _train(rows, folds[k % len(folds)], buffer.settings.window, c, c.seed + k, part_of(report, k, c.members))
            for k in range(c.members)
        )
        return FittedDlmm(self.method, c, buffer, scale, members, fit_end_model(buffer))


def _train(rows: _Transitions, held: list[int], window: int, config: DlmmConfig, seed: int, report: Report) -> DlmmNetworks:
    """Train one member, and restore it at its best held-out bound."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        networks = DlmmNetworks(window, config)
    out = np.isin(rows.session, held)
    learnt, left = np.flatnonzero(~out), np.flatnonzero(out)
    if learnt.size == 0 or left.size == 0:
        learnt = left = np.arange(rows.session.size)
    optimizer = torch.optim.Adam(networks.parameters(), lr=config.learning_rate, foreach=True)
    generator, picker = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    check_noise = torch.randn(left.size, config.latent, generator=generator)
    best, stale, weights = -np.inf, 0, networks.state_dict()
    for update in range(1, config.updates + 1):
        chosen = learnt[picker.integers(0, learnt.size, min(config.batch, learnt.size))]
        loss = -networks.bound(*rows.rows(chosen), torch.randn(chosen.size, config.latent, generator=generator)).mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(networks.parameters(), 10.0, error_if_nonfinite=True)
        optimizer.step()
        if update % 100 and update != config.updates:
            continue
        with torch.inference_mode():
            score = float(networks.bound(*rows.rows(left), check_noise).mean())
        report(update / config.updates, "fitting the deep latent MDP model", loss=float(loss.detach()), held_out_bound=score)
        if score > best:
            best, stale = score, 0
            weights = {name: value.clone() for name, value in networks.state_dict().items()}
        else:
            stale += 1
            if stale >= config.patience:
                break
    networks.load_state_dict(weights)
    return networks.eval()


@dataclass(frozen=True)
class _Simulated:
    """Roll-outs of one member: step return by the decoder's and by the known reward [P, M], outcomes [P, M, 4], traces [P, M, T]."""

    step_return: Floats
    known_return: Floats
    outcomes: Floats
    beta: Floats
    actions: Floats


@dataclass(frozen=True)
class FittedDlmm:
    """Trained members and the buffer they come from."""

    method: str
    config: DlmmConfig
    buffer: ReplayBuffer
    scale: Scale
    members: tuple[DlmmNetworks, ...]
    end: EndModel

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Roll every policy out in every member from the sessions' own s_0."""
        horizon = checked_horizon(self.buffer, horizon_steps)
        if not policies:
            return {}
        runs = []
        for k, member in enumerate(self.members):
            runs.append(self._simulate(member, list(policies.values()), horizon, self.config.seed + 1000 + k))
            report((k + 1) / len(self.members), "rolling out policies in the deep latent MDP model")
        support = AmplitudeSupport(self.buffer)
        return {name: self._estimate(i, policy, runs, support, horizon) for i, (name, policy) in enumerate(policies.items())}

    def _simulate(self, networks: DlmmNetworks, policies: list[Policy], horizon: int, seed: int) -> _Simulated:
        """Simulate M trajectories per policy; all policies share starts and noise."""
        settings, scale, m, p = self.buffer.settings, self.scale, self.config.rollouts, len(policies)
        rng = np.random.default_rng(seed)
        starts = make_batch(self.buffer, scale).states[0].numpy().astype(np.float64)
        window = np.tile(starts[rng.integers(0, len(starts), m)], (p, 1))
        low, high = scale.beta(np.array([scale.beta_low, scale.beta_high]))
        beta, actions, step_return = np.empty((horizon, p * m)), np.empty((horizon, p * m)), np.zeros(p * m)
        policies = [start_sessions(policy) for policy in policies]
        for t in range(horizon):
            raw = scale.raw_beta(window)
            a = np.concatenate([policy.act(raw[i * m : (i + 1) * m]) for i, policy in enumerate(policies)])
            noise = np.tile(rng.standard_normal((m, self.config.latent + 1)), (p, 1))
            with torch.inference_mode():
                drawn, reward = networks.draw(_single(window), _single(a[:, None]), _single(noise))
            # a stop for wild models: one logged range beyond the logged range
            newest = np.clip(drawn.numpy().astype(np.float64), 2 * low - high, 2 * high - low)
            window = np.concatenate([window[:, 1:], newest[:, None]], axis=1)
            beta[t], actions[t] = scale.raw_beta(newest), a
            step_return += settings.gamma**t * (reward.numpy().astype(np.float64) * scale.reward_std + scale.reward_mean)
        discount = settings.gamma ** np.arange(horizon)[:, None]
        known = (discount * step_reward(settings, beta, actions)).sum(0)
        outcomes = self.end.predict(by_minute(beta.T, actions.T, settings))
        shape = (p, m)
        return _Simulated(
            step_return.reshape(shape),
            known.reshape(shape),
            outcomes.reshape(p, m, -1),
            beta.T.reshape(p, m, -1),
            actions.T.reshape(p, m, -1),
        )

    def _estimate(self, i: int, policy: Policy, runs: list[_Simulated], support: AmplitudeSupport, horizon: int) -> Estimate:
        with_end = self.end.seen[0]
        ends = np.array([r.outcomes[i, :, 0].mean() if with_end else 0.0 for r in runs])
        values = np.array([r.step_return[i].mean() for r in runs]) + ends
        value = float(values.mean())
        monte_carlo = np.mean([r.step_return[i].var() / r.step_return.shape[1] for r in runs]) / len(runs)
        level = self.end.by_session.residual[0] ** 2 / len(self.buffer.sessions) if with_end else 0.0
        spread = float(values.var(ddof=1)) if len(runs) > 1 else 0.0
        error = float(np.sqrt(spread + monte_carlo + level))
        reach = float(ndtri((1 + LEVEL) / 2)) * error
        every = max(1, horizon // 50)
        logged, simulated = support.of_policy(policy), support.look(np.concatenate([r.actions[i][:, ::every] for r in runs]))
        flags = list(flags_of(logged, simulated))
        if not with_end:
            flags.append(FEW_END_REWARDS)
        predicted = {
            "energy": float(np.mean([(r.actions[i] ** 2).mean() for r in runs])),
            "mean_amplitude": float(np.mean([r.actions[i].mean() for r in runs])),
            "mean_beta": float(np.mean([r.beta[i].mean() for r in runs])),
        }
        for j, name in enumerate(OUTCOMES):
            if name != "r_end" and self.end.seen[j]:
                predicted[name] = float(np.mean([r.outcomes[i, :, j].mean() for r in runs]))
        draws = value + error * np.random.default_rng(self.config.seed + 2000 + i).standard_normal(DRAWS)
        return Estimate(
            method=self.method,
            value=value,
            low=value - reach,
            high=value + reach,
            level=LEVEL,
            standard_error=error,
            step_return=float(value - ends.mean()),
            end_reward=float(ends.mean()) if with_end else None,
            predicted=predicted,
            supported=logged.supported and simulated.supported,
            flags=tuple(flags),
            n=sum(r.step_return.shape[1] for r in runs),
            details={
                "horizon_steps": horizon,
                "step_return_known": float(np.mean([r.known_return[i].mean() for r in runs])),
                "members": [float(v) for v in values],
                "coverage": logged.to_json(),
                "coverage_simulated": simulated.to_json(),
                "draws": [round(float(d), 4) for d in draws],
            },
        )


def _single(values: Floats) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)


def build(key: str, seed: int, size: Size) -> Dlmm:
    """Build the estimator at a size of `ml.ope.registry`."""
    return Dlmm(DlmmConfig(members=1, updates=800, rollouts=64, seed=seed) if size == "demo" else DlmmConfig(seed=seed), key)
