"""Importance sampling in log space: per trajectory and per decision, plain and self-normalised. Source: Precup, Sutton and Singh 2000.

The density of the random controller is known, 1 / (1 - B) on [B, 1]; that of the others is estimated. A deterministic target is given a
Gaussian kernel truncated to [0, 1]. Its bandwidth follows a stated rule and is written in every estimate. Weights at T = 300 rest on a
session or two whatever is done: these are baselines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, cast

import numpy as np
import scipy
from numpy.typing import NDArray

from ml.ope.behaviour import Key, clones, controller_key, rule_of_thumb_bandwidth
from ml.ope.estimate import LEVEL, Estimate, checked_horizon
from ml.ope.flags import Flag
from ml.ope.holds import Abstention, abstention, held_log_ratios
from ml.ope.holds import flags as hold_flags
from ml.ope.registry import Size
from ml.ope.support.coverage import FEW_EFFECTIVE, AmplitudeSupport, effective_sample_size, few_effective
from ml.policies.policy import Policy
from ml.progress import Report, silent
from ml.returns import step_returns
from ml.statistics.bootstrap import bca_interval, percentile_interval, resampled, resamples
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Weighting = Literal["is", "wis", "pdis", "cwpdis"]
WEIGHTINGS = ("is", "wis", "pdis", "cwpdis")

LARGEST_LOG = 690.0
"""exp of this is a finite float; ordinary importance sampling may ask for more."""


def per_trajectory(log_ratio: Floats, mask: Mask, rewards: Floats, end: Floats, gamma: float) -> tuple[Floats, Floats]:
    """Log weights of whole trajectories and their returns.

    Args:
        log_ratio: log pi(a_t | s_t) - log mu(a_t | s_t), [N, T]; may be -inf. mask: steps that count, [N, T].
        rewards: r_t, [N, T]. end: r_end, [N], added undiscounted; NaN where it was not measured (the return is then NaN).
        gamma: discount per step.

    Returns:
        Log weights [N] and returns [N]: discounted sums over the steps that count, rescaled to the whole horizon of T steps.
    """
    return np.where(mask, log_ratio, 0.0).sum(1), step_returns(rewards, mask, gamma)[0] + end


def ordinary(log_weights: Floats, returns: Floats) -> float:
    """Average weight x return, [N]: unbiased, and of enormous variance over long horizons. Finite at any length."""
    return float(_signed_exp(log_weights, returns).mean()) if returns.size else 0.0


def weighted(log_weights: Floats, returns: Floats) -> float:
    """Average returns by normalised weights, [N]; the plain mean where every weight is zero."""
    top = log_weights.max()
    weights = np.exp(log_weights - top) if np.isfinite(top) else np.ones_like(log_weights)
    return float(weights @ returns / weights.sum())


def per_decision_terms(log_ratio: Floats, mask: Mask, rewards: Floats, gamma: float) -> Floats:
    """Compute per-decision contributions of each session, [N]: sum over t of gamma^t (product of ratios up to t) r_t, finite at any length.

    A step that does not count (unusable, or after a short session's end) takes the mean contribution of the sessions that have it.
    """
    cumulative = np.cumsum(np.where(mask, log_ratio, 0.0), axis=1)
    discount = gamma ** np.arange(rewards.shape[1])
    terms = _signed_exp(cumulative, np.where(mask, rewards, 0.0)) * discount
    counted = mask.sum(0)
    means = np.where(mask, terms, 0.0).sum(0) / np.maximum(counted, 1)
    return np.asarray(np.where(mask, terms, means).sum(1), dtype=np.float64)


def consistent_weighted_per_decision(log_ratio: Floats, mask: Mask, rewards: Floats, gamma: float) -> float:
    """Compute the self-normalised per-decision estimate (Thomas 2015): at each step the weighted mean reward of the sessions that have the
    step.

    A step that no session has takes the mean reward of the others; one at which every weight is zero takes its plain mean.
    """
    cumulative = np.where(mask, np.cumsum(np.where(mask, log_ratio, 0.0), axis=1), -np.inf)
    top = cumulative.max(0)
    weights = np.where(np.isfinite(top), np.exp(cumulative - np.where(np.isfinite(top), top, 0.0)), mask)
    total = weights.sum(0)
    reward = (weights * np.where(mask, rewards, 0.0)).sum(0) / np.maximum(total, 1e-300)
    counted = total > 0
    if not counted.any():
        return 0.0
    discount = gamma ** np.arange(rewards.shape[1])
    return float(np.where(counted, reward, reward[counted].mean()) @ discount)


def kernel_log_density(amplitude: Floats, centre: Floats, bandwidth: float) -> Floats:
    """Log density at `amplitude` of a Gaussian around `centre` truncated to [0, 1], elementwise (broadcasting)."""
    inside = scipy.stats.norm.cdf((1 - centre) / bandwidth) - scipy.stats.norm.cdf(-centre / bandwidth)
    density = scipy.stats.norm.logpdf((amplitude - centre) / bandwidth) - np.log(bandwidth) - np.log(inside)
    return np.asarray(np.where((amplitude >= 0) & (amplitude <= 1), density, -np.inf), dtype=np.float64)


def behaviour_log_density(session: SessionTrajectory, bandwidth: float, cloned: tuple[Policy, float] | None = None) -> Floats:
    """Log density of the logged amplitudes of a session, [T]; NaN where unusable.

    Random sessions drawn at every step: uniform on [B, 1]. Sustained draws: 0 here, their holds have the densities (`ml.ope.holds`).
    Others: a kernel around `cloned`, the controller's action at the window and the spread around it. It is at least as wide as the one that
    smooths the target. So a target that acts alike has the ratio 1, and no ratio grows without end.

    Raises:
        ValueError: neither a known density nor a clone.
    """
    usable = session.usable()
    a = np.clip(session.amplitude, 0.0, 1.0)
    result = np.full(session.steps, np.nan)
    if not usable.any():
        return result
    if session.uniform_bound is not None:
        result[usable] = -np.log(1 - session.uniform_bound)
        return result
    if session.holds:
        result[usable] = 0.0
        return result
    if cloned is None:
        raise ValueError(f"session {session.session_id} has no known density, and none was estimated")
    policy, spread = cloned
    result[usable] = kernel_log_density(a[usable], policy.act(session.states()[:-1][usable]), max(bandwidth, spread))
    return result


def behaviour_densities(buffer: ReplayBuffer, bandwidth: float | None, seed: int) -> tuple[list[Floats], float]:
    """Compute `behaviour_log_density` of every session, with clones where needed, and the bandwidth, by its rule where None is given."""
    width = rule_of_thumb_bandwidth(buffer) if bandwidth is None else bandwidth
    cloned: dict[Key, tuple[Policy, float]] = clones(buffer, seed)
    return [behaviour_log_density(s, width, cloned.get(controller_key(s))) for s in buffer.sessions], width


def session_log_ratios(session: SessionTrajectory, steps: NDArray[np.int64], target: Floats, density: Floats, bandwidth: float) -> Floats:
    """Log ratios of a session's usable steps, [k]; -inf at the first one where the session cannot be weighed for this policy.

    Args:
        session: whose amplitudes. steps: usable steps, rising, [k]. target: what the policy does there, [k].
        density: log density of the logged amplitudes, [k]. bandwidth: of the kernel around the target.
    """
    if not session.holds:
        return kernel_log_density(np.clip(session.amplitude[steps], 0, 1), target, bandwidth) - density
    if abstention(session, steps, target, bandwidth) is None:
        return held_log_ratios(session, steps, target, partial(kernel_log_density, bandwidth=bandwidth))
    nothing = np.zeros(len(steps))
    nothing[:1] = -np.inf
    return nothing


@dataclass(frozen=True)
class ImportanceSampling:
    """The estimator; `method` is one of `WEIGHTINGS`.

    Attributes:
        method: `is` per trajectory, `wis` per trajectory and self-normalised, `pdis` per decision, `cwpdis` per decision and
            self-normalised.
        bandwidth: of the kernel around pi(s), as a fraction of the cDBS amplitude; None takes `rule_of_thumb_bandwidth`.
        only_random: use only sessions whose density is known.
        draws: bootstrap resamples of sessions. seed: of the resamples.
    """

    method: Weighting = "pdis"
    bandwidth: float | None = None
    only_random: bool = False
    draws: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        if self.method not in WEIGHTINGS:
            raise ValueError(f"importance sampling is one of {', '.join(WEIGHTINGS)}, not {self.method}")
        if self.bandwidth is not None and not self.bandwidth > 0:
            raise ValueError(f"the kernel's bandwidth must be above 0, not {self.bandwidth}")

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedImportance:
        """Collect the behaviour densities; takes seconds, so nothing is kept in `checkpoint_dir`.

        Raises:
            ValueError: no session is left to weigh.
        """
        kept = [s for s in buffer.sessions if s.usable().any() and not (self.only_random and not _known_density(s))]
        if not kept:
            raise ValueError("importance sampling has no session to weigh: none has a usable step with a behaviour density")
        every, bandwidth = behaviour_densities(buffer, self.bandwidth, self.seed)
        densities = [d for d, s in zip(every, buffer.sessions, strict=True) if any(s is k for k in kept)]
        report(1.0, "densities of the logged amplitudes")
        return FittedImportance(self, buffer, tuple(kept), tuple(densities), bandwidth)


@dataclass(frozen=True)
class FittedImportance:
    """Sessions and the densities of their logged amplitudes."""

    settings: ImportanceSampling
    buffer: ReplayBuffer
    sessions: tuple[SessionTrajectory, ...]
    densities: tuple[Floats, ...]
    bandwidth: float

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Estimate every policy; all share the resamples of sessions."""
        horizon = checked_horizon(self.buffer, horizon_steps)
        support = AmplitudeSupport(self.buffer)
        estimates = {}
        for k, (name, policy) in enumerate(policies.items()):
            estimates[name] = self._estimate(policy, horizon, support)
            report((k + 1) / len(policies), "weighing sessions")
        return estimates

    def log_ratios(self, policy: Policy, horizon: int) -> tuple[Floats, Mask, Floats]:
        """Log ratios, the mask of usable steps, and rewards, [N, H] each; -inf at the first step of a session that cannot be weighed."""
        n = len(self.sessions)
        log_ratio, rewards, mask = np.zeros((n, horizon)), np.zeros((n, horizon)), np.zeros((n, horizon), dtype=bool)
        for i, (s, density) in enumerate(zip(self.sessions, self.densities, strict=True)):
            k = np.flatnonzero(s.usable())
            k = k[k < horizon]
            if k.size:
                log_ratio[i, k] = session_log_ratios(s, k, policy.act(s.states()[k]), density[k], self.bandwidth)
                rewards[i, k] = s.rewards(self.buffer.settings)[k]
                mask[i, k] = True
        return log_ratio, mask, rewards

    def _abstentions(self, policy: Policy, horizon: int) -> tuple[Flag, ...]:
        """Flag the sessions of sustained draws that this policy cannot be weighed in."""
        reasons: list[Abstention | None] = []
        for s in self.sessions:
            k = np.flatnonzero(s.usable()[:horizon])
            reasons.append(abstention(s, k, policy.act(s.states()[k]), self.bandwidth) if s.holds and k.size else None)
        weighed = any(reason is None and _known_density(s) for reason, s in zip(reasons, self.sessions, strict=True))
        return hold_flags(reasons, others=weighed)

    def _estimate(self, policy: Policy, horizon: int, support: AmplitudeSupport) -> Estimate:
        config, gamma = self.settings, self.buffer.settings.gamma
        log_ratio, mask, rewards = self.log_ratios(policy, horizon)
        measured = [s.end_reward(self.buffer.settings) for s in self.sessions]
        end = np.array([np.nan if v is None else v for v in measured], dtype=np.float64)
        log_weights, step_returns = per_trajectory(log_ratio, mask, rewards, np.zeros(len(end)), gamma)
        decisions = per_decision_terms(log_ratio, mask, rewards, gamma)
        known = np.isfinite(end)

        def value(index: NDArray[np.int64]) -> tuple[float, float]:
            with_end = index[known[index]]
            average = weighted if config.method in ("wis", "cwpdis") else ordinary
            if config.method == "cwpdis":
                step = consistent_weighted_per_decision(log_ratio[index], mask[index], rewards[index], gamma)
            elif config.method == "pdis":
                step = float(decisions[index].mean())
            else:
                step = average(log_weights[index], step_returns[index])
            return step, average(log_weights[with_end], end[with_end]) if with_end.size else 0.0

        step, end_value = value(np.arange(len(end)))
        draws = np.array([sum(value(index)) for index in resamples(len(end), config.draws, config.seed)])
        interval = percentile_interval(draws, LEVEL)
        everyone = np.arange(len(end))
        jackknife = np.array([sum(value(np.delete(everyone, i))) for i in everyone]) if len(end) > 2 else np.empty(0)
        bca = bca_interval(draws, step + end_value, jackknife, LEVEL) if jackknife.size else None
        effective, largest = effective_sample_size(log_weights)
        logged = support.of_policy(policy)
        flags = list(logged.flags())
        if effective < FEW_EFFECTIVE:
            flags.append(few_effective("few_effective_sessions", effective, len(end), refuses=True))
        flags += self._abstentions(policy, horizon)
        if not known.any():
            flags.append(Flag.of("no_end_reward"))
        return Estimate(
            method=config.method,
            value=step + end_value,
            low=interval.low,
            high=interval.high,
            level=LEVEL,
            standard_error=interval.standard_error,
            step_return=step,
            end_reward=end_value if known.any() else None,
            predicted={},
            supported=logged.supported and effective >= FEW_EFFECTIVE and not any(f.refuses for f in flags),
            flags=tuple(flags),
            n=len(end),
            details={
                "horizon_steps": horizon,
                "bandwidth": self.bandwidth,
                "bandwidth_rule": "Silverman, sessions as sample size" if config.bandwidth is None else "given",
                "bca": None if bca is None else [bca.low, bca.high],
                "effective_sample_size": effective,
                "largest_weight_share": largest,
                "horizon_of_ten": horizon_of_ten(log_ratio, mask),
                "sessions_of_known_density": sum(_known_density(s) for s in self.sessions),
                "sessions_left_out": len(self.buffer.sessions) - len(self.sessions),
                "coverage": logged.to_json(),
                "draws": [float(d) for d in draws[:200]],
                "resampled": resampled(len(end), config.seed),
            },
        )


def _known_density(session: SessionTrajectory) -> bool:
    """Decide whether the session's amplitudes were drawn from a known density."""
    return session.uniform_bound is not None or any(h.log_density is not None for h in session.holds)


def _signed_exp(log_weights: Floats, values: Floats) -> Floats:
    """Compute exp(log_weights) x values as one exponent, so that it stays finite."""
    with np.errstate(divide="ignore"):
        logs = log_weights + np.log(np.abs(values))
    return np.asarray(np.sign(values) * np.exp(np.minimum(logs, LARGEST_LOG)), dtype=np.float64)


def horizon_of_ten(log_ratio: Floats, mask: Mask) -> int:
    """Count the steps until the effective sample size of the running weights first falls below ten."""
    cumulative = np.cumsum(np.where(mask, log_ratio, 0.0), axis=1)
    for t in range(cumulative.shape[1]):
        if effective_sample_size(cumulative[:, t])[0] < FEW_EFFECTIVE:
            return t
    return int(cumulative.shape[1])


def build(key: str, seed: int, size: Size) -> ImportanceSampling:
    """Build the estimator at a size of `ml.ope.registry`."""
    return ImportanceSampling(cast(Weighting, key), draws=100 if size == "held_out" else 1000, seed=seed)
