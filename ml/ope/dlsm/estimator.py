"""Off-policy evaluation by the deep latent sequential model (DLSM). Source: Gao et al. 2023, section 5.

An ensemble of models is trained on the sessions, each with some sessions held out; every policy is rolled out in each of them. What the
interval holds: the spread of the ensemble, the error of the level measured on held-out sessions, and Monte-Carlo error.
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
from scipy.special import ndtri

from ml.ope.behaviour import controller_key
from ml.ope.dlsm.batches import Batch, make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.dose_answer import Judged, judge
from ml.ope.dlsm.folds import resampled, usable_folds
from ml.ope.dlsm.held_out import FreeRuns, shares
from ml.ope.dlsm.rollout import Rollouts, roll_out
from ml.ope.dlsm.training import Member, MemberTraining
from ml.ope.estimate import LEVEL, Estimate, checked_horizon
from ml.ope.flags import FEW_END_REWARDS, Flag
from ml.ope.observed import day_noise
from ml.ope.outcomes.minutes import Minutes
from ml.ope.outcomes.model import EndModel, fit_end_model
from ml.ope.registry import Size
from ml.ope.scale import Scale, learn_scale
from ml.ope.support.coverage import AmplitudeSupport, Coverage, flags_of
from ml.outcomes import PREDICTED
from ml.policies.policy import Policy
from ml.progress import Report, part_of, silent
from ml.trajectories import ReplayBuffer, content_hash, to_parquet

Floats = NDArray[np.float64]

CHECKPOINT = 2
"""Raised when the state of a training means something else: checkpoints of another number are refused."""

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

    @property
    def successive_members(self) -> int:
        """Members that learn one after the other in `fit`."""
        return self.config.members

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedDlsm:
        """Train every member; what a checkpoint in `checkpoint_dir` calls finished is not trained again.

        Raises:
            ValueError: fewer than four sessions, no usable step, or a checkpoint of another buffer or other settings. So many members are
                discarded for their answer to a lasting dose that no spread is left.
        """
        data = self._prepare(buffer)
        c = self.config
        members = tuple(self._train(data, k, part_of(report, k, c.members), checkpoint_dir) for k in range(c.members))
        judged = judge([m.networks for m in members], data.batch, c.seed) if c.discard else None
        if judged is not None:
            members = tuple(m for k, m in enumerate(members) if k not in judged.discarded)
            if len(members) < min(2, c.members):
                raise ValueError(judged.sentence())
        return FittedDlsm(self.method, c, buffer, data.batch, data.scale, members, fit_end_model(buffer), judged)

    def fit_member(self, buffer: ReplayBuffer, k: int, report: Report = silent, checkpoint_dir: Path | None = None) -> Member:
        """Train member `k` alone, for ensembles whose members learn side by side: `fit` finds its checkpoint finished.

        Raises:
            ValueError: as `fit`, or no such member.
        """
        if not 0 <= k < self.config.members:
            raise ValueError(f"this ensemble has members 0 to {self.config.members - 1}, not {k}")
        return self._train(self._prepare(buffer), k, report, checkpoint_dir)

    def _prepare(self, buffer: ReplayBuffer) -> _Data:
        n, c = sum(bool(s.usable().any()) for s in buffer.sessions), self.config
        if n < FEWEST_SESSIONS:
            raise ValueError(f"the DLSM needs at least {FEWEST_SESSIONS} sessions with usable steps and holds some out; the buffer has {n}")
        scale = learn_scale(buffer)
        folds = usable_folds(buffer, c.held_out, c.seed)
        named = f"{CHECKPOINT}{content_hash(to_parquet(buffer))}{json.dumps(c.to_json(), sort_keys=True)}"
        return _Data(buffer, make_batch(buffer, scale), scale, folds, hashlib.sha256(named.encode()).hexdigest())

    def _train(self, data: _Data, k: int, report: Report, checkpoint_dir: Path | None) -> Member:
        config = self.config
        held, learnt = data.folds[k % len(data.folds)], None
        if config.bootstrap:
            learnt, held = resampled(data.buffer, config.seed + k)
        training = MemberTraining(data.buffer, data.batch, data.scale, held, config, config.seed + k, data.fingerprint, learnt=learnt)
        return training.run(None if checkpoint_dir is None else checkpoint_dir / f"dlsm-member-{k}.pt", report)


@dataclass(frozen=True)
class FittedDlsm:
    """A trained ensemble and the buffer it came from.

    `members` are those that `judged` left in; it is None where the settings ask for no judgement.
    """

    method: str
    config: DlsmConfig
    buffer: ReplayBuffer
    batch: Batch
    scale: Scale
    members: tuple[Member, ...]
    end: EndModel
    judged: Judged | None = None

    @property
    def checks(self) -> tuple[FreeRuns, ...]:
        """Held-out check of every member."""
        return tuple(m.check for m in self.members)

    @property
    def reward_source(self) -> str:
        """`head` or `known`: what the step return is read from, by the held-out sessions unless the settings say."""
        if not self.config.reward_terms:
            return "known"
        if self.config.reward_source != "held_out":
            return self.config.reward_source
        head, known = (sum(getattr(c, name) for c in self.checks) for name in ("error_head", "error_known"))
        return "head" if head < known else "known"

    @property
    def end_source(self) -> str:
        """`latent` or `summaries`: what r_end and the QoCs are read from, by r_end of left-out sessions unless the settings say."""
        if self.config.end_source != "held_out":
            return self.config.end_source
        residuals = np.concatenate([np.asarray(c.residual_end) for c in self.checks])
        if not residuals.size or not self.end.seen[0]:
            return "latent"
        return "latent" if float(np.mean(residuals**2)) <= self.end.by_session.residual[0] ** 2 else "summaries"

    def held_out_skill(self) -> dict[str, Any]:
        """Compute the held-out free-running skill of the members together: 1 is perfect, 0 no better than the mean of the learnt sessions.

        `answer_skill` is that of the differences in mean beta between controllers, of sessions that some member did not learn from. None
        where these are of one controller.
        """
        sessions = {e.session for c in self.checks for e in c.errors}
        kinds = {k: controller_key(s) for k, s in enumerate(self.buffer.sessions)}
        found = shares([c.errors for c in self.checks], kinds)
        return {
            "beta_skill": 1 - found.beta,
            "reward_skill": 1 - (found.head if self.reward_source == "head" else found.known),
            "end_skill": None if found.outcomes is None else 1 - found.outcomes,
            "answer_skill": None if found.contrast is None else 1 - found.contrast,
            "score": found.score,
            "sessions": len(sessions),
        }

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
        draws, errors = self._uncertainty(values, main, horizon)
        coverage = [self._coverage(support, policy, main, i) for i, policy in enumerate(policies.values())]
        return {
            name: self._estimate(i, main, second, parts, values, draws[:, i], float(errors[i]), coverage[i], horizon)
            for i, name in enumerate(policies)
        }

    def _run(self, member: Member, policies: Mapping[str, Policy], horizon: int, k: int, *, prior: bool, report: Report) -> Rollouts:
        """Roll one member out; roll-outs from the start that is only reported next to the estimate are fewer."""
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
            before=None if member.networks.linear is None else member.networks.linear.before,
            report=report,
        )

    def _parts(self, run: Rollouts) -> tuple[Floats, Floats]:
        """Compute the step return and r_end per policy, [P] each; r_end is 0 where the buffer has none."""
        step = run.return_head if self.reward_source == "head" else run.return_known
        end = self._outcomes(run)[:, :, 0] if self.scale.outcome_seen[0] else np.zeros_like(step)
        return step.mean(1), end.mean(1)

    def _outcomes(self, run: Rollouts) -> Floats:
        """Compute r_end and QoCs of the simulated sessions, [P, M, 4]."""
        return run.outcomes if self.end_source == "latent" else self.end.predict(run.minutes)

    def _uncertainty(self, values: Floats, runs: list[Rollouts], horizon: int) -> tuple[Floats, Floats]:
        """Draw around the values, [DRAWS, P], and standard errors, [P].

        The spread of the ensemble and the coefficients of the outcome model, where it is used, are correlated over policies. The error of
        the level, from held-out sessions and from few days, is common to all policies. The Monte Carlo error is of each policy.
        """
        rng = np.random.default_rng(self.config.seed + 2000)
        members, p = values.shape
        centred = values - values.mean(0)
        spread = rng.standard_normal((DRAWS, members)) @ centred / np.sqrt(max(1, members - 1))
        monte_carlo = np.sqrt(np.mean([self._returns(r).var(1) / r.sessions for r in runs], axis=0) / members)
        ends = self._end_draws(runs)
        draws = values.mean(0) + spread + ends + monte_carlo * rng.standard_normal((DRAWS, p))
        common = self.level_error() ** 2 + float(day_noise(self.buffer, horizon, DRAWS, self.config.seed)[0].var())
        draws = draws + np.sqrt(common) * rng.standard_normal((DRAWS, 1))
        variance = (centred**2).sum(0) / max(1, members - 1) + ends.var(0) + common + monte_carlo**2
        return draws, np.sqrt(variance)

    def _end_draws(self, runs: list[Rollouts]) -> Floats:
        """Draw the errors of r_end's differences between policies by the outcome model, [DRAWS, P]; its level is in `level_error`."""
        if self.end_source == "latent" or not self.scale.outcome_seen[0]:
            return np.zeros((DRAWS, runs[0].outcomes.shape[0]))
        drawn = fit_end_model(self.buffer, draws=DRAWS, seed=self.config.seed)
        # Of the mean minutes of each policy: what its sessions have in common moves its mean.
        means = np.mean([r.minutes.features.mean(1) for r in runs], axis=0)
        minutes = Minutes(means[None], runs[0].minutes.share[None, :, 0], runs[0].minutes.late[None, :, 0])
        ends = drawn.each(minutes)[:, :, 0]
        ends = ends - ends.mean(1, keepdims=True)
        return np.asarray(ends - ends.mean(0), dtype=np.float64)

    def _returns(self, run: Rollouts) -> Floats:
        step = run.return_head if self.reward_source == "head" else run.return_known
        return step + (self._outcomes(run)[:, :, 0] if self.scale.outcome_seen[0] else 0.0)

    def level_error(self) -> float:
        """Compute the standard error of the mean held-out residual of the return: how far the level of all estimates may be off."""
        name = f"residual_{self.reward_source}"
        residuals = [np.concatenate([np.asarray(getattr(c, name)) for c in self.checks])]
        total = 0.0
        if self.end_source == "summaries":
            total = float(self.end.by_session.residual[0]) ** 2 / len(self.buffer.sessions)
        else:
            residuals.append(np.concatenate([np.asarray(c.residual_end) for c in self.checks]))
        for found in residuals:
            if found.size > 1:
                # Around zero, not around their mean: a bias found on held-out sessions widens the interval.
                total += float(np.mean(found**2)) / min(found.size, len(self.buffer.sessions))
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
        reach = float(ndtri((1 + LEVEL) / 2)) * error
        seen = self.scale.outcome_seen
        logged, simulated = coverage
        flags = list(flags_of(logged, simulated))
        if not seen[0]:
            flags.append(FEW_END_REWARDS)
        flags += [unknown] if (unknown := day_noise(self.buffer, horizon, 1, 0)[1]) else []
        skill = self.held_out_skill()
        flags += _warnings(skill)
        if self.judged is not None and self.judged.discarded:
            flags.append(Flag("members_discarded", float(len(self.judged.discarded)), float(len(self.judged.members)), "members"))
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
            n=sum(run.sessions for run in runs),
            details={
                "horizon_steps": horizon,
                "start": self.config.start,
                "value_from_other_start": float(np.mean(other_step, axis=0)[i] + np.mean(other_end, axis=0)[i]),
                "reward_source": self.reward_source,
                "end_source": self.end_source,
                "step_return_head": float(np.mean([run.return_head[i].mean() for run in runs])) if self.config.reward_terms else None,
                "step_return_known": float(np.mean([run.return_known[i].mean() for run in runs])),
                "members": [float(v) for v in values[:, i]],
                "dose_answer": None if self.judged is None else self.judged.to_json(),
                "level_error": self.level_error(),
                "coverage": logged.to_json(),
                "coverage_simulated": simulated.to_json(),
                "held_out": skill,
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
        for j, (outcome, _) in enumerate(PREDICTED, start=1):  # 0 is r_end
            if self.scale.outcome_seen[j]:
                values = [np.clip(self._outcomes(run)[i, :, j], *outcome.limits).mean() for run in runs]
                predicted[outcome.field] = float(np.mean(values))
        return predicted


def _warnings(skill: dict[str, Any]) -> list[Flag]:
    """List the flags that the held-out sessions raise against the model."""
    found = []
    if skill["score"] >= 1:
        found.append(Flag("no_better_than_mean", skill["score"], 1.0, "share"))
    if skill["answer_skill"] is not None and skill["answer_skill"] <= 0:
        found.append(Flag("no_answer_to_amplitude", skill["answer_skill"], 0.0, "skill"))
    return found


def build(key: str, seed: int, size: Size) -> Dlsm:
    """Build the estimator at a size of `ml.ope.registry`."""
    return Dlsm(DlsmConfig.expert(size, seed), key)


def build_paper(key: str, seed: int, size: Size) -> Dlsm:
    """Build the paper's plain form at a size of `ml.ope.registry`."""
    return Dlsm(DlsmConfig.paper(size, seed), key)
