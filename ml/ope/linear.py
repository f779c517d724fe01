"""Off-policy evaluation by a linear autoregressive model of beta with bootstrapped residuals and the known reward.

The paper did not compare with it. A regression, no network, and hard to beat: every other method must earn its place against it. The
dynamics, and how they are kept from walking off, are in `linear_dynamics`; residuals are replayed in blocks of one session per trajectory,
so that what a session has of its own stays with it; the reward is that of sampled beta, never of its mean.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings, step_reward
from ml.ope.batches import Scale, learn_scale, session_folds
from ml.ope.coverage import AmplitudeSupport
from ml.ope.end_outcomes import EndModel, fit_end_model, summarise
from ml.ope.estimate import LEVEL, OUTCOMES, Estimate, checked_horizon
from ml.ope.linear_dynamics import (
    CANDIDATES,
    Regression,
    block_error,
    choose,
    day_columns,
    features,
    fit_weights,
    largest_root,
    noise_features,
    noise_model,
    regression,
    replay_errors,
    replay_folds,
)
from ml.ope.observed import day_noise
from ml.ope.steps import fresh_memory, remember
from ml.progress import Report, silent
from ml.rl.policy import Policy
from ml.statistics.bootstrap import percentile_interval, resamples
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

BLOCK = 30
"""Steps of one session's residuals that are replayed in their order before another start in the same session is drawn."""

BEYOND = 0.25
"""Sampled beta may leave the logged range by this share of it."""


@dataclass(frozen=True, kw_only=True)
class LinearConfig:
    """Settings of the linear model.

    Attributes:
        refits: bootstrap refits, each on resampled sessions. per_refit: trajectories per policy and refit.
        rollouts: trajectories per policy of the estimate itself.
        folds: groups of sessions that choose penalty and shrinkage. seed: of resamples and noise.
    """

    refits: int = 50
    per_refit: int = 10
    rollouts: int = 400
    folds: int = 5
    seed: int = 0


@dataclass(frozen=True)
class LinearModel:
    """The estimator."""

    config: LinearConfig = field(default_factory=LinearConfig)
    method: str = "linear"

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedLinear:
        """Fit the model and its bootstrap refits; takes seconds, so nothing is kept in `checkpoint_dir`.

        Raises:
            ValueError: fewer than two sessions with usable steps.
        """
        c, scale = self.config, learn_scale(buffer)
        data = regression(buffer, scale)
        if len(data.usable) < 2:
            raise ValueError(f"the linear model needs at least two sessions with usable steps; the buffer has {len(data.usable)}")
        ways = replay_folds(buffer, session_folds(buffer.sessions, c.folds, c.seed))
        errors = []
        for k, folds in enumerate(ways):
            errors.append(replay_errors(buffer, scale, data, folds))
            report(0.8 * (k + 1) / len(ways), "replaying left-out sessions")
        best = choose(errors, ways)
        draws = resamples(len(buffer.sessions), c.refits, c.seed)
        dynamics = _dynamics(data, [np.arange(len(buffer.sessions))], [best])
        refits = _dynamics(data, list(draws), [choose(errors, ways, pick) for pick in draws])
        report(1.0, "fitting the linear model")
        skill = replay_skill(buffer, scale, errors, best)
        return FittedLinear(
            self.method, c, buffer, scale, dynamics, refits, fit_end_model(buffer), fit_end_model(buffer, draws), best, skill
        )


@dataclass(frozen=True)
class Dynamics:
    """beta_{k+1} = features weights + scale(features) residual, standardised; D fits.

    Attributes:
        weights: [D, F]. noise_weights: of the log of the residual's scale, on (1, a, predicted beta), [D, 3].
        residuals: standardised residuals of each session in order of time, padded by repetition, [n, L].
        visits: numbers of the visits, whose own levels are the last V weights.
        sources: sessions whose residuals a fit may draw, [D, n].
    """

    weights: Floats
    noise_weights: Floats
    residuals: Floats
    visits: tuple[int, ...]
    sources: NDArray[np.int64]


@dataclass(frozen=True)
class _Simulated:
    step_return: Floats  # [P, M]
    outcomes: Floats  # [P, M, 4]
    energy: Floats
    amplitude: Floats
    beta: Floats
    actions: Floats  # [P, M, T]


