"""Off-policy evaluation by replaying every logged session under another policy, in a linear model of beta with the known reward.

The paper did not compare with it. A regression, no network, and hard to beat: every other method must earn its place against it. A session
keeps what is its own: its level, its innovations in their order, and the residuals of its outcomes. Only what the amplitude changes has to
be modelled: a policy that would have done what was done gets exactly what was observed. The reward is that of the replayed beta, never of
its mean. The dynamics are in `linear_dynamics`, the outcomes in `ml.ope.outcomes`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ml.mdp import step_reward
from ml.ope.estimate import LEVEL, OUTCOMES, Estimate, checked_horizon
from ml.ope.flags import FEW_END_REWARDS, stopped_sessions
from ml.ope.lead import dose_before
from ml.ope.linear.dynamics import SessionTable, fit_dynamics, largest_root, noise_features
from ml.ope.linear.held_out import replay_skill
from ml.ope.observed import MeanOverDays, mean_over_days
from ml.ope.outcomes.minutes import Minutes, by_minute, of_buffer
from ml.ope.outcomes.model import EndModel, fit_end_model
from ml.ope.posterior.support import LATE_STEPS
from ml.ope.posterior.verdict import NEARLY_OFF
from ml.ope.registry import Size
from ml.ope.scale import Scale, learn_scale, outcome_table, session_folds
from ml.ope.support.coverage import AmplitudeSupport, flags_of
from ml.policies.policy import Policy, start_sessions
from ml.progress import Report, silent
from ml.statistics.bootstrap import percentile_interval
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

BEYOND = 0.25
"""Replayed beta may leave the logged range by this share of it."""


class Response(Protocol):
    """The answer of beta to amplitudes [P, D, n] as they come."""

    def lasting(self) -> Floats:
        """Answer [P, D, n] before the first of them."""

    def step(self, a: Floats) -> Floats:
        """Answer [P, D, n] once the amplitudes a are in force."""


class Replayable(Protocol):
    """A model of beta that sessions can be replayed in; D sets of coefficients, n sessions.

    Attributes:
        phi: autoregression of what answer and level leave, [W]. levels: of the sessions, [D, n].
        noise_weights: of the log of an innovation's scale on (1, a, predicted beta), [3].
        shares: lambda / (1 + lambda) of the visits' and the sessions' levels.
    """

    @property
    def phi(self) -> Floats: ...
    @property
    def levels(self) -> Floats: ...
    @property
    def noise_weights(self) -> Floats: ...
    @property
    def shares(self) -> dict[str, float]: ...
    def innovations(self, tables: Sequence[Any]) -> list[Floats]:
        """Compute standardised innovations of the steps of each session, [D, T]; NaN where a step is not usable."""

    def response(self, first: Floats, steps: int) -> Response:
        """Begin the answer to amplitudes that come step by step, the first of them [P, D, n]."""

    def usual_lead(self) -> Floats:
        """Compute standardised beta of each session, [n], where the window before it is not known."""


@dataclass(frozen=True, kw_only=True)
class LinearConfig:
    """Settings of the linear model.

    Attributes:
        draws: draws of the coefficients from their posterior; every session is replayed with each.
        most_rows: replayed sessions per policy at most; a longer record takes fewer draws, though never fewer than 20.
        folds: groups of sessions for the held-out skill that is shown with the estimates. seed: of draws and of innovations that are
            missing.
    """

    draws: int = 60
    most_rows: int = 1500
    folds: int = 5
    seed: int = 0


@dataclass(frozen=True)
class LinearModel:
    """The estimator."""

    config: LinearConfig = field(default_factory=LinearConfig)
    method: str = "linear"

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedLinear:
        """Fit dynamics and outcomes; takes seconds, so nothing is kept in `checkpoint_dir`.

        Raises:
            ValueError: fewer than two sessions with usable steps.
        """
        c, scale = self.config, learn_scale(buffer)
        before = dose_before(buffer)
        tables = tuple(SessionTable.of(s, scale, before) for s in buffer.sessions)
        draws = max(20, min(c.draws, c.most_rows // len(tables)))
        main, drawn = fit_dynamics(buffer, tables, draws, c.seed, before)
        report(0.4, "fitting the linear model")
        skill = replay_skill(buffer, tables, session_folds(buffer.sessions, c.folds, c.seed), before)
        report(0.8, "replaying left-out sessions")
        severity = main.levels[0]
        ends = fit_end_model(buffer, draws=draws, seed=c.seed, severity=severity)
        report(1.0, "fitting the linear model")
        return FittedLinear(self.method, c, buffer, scale, tables, main, drawn, ends.part(0, 0), ends, skill)


@dataclass(frozen=True)
class Replayed:
    """Logged sessions under other policies: P policies, D sets of coefficients, n sessions.

    Attributes:
        step_return, energy, amplitude, beta: discounted step return, mean a^2, mean a and mean beta, [P, D, n].
        outcomes: r_end and QoCs, [P, D, n, 4].
        above, off: share of steps at or above the threshold, and of amplitudes below `NEARLY_OFF`, [P, D, n].
        late, switching, from_cdbs: mean amplitude of the last `LATE_STEPS`, mean change from step to step, mean |a - 1|, [P, D, n].
        sample: amplitudes of about 50 steps with the first coefficients, [P, n, 50].
    """

    step_return: Floats
    outcomes: Floats
    energy: Floats
    amplitude: Floats
    beta: Floats
    above: Floats
    late: Floats
    switching: Floats
    off: Floats
    from_cdbs: Floats
    sample: Floats


@dataclass(frozen=True)
class FittedLinear:
    """A fitted linear model, draws of its coefficients and its buffer; `end` is the mean of the outcome model, `ends` has its draws."""

    method: str
    config: LinearConfig
    buffer: ReplayBuffer
    scale: Scale
    tables: tuple[Any, ...]
    main: Replayable
    drawn: Replayable
    end: EndModel
    ends: EndModel
    skill: float | None

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Replay every session under every policy with the fit (the value) and with draws of its coefficients (the interval)."""
        horizon = checked_horizon(self.buffer, horizon_steps)
        if not policies:
            return {}
        chosen = list(policies.values())
        main = self.replay(chosen, self.main, self.end, horizon)
        report(0.3, "replaying sessions in the linear model")
        spread = self.replay(chosen, self.drawn, self.ends, horizon)
        report(1.0, "replaying sessions in the linear model")
        visits = np.array([s.visit for s in self.buffer.sessions])
        measured = self._as_measured(chosen, horizon)
        days = mean_over_days(self._returns(main).mean(1), visits, len(self.drawn.levels), self.config.seed)
        support = AmplitudeSupport(self.buffer)
        return {n: self._estimate(i, p, main, spread, days, support, horizon, measured) for i, (n, p) in enumerate(policies.items())}

    def replay(self, policies: list[Policy], dynamics: Replayable, end: EndModel, horizon: int) -> Replayed:
        """Run every session under every policy with every set of coefficients, and with as many draws of the outcomes where `end` has
        any."""
        start, noise = self.beginning(dynamics, horizon)
        logged = of_buffer(self.buffer)
        was = Minutes(logged.features[None], logged.share[None], logged.late[None])
        seen = (end.each if end.draws else end.predict)(was, end.sessions)
        # one policy after the other: the steps of all of them at once would be gigabytes for a long record
        each = [self._replayed(*self.steps(policy, dynamics, start, noise), end, seen) for policy in policies]
        return Replayed(**{f.name: np.stack([getattr(one, f.name) for one in each]) for f in fields(Replayed)})

    def beginning(self, dynamics: Replayable, horizon: int) -> tuple[Floats, Floats]:
        """Compute the windows before the first step, standardised, [W, D, n], and standardised innovations of the steps, [H, D, n]."""
        w, levels = self.buffer.settings.window, dynamics.levels
        lead = np.stack([t.beta[:w] for t in self.tables])
        lead = np.where(np.isfinite(lead), lead, dynamics.usual_lead()[:, None])
        return np.broadcast_to(lead.T[:, None], (w, *levels.shape)), self._innovations(dynamics, horizon)

    def steps(self, policy: Policy, dynamics: Replayable, start: Floats, noise: Floats) -> tuple[Floats, Floats]:
        """Compute beta in the buffer's unit and amplitudes under a policy, [H, D, n] each, from a `beginning`."""
        (w, *shape), horizon, phi = start.shape, len(noise), dynamics.phi[::-1]
        low, high = self.scale.beta(np.array([self.scale.beta_low, self.scale.beta_high]))
        low, high = low - BEYOND * (high - low), high + BEYOND * (high - low)
        raw, eta, actions = np.empty((w + horizon, *shape)), np.empty((w + horizon, *shape)), np.empty((horizon, *shape))
        raw[:w] = self.scale.raw_beta(start)
        policy = start_sessions(policy)
        response: Response | None = None
        for t in range(horizon):
            a = actions[t] = policy.act(raw[t : t + w].reshape(w, -1).T).reshape(shape)
            if response is None:
                response = dynamics.response(a[None], horizon)
                eta[:w] = start - (response.lasting()[0] + dynamics.levels)
            rest = response.step(a[None])[0] + dynamics.levels
            predicted = rest + np.tensordot(phi, eta[t : t + w], 1)
            newest = predicted + np.exp(noise_features(a, predicted) @ dynamics.noise_weights) * noise[t]
            newest = np.clip(newest, low, high)
            eta[w + t], raw[w + t] = newest - rest, self.scale.raw_beta(newest)
        return raw[w:], actions

    def _as_measured(self, policies: list[Policy], horizon: int) -> Floats | None:
        """Compute r_end [P, n] if sessions that were stopped counted as measured; None where none was."""
        if not any(s.stopped for s in self.buffer.sessions):
            return None
        buffer = replace(self.buffer, sessions=tuple(replace(s, stopped_as=None) for s in self.buffer.sessions))
        other = replace(self, buffer=buffer, end=fit_end_model(buffer, severity=self.main.levels[0]))
        return other.replay(policies, self.main, other.end, horizon).outcomes[:, :, :, 0].mean(1)

    def _innovations(self, dynamics: Replayable, horizon: int) -> Floats:
        """Draw standardised innovations of every session over the horizon, [H, D, n].

        Steps that a session lacks take a known one of the same session, or of any session where it has none.
        """
        found = dynamics.innovations(self.tables)
        rng = np.random.default_rng([self.config.seed, 0x5E55])
        noise = np.empty((horizon, len(dynamics.levels), len(found)))
        for i, own in enumerate(found):
            known = np.flatnonzero(np.isfinite(own[0]))
            source = own[:, known] if known.size else np.concatenate([f[:, np.isfinite(f[0])] for f in found], axis=1)
            noise[:, :, i] = source[:, rng.choice(source.shape[1], horizon)].T
            within = known[known < horizon]
            noise[within, :, i] = own[:, within].T
        return noise

    def _replayed(self, betas: Floats, actions: Floats, end: EndModel, seen: Floats) -> Replayed:
        """Summarise one policy's sessions, [D, n] and so on, from beta and amplitudes [H, D, n]."""
        settings, late = self.buffer.settings, actions[-LATE_STEPS:]
        returns = np.tensordot(settings.gamma ** np.arange(len(betas)), step_reward(settings, betas, actions), 1)
        of = end.each if end.draws else end.predict
        predicted = of(by_minute(np.moveaxis(betas, 0, -1), np.moveaxis(actions, 0, -1), settings), end.sessions)
        outcomes = end.carried(predicted, outcome_table(self.buffer), seen)
        return Replayed(
            step_return=returns,
            outcomes=outcomes,
            energy=(actions**2).mean(0),
            amplitude=actions.mean(0),
            beta=betas.mean(0),
            above=(betas >= settings.xi_beta).mean(0),
            late=late.mean(0),
            switching=np.abs(np.diff(actions, axis=0)).mean(0),
            off=(actions < NEARLY_OFF).mean(0),
            from_cdbs=np.abs(actions - 1.0).mean(0),
            sample=np.moveaxis(actions[:: max(1, len(actions) // 50), 0], 0, -1),
        )

    def _returns(self, replayed: Replayed) -> Floats:
        return replayed.step_return + (replayed.outcomes[..., 0] if self.end.seen[0] else 0.0)

    def _estimate(
        self,
        i: int,
        policy: Policy,
        main: Replayed,
        spread: Replayed,
        days: MeanOverDays,
        support: AmplitudeSupport,
        horizon: int,
        measured: Floats | None,
    ) -> Estimate:
        weights = days.weights
        with_end = self.end.seen[0]
        step = float(main.step_return[i].mean(0) @ weights)
        end = float(main.outcomes[i, :, :, 0].mean(0) @ weights) if with_end else None
        value = step + (end or 0.0)
        model = self._returns(spread)[i] @ weights
        model = model - model.mean()
        # Every pair of a draw of the model and a draw of the days counts. What is common to all policies widens the interval, but is no
        # part of the kept draws.
        interval = percentile_interval(np.add.outer(model, days.common + days.own[i]).ravel() + value, LEVEL)
        logged, simulated = support.of_policy(policy), support.look(main.sample[i])
        flags = list(flags_of(logged, simulated))
        if not with_end:
            flags.append(FEW_END_REWARDS)
        flags += [days.unknown] if days.unknown else []
        if measured is not None and end is not None:
            flags.append(stopped_sessions(sum(s.stopped for s in self.buffer.sessions), end, float(measured[i] @ weights)))
        predicted = {
            "energy": float(main.energy[i].mean(0) @ weights),
            "mean_amplitude": float(main.amplitude[i].mean(0) @ weights),
            "mean_beta": float(main.beta[i].mean(0) @ weights),
        }
        for j, name in enumerate(OUTCOMES):
            if name != "r_end" and self.end.seen[j]:
                predicted[name] = float(main.outcomes[i, :, :, j].mean(0) @ weights)
        return Estimate(
            method=self.method,
            value=value,
            low=interval.low,
            high=interval.high,
            level=LEVEL,
            standard_error=interval.standard_error,
            step_return=step,
            end_reward=end,
            predicted=predicted,
            supported=logged.supported and simulated.supported,
            flags=tuple(flags),
            n=len(self.buffer.sessions),
            details={
                "horizon_steps": horizon,
                "largest_root": largest_root(self.main.phi),
                "level_shares": self.main.shares,
                "coverage": logged.to_json(),
                "coverage_simulated": simulated.to_json(),
                "held_out": self._held_out(),
                "draws": [round(float(v), 4) for v in value + model + days.own[i]],
            },
        )

    def _held_out(self) -> dict[str, Any]:
        with_end = self.end.seen[0]
        return {
            "replay_skill": self.skill,
            "end_skill": float(self.end.by_session.skill[0]) if with_end else None,
            "outcomes": self.end.predictability(),
            "sessions": len(self.buffer.sessions),
        }


def build(key: str, seed: int, size: Size) -> LinearModel:
    """Build the estimator at a size of `ml.ope.registry`."""
    return LinearModel(LinearConfig(seed=seed, draws=20) if size == "held_out" else LinearConfig(seed=seed), key)
