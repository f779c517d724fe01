"""Weighted doubly robust estimation with fitted Q functions as control variates. Source: Thomas and Brunskill 2016, eq. 9.

The value function estimates what a policy is worth. Its error at each logged step is added, weighted by how likely the policy is to have
come there. Where the weights rest on few sessions the correction is their noise: read the effective sample size with the value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ml.ope.estimate import Estimate, checked_horizon
from ml.ope.fqe.estimator import FittedFqe, Fqe, FqeConfig, QMember, discounts, value_estimate, within_reach
from ml.ope.fqe.steps import TargetActions
from ml.ope.importance import behaviour_densities, horizon_of_ten, kernel_log_density, session_log_ratios
from ml.ope.outcomes.minutes import of_buffer
from ml.ope.registry import Size
from ml.ope.scale import outcome_table
from ml.ope.support.coverage import FEW_EFFECTIVE, AmplitudeSupport, effective_sample_size, few_effective
from ml.policies.policy import Policy
from ml.progress import Report, silent
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


def step_weights(log_ratio: Floats, mask: Mask) -> Floats:
    """Multiply ratios up to each step, normalised at each step among the sessions that have it, [N, H]; 0 elsewhere.

    Args:
        log_ratio: log pi - log mu, [N, H]; may be -inf. mask: steps that count, [N, H].
    """
    cumulative = np.where(mask, np.cumsum(np.where(mask, log_ratio, 0.0), axis=1), -np.inf)
    top = cumulative.max(0)
    some = np.isfinite(top)
    weights = np.where(some, np.exp(cumulative - np.where(some, top, 0.0)), mask)
    return np.asarray(weights / np.maximum(weights.sum(0), 1e-300), dtype=np.float64)


def weighted_doubly_robust(first: Floats, weights: Floats, errors: Floats, discount: float) -> float:
    """Add weighted temporal errors to first values: with no step missing, eq. 9 of Thomas and Brunskill with its sum telescoped.

    Args:
        first: V_H(s_0) of each session, [N]. weights: `step_weights`, [N, H].
        errors: r_t + discount V_{H-t-1}(s_{t+1}) - Q_{H-t}(s_t, a_t), [N, H]. discount: per step.
    """
    return float(first.mean() + ((weights * errors).sum(0) * discount ** np.arange(errors.shape[1])).sum())


@dataclass(frozen=True)
class DoublyRobust:
    """The estimator. `value` sets the value functions, `bandwidth` the kernel around pi(s) (None: `rule_of_thumb_bandwidth`)."""

    value: FqeConfig = field(default_factory=lambda: FqeConfig(refits=30))
    bandwidth: float | None = None
    method: str = "wdr"

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedDoublyRobust:
        """Fit features, penalties and behaviour densities; this takes seconds, so nothing is written to `checkpoint_dir`.

        Raises:
            ValueError: fewer than two sessions with usable steps, or no session with a complete s_0.
        """
        fitted = replace(Fqe(self.value).fit(buffer, report, checkpoint_dir), method=self.method)
        densities, bandwidth = behaviour_densities(buffer, self.bandwidth, self.value.seed)
        density = np.concatenate([d[s.usable()] for d, s in zip(densities, buffer.sessions, strict=True)])
        ends = outcome_table(buffer)[:, 0]
        end_errors = ends - fitted.end.predict(of_buffer(buffer), fitted.end.sessions)[:, 0]
        return FittedDoublyRobust(fitted, density, end_errors, bandwidth)


@dataclass(frozen=True)
class FittedDoublyRobust:
    """Value functions, densities of the logged amplitudes [N], and r_end less its prediction for each session [n]."""

    fqe: FittedFqe
    density: Floats
    end_errors: Floats
    bandwidth: float

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Estimate every policy; value functions and sessions are resampled together."""
        horizon = checked_horizon(self.fqe.buffer, horizon_steps)
        support = AmplitudeSupport(self.fqe.buffer)
        estimates = {}
        for k, (name, policy) in enumerate(policies.items()):
            estimates[name] = self._estimate(policy, horizon, support)
            report((k + 1) / len(policies), "correcting value functions")
        return estimates

    def _estimate(self, policy: Policy, horizon: int, support: AmplitudeSupport) -> Estimate:
        fqe, table = self.fqe, self.fqe.table
        target = TargetActions.of(table, policy)
        log_ratio, mask = self._log_ratios(target, horizon)
        views = [_View(m, fqe, target) for m in fqe.members]
        everything = np.arange(table.sessions)
        parts = [self._value(v, everything, log_ratio, mask, horizon) for v in views]
        main, shift = np.mean([p[0] for p in parts], axis=0), float(np.mean([p[1] for p in parts]))
        redrawn = [self._value(views[d % len(views)], pick, log_ratio, mask, horizon) for d, pick in enumerate(fqe.draws)]
        effective, largest = effective_sample_size(np.where(mask, log_ratio, 0.0).sum(1))
        details = {
            "bandwidth": self.bandwidth,
            "effective_sample_size": effective,
            "largest_weight_share": largest,
            "horizon_of_ten": horizon_of_ten(log_ratio, mask),
        }
        refits = np.stack([p[0] for p in redrawn])
        shifts = np.array([p[1] for p in redrawn])
        estimate = value_estimate(fqe, main, refits, policy, horizon, support, details, (shift, shifts))
        if effective >= FEW_EFFECTIVE:
            return estimate
        flag = few_effective("few_sessions_behind_correction", effective, table.sessions)
        return replace(estimate, flags=(*estimate.flags, flag))

    def _log_ratios(self, target: TargetActions, horizon: int) -> tuple[Floats, Mask]:
        table = self.fqe.table
        log_ratio, mask = np.zeros((table.sessions, horizon)), np.zeros((table.sessions, horizon), dtype=bool)
        early = table.step < horizon
        rows = table.session[early], table.step[early]
        log_ratio[rows] = (kernel_log_density(table.actions, target.at, self.bandwidth) - self.density)[early]
        mask[rows] = True
        for i, session in enumerate(self.fqe.buffer.sessions):
            own = early & (table.session == i)
            if session.holds and own.any():
                k = table.step[own]
                ratios = session_log_ratios(session, k, target.at[own], self.density[own], self.bandwidth)
                log_ratio[i, k], mask[i, k] = ratios, np.isfinite(ratios).all()  # what cannot be weighed corrects nothing
        return log_ratio, mask

    def _value(self, view: _View, pick: Indices, log_ratio: Floats, mask: Mask, horizon: int) -> tuple[Floats, float]:
        """Compute the corrected sums of the heads [R] of the picked sessions, and the correction of r_end."""
        fqe, table = self.fqe, self.fqe.table
        gamma = fqe.buffer.settings.gamma
        weights, _ = view.member.weights(view.products, pick, horizon, gamma)
        discount = discounts(gamma)
        errors = view.errors(weights, horizon, gamma)
        share = step_weights(log_ratio[pick], mask[pick])
        own = np.isin(table.first_session, pick)
        first = view.start[own if own.any() else slice(None)] @ weights[-1]
        sums = [weighted_doubly_robust(first[:, k], share, errors[pick][:, :, k], float(discount[k])) for k in range(len(discount))]
        reachable = within_reach(np.array(sums), fqe.buffer.settings, horizon, (table.scale.beta_low, table.scale.beta_high), view.span)
        known = np.isfinite(self.end_errors[pick])
        if not known.any():
            return reachable, 0.0
        whole = np.where(mask[pick], log_ratio[pick], 0.0).sum(1)[known]
        last = np.exp(whole - whole.max()) if np.isfinite(whole.max()) else np.ones(whole.size)
        return reachable, float(last @ self.end_errors[pick][known] / last.sum())