@dataclass(frozen=True)
class FittedLinear:
    """A fitted linear model, its bootstrap refits and its buffer."""

    method: str
    config: LinearConfig
    buffer: ReplayBuffer
    scale: Scale
    dynamics: Dynamics
    refits: Dynamics
    end: EndModel
    end_refits: EndModel
    chosen: int
    skill: float | None

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Simulate every policy with the fit (the value) and with every refit (the interval), from the sessions' own s_0."""
        horizon = checked_horizon(self.buffer, horizon_steps)
        if not policies:
            return {}
        c, chosen = self.config, list(policies.values())
        main = self._simulate(chosen, self.dynamics, self.end, c.rollouts, horizon, c.seed + 1)
        report(0.5, "rolling out policies in the linear model")
        spread = self._simulate(chosen, self.refits, self.end_refits, c.refits * c.per_refit, horizon, c.seed + 2)
        report(1.0, "rolling out policies in the linear model")
        support = AmplitudeSupport(self.buffer)
        return {name: self._estimate(i, policy, main, spread, support, horizon) for i, (name, policy) in enumerate(policies.items())}

    def _simulate(self, policies: list[Policy], dynamics: Dynamics, end: EndModel, rows: int, horizon: int, seed: int) -> _Simulated:
        """`rows` trajectories per policy; row m uses fit m modulo D and starts like session m modulo n. All policies share the noise."""
        settings, sessions, scale = self.buffer.settings, self.buffer.sessions, self.scale
        p, rng = len(policies), np.random.default_rng(seed)
        fit = np.arange(rows) % len(dynamics.weights)
        starts = [s for s in sessions if np.isfinite(s.lead_beta).all()] or list(sessions)
        leads = np.stack([scale.beta(np.where(np.isfinite(s.lead_beta), s.lead_beta, self._middle())) for s in starts])
        like = rng.integers(0, len(leads), rows)
        window = np.tile(leads[like], (p, 1))
        source = dynamics.sources[fit, rng.integers(0, dynamics.sources.shape[1], rows)]
        common = dynamics.weights.shape[1] - len(dynamics.visits)
        days = day_columns(dynamics.visits, [starts[k].visit for k in like])
        day = np.tile(np.einsum("ij,ij->i", dynamics.weights[fit, common:], days), p)
        weights, noise_weights = np.tile(dynamics.weights[fit, :common], (p, 1)), np.tile(dynamics.noise_weights[fit], (p, 1))
        offset = np.zeros(rows, dtype=np.int64)
        low, high = scale.beta(np.array([scale.beta_low, scale.beta_high]))
        memory: Floats | None = None
        betas, actions = np.empty((horizon, p * rows)), np.empty((horizon, p * rows))
        for t in range(horizon):
            raw = scale.raw_beta(window)
            a = np.concatenate([policy.act(raw[i * rows : (i + 1) * rows]) for i, policy in enumerate(policies)])
            memory = fresh_memory(a) if memory is None else remember(memory, a)
            x = features(window, a, memory)
            predicted = np.einsum("ij,ij->i", x, weights) + day
            if t % BLOCK == 0:
                offset = rng.integers(0, dynamics.residuals.shape[1], rows)
            shock = np.tile(dynamics.residuals[source, (offset + t) % dynamics.residuals.shape[1]], p)
            newest = predicted + np.exp(np.einsum("ij,ij->i", noise_features(a, predicted), noise_weights)) * shock
            newest = np.clip(newest, low - BEYOND * (high - low), high + BEYOND * (high - low))
            window = np.concatenate([window[:, 1:], newest[:, None]], axis=1)
            betas[t], actions[t] = scale.raw_beta(newest), a
        return self._simulated(betas, actions, end, fit, settings, p, rows)

    def _simulated(
        self, betas: Floats, actions: Floats, end: EndModel, fit: NDArray[np.int64], settings: MdpSettings, p: int, rows: int
    ) -> _Simulated:
        horizon = len(betas)
        discount = settings.gamma ** np.arange(horizon)[:, None]
        returns = (discount * step_reward(settings, betas, actions)).sum(0).reshape(p, rows)
        summaries = summarise(betas.T, actions.T, settings.xi_beta).reshape(p, rows, -1)
        model = (
            end
            if end.weights.ndim == 2
            else EndModel(end.weights[fit], end.centre, end.spread, end.penalties, end.seen, end.skill, end.residual)
        )
        outcomes = np.stack([model.predict(s) for s in summaries])
        a = actions.T.reshape(p, rows, horizon)
        return _Simulated(returns, outcomes, (a**2).mean(2), a.mean(2), betas.T.reshape(p, rows, horizon).mean(2), a)

    def _middle(self) -> float:
        return float(self.scale.raw_beta(np.array(0.0)))

    def _estimate(self, i: int, policy: Policy, main: _Simulated, spread: _Simulated, support: AmplitudeSupport, horizon: int) -> Estimate:
        with_end = self.end.seen[0]
        end = main.outcomes[i, :, 0].mean() if with_end else 0.0
        step = float(main.step_return[i].mean())
        returns = spread.step_return[i] + (spread.outcomes[i, :, 0] if with_end else 0.0)
        # Rows go fit by fit, so a column of this table is one refit.
        draws = returns.reshape(self.config.per_refit, self.config.refits).mean(0)
        value = step + float(end)
        noise, unknown = day_noise(self.buffer, horizon, len(draws), self.config.seed)
        # Every pair of a refit and a day: what is common to all policies widens the interval, but is no part of the kept draws.
        interval = percentile_interval(np.add.outer(draws - draws.mean(), noise).ravel() + value, LEVEL)
        logged, simulated = support.of_policy(policy), support.look(main.actions[i][:, :: max(1, horizon // 50)])
        flags = list(logged.flags or simulated.flags)
        if not with_end:
            flags.append("fewer than three sessions have an end-of-session reward: the estimate is the step return alone")
        flags += [unknown] if unknown else []
        predicted = {
            "energy": float(main.energy[i].mean()),
            "mean_amplitude": float(main.amplitude[i].mean()),
            "mean_beta": float(main.beta[i].mean()),
        }
        for j, name in enumerate(OUTCOMES):
            if name != "r_end" and self.end.seen[j]:
                predicted[name] = float(main.outcomes[i, :, j].mean())
        return Estimate(
            method=self.method,
            value=value,
            low=interval.low,
            high=interval.high,
            level=LEVEL,
            standard_error=interval.standard_error,
            step_return=step,
            end_reward=float(end) if with_end else None,
            predicted=predicted,
            supported=logged.supported and simulated.supported,
            flags=tuple(flags),
            n=main.step_return.shape[1],
            details={
                "horizon_steps": horizon,
                "penalty": CANDIDATES[self.chosen][0],
                "root_shrinkage": CANDIDATES[self.chosen][1],
                "level_of_each_visit": CANDIDATES[self.chosen][2] < float("inf"),
                "largest_root": largest_root(self.dynamics.weights[0], self.buffer.settings.window),
                "coverage": logged.to_json(),
                "coverage_simulated": simulated.to_json(),
                "held_out": {
                    "replay_skill": self.skill,
                    "end_skill": float(self.end.skill[0]) if with_end else None,
                    "sessions": len(self.buffer.sessions),
                },
                "draws": [round(float(d + value - draws.mean()), 4) for d in draws],
            },
        )


def replay_skill(buffer: ReplayBuffer, scale: Scale, errors: Sequence[Floats], best: int) -> float | None:
    """1 - error / error of the overall mean beta, over the replayed left-out sessions (all ways of leaving out); None where none was."""
    own, plain = [], []
    constant = np.zeros((len(CANDIDATES), 1))
    for table in errors:
        for k in np.flatnonzero(np.isfinite(table[best])):
            beta = scale.beta(buffer.sessions[k].beta)
            own.append(table[best, k])
            plain.append(block_error(beta, np.tile(constant[:1], (1, beta.size)))[0])
    return 1 - float(np.sum(own) / np.sum(plain)) if own and np.sum(plain) > 0 else None


def _dynamics(data: Regression, picks: list[NDArray[np.int64]], candidates: list[int]) -> Dynamics:
    """One fit per list of sessions with a candidate each; residuals are those of the first candidate's fit to all sessions."""
    base = fit_weights(data, np.arange(len(data.x)), *CANDIDATES[candidates[0]])
    noise, residuals = noise_model(data, base)
    weights = np.stack([fit_weights(data, pick, *CANDIDATES[c]) for pick, c in zip(picks, candidates, strict=True)])
    rank = {k: r for r, k in enumerate(data.usable)}
    sources = [[rank[k] for k in pick if k in rank] or [0] for pick in picks]
    width = max(len(s) for s in sources)
    return Dynamics(weights, np.tile(noise, (len(picks), 1)), residuals, data.visits, np.stack([np.resize(s, width) for s in sources]))
