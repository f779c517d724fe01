"""Off-policy evaluation by the deep latent sequential model (DLSM). Source: Gao et al. 2023, section 5.

An ensemble of models is trained on the sessions, each with some sessions left out; every policy is rolled out in each of them. What
the interval holds: the spread of the ensemble, the error of the level measured on held-out sessions, and Monte-Carlo error.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from ml.ope.batches import Batch, Scale, learn_scale, make_batch, session_folds
from ml.ope.coverage import AmplitudeSupport, Coverage
from ml.ope.dlsm_config import DlsmConfig
from ml.ope.dlsm_held_out import HeldOut
from ml.ope.dlsm_rollout import Rollouts, roll_out
from ml.ope.dlsm_training import Member, MemberTraining
from ml.ope.estimate import LEVEL, OUTCOMES, Estimate, checked_horizon
from ml.progress import Report, part_of, silent
from ml.rl.policy import Policy
from ml.trajectories import ReplayBuffer, content_hash, to_parquet

Floats = NDArray[np.float64]

FEWEST_SESSIONS = 4
DRAWS = 200
"""Draws of an estimate kept for the probability of being best."""


@dataclass(frozen=True)
class _Data:
    """A buffer as the members learn from it: tensors, standardisation, held-out groups of sessions, and its name with the settings."""

    buffer: ReplayBuffer
    batch: Batch
    scale: Scale
    folds: list[list[int]]
    fingerprint: str


@dataclass(frozen=True)
class Dlsm:
    """The estimator; `fit` trains the ensemble."""

    config: DlsmConfig = field(default_factory=DlsmConfig)
    method: str = "dlsm"

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedDlsm:
        """Train every member; members that a checkpoint in `checkpoint_dir` calls finished are not trained again.

        Raises:
            ValueError: fewer than four sessions, no usable step, or a checkpoint of another buffer or other settings.
        """
        c = self.config
        data = self._prepare(buffer)
        members = tuple(self._train(data, k, part_of(report, k, c.members), checkpoint_dir) for k in range(c.members))
        return FittedDlsm(self.method, c, buffer, data.batch, data.scale, members)

    def fit_member(self, buffer: ReplayBuffer, k: int, report: Report = silent, checkpoint_dir: Path | None = None) -> Member:
        """Train member `k` alone, for ensembles whose members learn side by side: `fit` finds its checkpoint finished.

        Raises:
            ValueError: as `fit`, or no such member.
        """
        if not 0 <= k < self.config.members:
            raise ValueError(f"this ensemble has members 0 to {self.config.members - 1}, not {k}")
        return self._train(self._prepare(buffer), k, report, checkpoint_dir)

    def _prepare(self, buffer: ReplayBuffer) -> _Data:
        n, c = len(buffer.sessions), self.config
        if n < FEWEST_SESSIONS:
            raise ValueError(f"the DLSM needs at least {FEWEST_SESSIONS} sessions, of which it holds some out; the buffer has {n}")
        scale = learn_scale(buffer)
        folds = session_folds(buffer.sessions, max(2, round(1 / c.held_out)), c.seed)
        named = content_hash(to_parquet(buffer)) + json.dumps(c.to_json(), sort_keys=True)
        return _Data(buffer, make_batch(buffer, scale), scale, folds, hashlib.sha256(named.encode()).hexdigest())

    def _train(self, data: _Data, k: int, report: Report, checkpoint_dir: Path | None) -> Member:
        held = data.folds[k % len(data.folds)]
        training = MemberTraining(data.buffer, data.batch, data.scale, held, self.config, self.config.seed + k, data.fingerprint)
        return training.run(None if checkpoint_dir is None else checkpoint_dir / f"dlsm-member-{k}.pt", report)


@dataclass(frozen=True)
class FittedDlsm:
    """A trained ensemble and the buffer it came from."""

    method: str
    config: DlsmConfig
    buffer: ReplayBuffer
    batch: Batch
    scale: Scale
    members: tuple[Member, ...]

    @property
    def checks(self) -> tuple[HeldOut, ...]:
        """Held-out check of every member."""
        return tuple(m.check for m in self.members)

    @property
    def reward_source(self) -> str:
        """`head` or `known`: what the step return is read from, by the held-out sessions unless the settings say."""
        if self.config.reward_source != "held_out":
            return self.config.reward_source
        head, known = (sum(getattr(c, name) for c in self.checks) for name in ("error_head", "error_known"))
        return "head" if head < known else "known"

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Roll every policy out in every member and join what they say."""
        horizon = checked_horizon(self.buffer, horizon_steps)
        if not policies:
            return {}
        runs = [
            self._run(m, policies, horizon, k, prior=False, report=part_of(report, k, len(self.members)))
            for k, m in enumerate(self.members)
        ]
        others = [self._run(m, policies, horizon, k, prior=True, report=silent) for k, m in enumerate(self.members)]
        main, second = (others, runs) if self.config.start == "prior" else (runs, others)
        support = AmplitudeSupport(self.buffer)
        parts = [self._parts(run) for run in main]
        values = np.stack([step + end for step, end in parts])  # [members, P]
        draws, errors = self._uncertainty(values, main)
        coverage = [self._coverage(support, policy, main, i) for i, policy in enumerate(policies.values())]
        return {
            name: self._estimate(i, main, second, parts, values, draws[:, i], float(errors[i]), coverage[i], horizon)
            for i, name in enumerate(policies)
        }

    def _run(self, member: Member, policies: Mapping[str, Policy], horizon: int, k: int, *, prior: bool, report: Report) -> Rollouts:
        """Roll-outs of one member; those of the start that is only reported beside the estimate are fewer."""
        per_policy = self.config.rollouts
        if prior != (self.config.start == "prior"):
            per_policy = max(16, per_policy // 8)
        return roll_out(
            member.networks,
            list(policies.values()),
            self.batch.states[0].numpy().astype(np.float64),
            scale=self.scale,
            settings=self.buffer.settings,
            horizon=horizon,
            per_policy=per_policy,
            seed=self.config.seed + 1000 + k,
            prior=prior,
            report=report,
        )

    def _parts(self, run: Rollouts) -> tuple[Floats, Floats]:
        """Step return and r_end per policy, [P] each; r_end is 0 where the buffer has none."""
        step = run.return_head if self.reward_source == "head" else run.return_known
        end = run.outcomes[:, :, 0] if self.scale.outcome_seen[0] else np.zeros_like(step)
        return step.mean(1), end.mean(1)

    def _uncertainty(self, values: Floats, runs: list[Rollouts]) -> tuple[Floats, Floats]:
        """Draws around the values, [DRAWS, P], and standard errors, [P].

        Spread of the ensemble (correlated over policies), error of the level from held-out sessions (common to all policies),
        Monte-Carlo error (of each policy).
        """
        rng = np.random.default_rng(self.config.seed + 2000)
        members, p = values.shape
        centred = values - values.mean(0)
        spread = rng.standard_normal((DRAWS, members)) @ centred / np.sqrt(max(1, members - 1))
        level = self.level_error()
        monte_carlo = np.sqrt(np.mean([self._returns(r).var(1) / r.energy.shape[1] for r in runs], axis=0) / members)
        draws = values.mean(0) + spread + level * rng.standard_normal((DRAWS, 1)) + monte_carlo * rng.standard_normal((DRAWS, p))
        variance = (centred**2).sum(0) / max(1, members - 1) + level**2 + monte_carlo**2
        return draws, np.sqrt(variance)

    def _returns(self, run: Rollouts) -> Floats:
        step = run.return_head if self.reward_source == "head" else run.return_known
        return step + (run.outcomes[:, :, 0] if self.scale.outcome_seen[0] else 0.0)

    def level_error(self) -> float:
        """Standard error of the mean held-out residual of the return: how far the level of all estimates may be off."""
        name = f"residual_{self.reward_source}"
        total = 0.0
        for parts in ([getattr(c, name) for c in self.checks], [c.residual_end for c in self.checks]):
            residuals = np.concatenate([np.asarray(r) for r in parts])
            if residuals.size > 1:
                # Around zero, not around their mean: a bias found on held-out sessions widens the interval.
                total += float(np.mean(residuals**2)) / min(residuals.size, len(self.buffer.sessions))
        return float(np.sqrt(total))

    def _coverage(self, support: AmplitudeSupport, policy: Policy, runs: list[Rollouts], i: int) -> tuple[Coverage, Coverage]:
        return support.of_policy(policy), support.look(np.concatenate([run.actions[i] for run in runs]))

    def _estimate(
        self,
        i: int,
        runs: list[Rollouts],
        others: list[Rollouts],
        parts: list[tuple[Floats, Floats]],
        values: Floats,
        draws: Floats,
        error: float,
        coverage: tuple[Coverage, Coverage],
        horizon: int,
    ) -> Estimate:
        value = float(values[:, i].mean())
        reach = float(norm.ppf((1 + LEVEL) / 2)) * error
        seen = self.scale.outcome_seen
        logged, simulated = coverage
        flags = list(dict.fromkeys((*logged.flags, *(() if logged.flags else simulated.flags))))
        if not seen[0]:
            flags.append("fewer than three sessions have an end-of-session reward: the estimate is the step return alone")
        other_step, other_end = zip(*(self._parts(run) for run in others), strict=True)
        return Estimate(
            method=self.method,
            value=value,
            low=value - reach,
            high=value + reach,
            level=LEVEL,
            standard_error=error,
            step_return=float(np.mean([step[i] for step, _ in parts])),
            end_reward=float(np.mean([end[i] for _, end in parts])) if seen[0] else None,
            predicted=self._predicted(runs, i),
            supported=logged.supported and simulated.supported,
            flags=tuple(flags),
            n=sum(run.energy.shape[1] for run in runs),
            details={
                "horizon_steps": horizon,
                "start": self.config.start,
                "value_from_other_start": float(np.mean(other_step, axis=0)[i] + np.mean(other_end, axis=0)[i]),
                "reward_source": self.reward_source,
                "step_return_head": float(np.mean([run.return_head[i].mean() for run in runs])),
                "step_return_known": float(np.mean([run.return_known[i].mean() for run in runs])),
                "members": [float(v) for v in values[:, i]],
                "level_error": self.level_error(),
                "coverage": logged.to_json(),
                "coverage_simulated": simulated.to_json(),
                "held_out": held_out_skill(self.checks, self.scale, self.reward_source),
                "objective": self.config.objective,
                "draws": [round(float(d), 4) for d in draws],
            },
        )

    def _predicted(self, runs: list[Rollouts], i: int) -> dict[str, float]:
        predicted = {
            "energy": float(np.mean([run.energy[i].mean() for run in runs])),
            "mean_amplitude": float(np.mean([run.amplitude[i].mean() for run in runs])),
            "mean_beta": float(np.mean([run.beta[i].mean() for run in runs])),
        }
        ranges = {"grasp_hz": (0.0, np.inf), "rating": (1.0, 10.0), "tremor_percent": (0.0, 100.0)}
        for j, name in enumerate(OUTCOMES):
            if name in ranges and self.scale.outcome_seen[j]:
                predicted[name] = float(np.mean([np.clip(run.outcomes[i, :, j], *ranges[name]).mean() for run in runs]))
        return predicted


def held_out_skill(checks: tuple[HeldOut, ...], scale: Scale, source: str) -> dict[str, Any]:
    """Held-out free-running skill, averaged over members: 1 is perfect, 0 no better than the sessions' mean."""
    error = float(np.mean([getattr(c, f"error_{source}") for c in checks]))
    ends = [c.outcome_error[0] for c in checks if c.outcome_error[0] is not None]
    return {
        "reward_error": error,
        "reward_skill": 1 - error / scale.reward_std**2,
        "beta_nll": float(np.mean([c.beta_nll for c in checks])),
        "end_skill": 1 - float(np.mean(ends)) if ends else None,
        "sessions": len({i for c in checks for i in c.sessions}),
    }