class _View:
    """A policy as one set of features sees it: features now, then, at the start, and their products."""

    def __init__(self, member: QMember, fqe: FittedFqe, target: TargetActions) -> None:
        table = fqe.table
        self.member, self.table, self.span = member, table, target.span
        self.start = member.features(table.first_states, target.first, table.first_memory(target.first))
        self.then = member.features(table.next_states, target.then, target.memory)
        self.products = member.grams.product(self.then)
        self._order = np.argsort(table.step, kind="stable")
        self._ends = np.searchsorted(table.step[self._order], np.arange(int(table.step.max()) + 2))

    def errors(self, weights: Floats, horizon: int, gamma: float) -> Floats:
        """Compute temporal errors of the heads with H - t steps to go, [n, H, R]; 0 where a session has no usable step."""
        table = self.table
        discount = discounts(gamma)
        result = np.zeros((table.sessions, horizon, len(discount)))
        for t in range(min(horizon, int(table.step.max()) + 1)):
            rows = self._order[self._ends[t] : self._ends[t + 1]]
            left = horizon - t
            paid = table.rates[rows] + discount * (self.then[rows] @ weights[left - 1])
            result[table.session[rows], t] = paid - self.member.grams.phi[rows] @ weights[left]
        return result


def build(key: str, seed: int, size: Size) -> DoublyRobust:
    """Build the estimator at a size of `ml.ope.registry`."""
    members, refits = {"full": (3, 30), "demo": (1, 20), "held_out": (1, 25)}[size]
    return DoublyRobust(FqeConfig(seed=seed, members=members, refits=refits), method=key)
