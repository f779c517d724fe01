"""Off-policy evaluation by a linear autoregressive model of beta with bootstrapped residuals and the known reward.

The paper did not compare with it. Twenty lines of regression, no network, and hard to beat: every other method must earn its place
against it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings, step_reward
from ml.ope.batches import Scale, learn_scale, session_folds
from ml.ope.coverage import AmplitudeSupport
from ml.ope.end_outcomes import EndModel, fit_end_model, summarise
from ml.ope.estimate import LEVEL, OUTCOMES, Estimate, checked_horizon
from ml.progress import Report, silent
from ml.rl.policy import Policy
from ml.statistics.bootstrap import percentile_interval, resamples
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]

DECAYS = (0.8, 0.95, 0.985)
"""Memories of past amplitudes: exponential averages with time constants of about 5, 20 and 66 steps."""

PENALTIES = tuple(float(v) for v in 10.0 ** np.arange(-1, 5))


@dataclass(frozen=True, kw_only=True)
class LinearConfig:
    """Settings of the linear model.

    Attributes:
        refits: bootstrap refits, each on resampled sessions. per_refit: trajectories per policy and refit.
        rollouts: trajectories per policy of the estimate itself.
        folds: groups of sessions that choose the penalty. seed: of resamples and noise.
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
        c = self.config
        scale = learn_scale(buffer)
        tables = [_regression_table(s, scale) for s in buffer.sessions]
        usable = [k for k, (x, _) in enumerate(tables) if len(x)]
        if len(usable) < 2:
            raise ValueError(f"the linear model needs at least two sessions with usable steps; the buffer has {len(usable)}")
        grams = np.stack([x.T @ x for x, _ in tables])
        moments = np.stack([x.T @ y for x, y in tables])
        penalty, error = _choose_penalty(tables, grams, moments, session_folds(buffer.sessions, c.folds, c.seed))
        report(0.5, "fitting the linear model", held_out_error=error)
        draws = resamples(len(buffer.sessions), c.refits, c.seed)
        dynamics = _dynamics(tables, grams, moments, [np.arange(len(tables))], penalty, usable)
        refits = _dynamics(tables, grams, moments, list(draws), penalty, usable)
        variance = float(np.concatenate([y for _, y in tables]).var())
        report(1.0, "fitting the linear model", held_out_error=error)
        skill = 1 - error / variance if variance > 0 else 0.0
        return FittedLinear(
            self.method, c, buffer, scale, dynamics, refits, fit_end_model(buffer), fit_end_model(buffer, draws), penalty, skill
        )


@dataclass(frozen=True)
class Dynamics:
    """beta_{k+1} = features weights + scale(features) residual, standardised; D fits.

    Attributes:
        weights: [D, F]. noise_weights: of the log of the residual's scale, on (1, a, predicted beta), [D, 3].
        residuals: standardised residuals of each session, padded by repetition, [n, L].
        sources: sessions whose residuals a fit may draw, [D, n].
    """

    weights: Floats
    noise_weights: Floats
    residuals: Floats
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
    penalty: float
    skill: float

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
        window = np.tile(leads[rng.integers(0, len(leads), rows)], (p, 1))
        source = dynamics.sources[fit, rng.integers(0, dynamics.sources.shape[1], rows)]
        weights, noise_weights = np.tile(dynamics.weights[fit], (p, 1)), np.tile(dynamics.noise_weights[fit], (p, 1))
        low, high = scale.beta(np.array([scale.beta_low, scale.beta_high]))
        memory: Floats | None = None
        betas, actions = np.empty((horizon, p * rows)), np.empty((horizon, p * rows))
        for t in range(horizon):
            raw = scale.raw_beta(window)
            a = np.concatenate([policy.act(raw[i * rows : (i + 1) * rows]) for i, policy in enumerate(policies)])
            memory = np.tile(a[:, None], (1, len(DECAYS))) if memory is None else _remember(memory, a)
            x = _features(window, a, memory)
            predicted = np.einsum("ij,ij->i", x, weights)
            shock = np.tile(dynamics.residuals[source, rng.integers(0, dynamics.residuals.shape[1], rows)], p)
            newest = predicted + np.exp(np.einsum("ij,ij->i", _noise_features(a, predicted), noise_weights)) * shock
            newest = np.clip(newest, low - (high - low), high + (high - low))
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
        interval = percentile_interval(draws - draws.mean() + value, LEVEL)
        logged, simulated = support.of_policy(policy), support.look(main.actions[i][:, :: max(1, horizon // 50)])
        flags = list(logged.flags or simulated.flags)
        if not with_end:
            flags.append("fewer than three sessions have an end-of-session reward: the estimate is the step return alone")
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
                "penalty": self.penalty,
                "coverage": logged.to_json(),
                "coverage_simulated": simulated.to_json(),
                "held_out": {
                    "one_step_skill": self.skill,
                    "end_skill": float(self.end.skill[0]) if with_end else None,
                    "sessions": len(self.buffer.sessions),
                },
                "draws": [round(float(d + value - draws.mean()), 4) for d in draws],
            },
        )


def _features(window: Floats, a: Floats, memory: Floats) -> Floats:
    """Regressors of the next beta, [N, 1 + W + 8]: the window, the amplitude, its memories, and a few non-linear terms."""
    newest = window[:, -1]
    parts = [np.ones((len(a), 1)), window, a[:, None], (a**2)[:, None], (a * newest)[:, None], memory, (memory[:, :1] ** 2)]
    return np.concatenate([*parts, (memory[:, 1:2] * newest[:, None])], axis=1)


def _remember(memory: Floats, a: Floats) -> Floats:
    decay = np.array(DECAYS)
    return memory * decay + (1 - decay) * a[:, None]


def _noise_features(a: Floats, predicted: Floats) -> Floats:
    return np.stack([np.ones_like(a), a, np.clip(predicted, -3.0, 3.0)], axis=1)


def _regression_table(session: SessionTrajectory, scale: Scale) -> tuple[Floats, Floats]:
    """Features and standardised next beta of the usable steps of a session, [K, F] and [K]."""
    usable = session.usable()
    a = session.amplitude.copy()
    known = np.isfinite(a)
    if not known.any():
        a[:] = 0.0
    held = np.where(known, np.arange(a.size), -1)
    a = a[np.where(np.maximum.accumulate(held) < 0, int(np.argmax(known)), np.maximum.accumulate(held))]
    memory = np.empty((a.size, len(DECAYS)))
    memory[0] = a[0]
    for k in range(1, a.size):
        memory[k] = _remember(memory[k - 1 : k], a[k : k + 1])[0]
    windows = scale.beta(session.states()[:-1][usable])
    return _features(windows, a[usable], memory[usable]), scale.beta(session.beta[usable])


def _solve(grams: Floats, moments: Floats, penalty: float) -> Floats:
    ridge = np.full(grams.shape[1], penalty)
    ridge[0] = 1e-6
    return np.asarray(np.linalg.solve(grams + np.diag(ridge), moments), dtype=np.float64)


def _choose_penalty(tables: list[tuple[Floats, Floats]], grams: Floats, moments: Floats, folds: list[list[int]]) -> tuple[float, float]:
    """Penalty with the least squared error on sessions left out, and that error."""
    errors = []
    for penalty in PENALTIES:
        squared, count = 0.0, 0
        for fold in folds:
            rest = [k for k in range(len(tables)) if k not in set(fold)]
            weights = _solve(grams[rest].sum(0), moments[rest].sum(0), penalty)
            for k in fold:
                squared += float(np.sum((tables[k][1] - tables[k][0] @ weights) ** 2))
                count += len(tables[k][1])
        errors.append(squared / max(count, 1))
    best = int(np.argmin(errors))
    return PENALTIES[best], errors[best]


def _dynamics(
    tables: list[tuple[Floats, Floats]],
    grams: Floats,
    moments: Floats,
    picks: list[NDArray[np.int64]],
    penalty: float,
    usable: list[int],
) -> Dynamics:
    """One fit per list of sessions; residuals are those of the fit to all sessions."""
    base = _solve(grams.sum(0), moments.sum(0), penalty)
    noise, residuals = _noise_model(tables, base, usable)
    weights = np.stack([_solve(grams[pick].sum(0), moments[pick].sum(0), penalty) for pick in picks])
    rank = {k: r for r, k in enumerate(usable)}
    sources = [[rank[k] for k in pick if k in rank] or [0] for pick in picks]
    width = max(len(s) for s in sources)
    return Dynamics(weights, np.tile(noise, (len(picks), 1)), residuals, np.stack([np.resize(s, width) for s in sources]))


def _noise_model(tables: list[tuple[Floats, Floats]], weights: Floats, usable: list[int]) -> tuple[Floats, Floats]:
    """Weights of the residuals' log scale, [3], and standardised residuals per usable session, [n, L]."""
    all_noise, all_logs, per_session = [], [], []
    for k in usable:
        x, y = tables[k]
        predicted = x @ weights
        residual = y - predicted
        # The second column of the window block's end is the amplitude: features are 1, W betas, a, ...
        a = x[:, x.shape[1] - 8]
        all_noise.append(_noise_features(a, predicted))
        all_logs.append(np.log(np.maximum(np.abs(residual), 1e-6)))
        per_session.append(residual)
    design, logs = np.concatenate(all_noise), np.concatenate(all_logs)
    noise = _solve((design.T @ design)[None], (design.T @ logs)[None, :, None], 10.0)[0, :, 0]
    scaled = [r * np.exp(-(d @ noise)) for r, d in zip(per_session, all_noise, strict=True)]
    longest = max(len(r) for r in scaled)
    return noise, np.stack([np.resize(r, longest) for r in scaled])
