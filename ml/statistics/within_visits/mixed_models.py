"""Mixed models of a controller against cDBS, with a level of each visit, an effect that differs between visits, and policies within the
controller.

They use every session at once and say how far visits and policies differ. All are tested on t with one degree of freedom fewer than visits
with both arms, never as a normal deviate. The spread between visits is what they know least. Where Satterthwaite's approximation has fewer
degrees (policies that differ, and few of them), the linear model takes those. Metrics that are measured on a scale follow the linear model;
a scale without equal steps follows ordered categories. Minutes are counts of those watched, with a level of each session because the
minutes of one session resemble each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ml.statistics.mixed import MixedModel, Sums
from ml.statistics.within_visits.contrasts import (
    Adjustment,
    Average,
    Measurements,
    Reason,
    Unavailable,
    VisitContrasts,
    student,
    visit_contrasts,
)
from ml.statistics.within_visits.generalised import FLAT, WEAK, GeneralisedFit, Likelihood, binomial, cumulative, fit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

INTERCEPT, EFFECT = 0, 1


@dataclass(frozen=True)
class PolicyEffect:
    """Difference of one policy from the controller's average, shrunk: in the unit of the effect, with its standard error."""

    policy: int
    estimate: float
    standard_error: float


@dataclass(frozen=True)
class MixedComparison:
    """A mixed model of one metric.

    Attributes:
        effect: of the controller, in the metric's unit (linear) or in log odds (of a higher category, or of a counted minute).
        visit_sd: standard deviation of visits' levels. slope_sd: of the effect between visits. policy_sd: between policies; None where
            fewer than two policies were tested.
        session_sd: of sessions within a visit and arm; None for ordered categories: the odds hold it.
        policies: effects of single policies.
    """

    effect: Average
    visit_sd: float
    slope_sd: float
    policy_sd: float | None
    session_sd: float | None
    policies: tuple[PolicyEffect, ...]


def linear_comparison(data: Measurements, policy: Integers | None = None, level: float = 0.95) -> MixedComparison | Unavailable:
    """Fit a linear mixed model by restricted likelihood.

    Args:
        data: sessions of both arms; visits that lack one and sessions without a value are excluded.
        policy: number of the policy of every session, [n]; that of cDBS sessions is not looked at.
    """
    prepared = _prepare(data, policy)
    if isinstance(prepared, Unavailable):
        return prepared
    design = prepared.design
    y = prepared.data.value - prepared.data.value.mean()
    scale = float(y.std())
    if scale <= 1e-12 * max(1.0, float(np.abs(prepared.data.value).max())):
        return Unavailable(Reason.ALL_EQUAL)
    found = MixedModel(design.shape[1], prepared.groups, {}).restricted(Sums.of(design, y / scale))
    estimate, variance = scale * float(found.coefficients[EFFECT]), scale**2 * float(found.covariance[EFFECT, EFFECT])
    effect = student(estimate, variance, prepared.contrasts, level, Adjustment.NONE, max(float(found.degrees[EFFECT]), 1.0))
    if isinstance(effect, Unavailable):
        return effect
    session_sd = scale * float(np.sqrt(found.variance))
    roots = {g: session_sd * float(np.sqrt(r)) for g, r in zip(found.groups, found.ratios, strict=True)}
    policies = prepared.policy_effects(scale * found.coefficients, scale**2 * found.covariance, 0)
    return MixedComparison(effect, roots["visit"], roots["slope"], roots.get("policy"), session_sd, policies)


def ordinal_comparison(data: Measurements, policy: Integers | None = None, level: float = 0.95) -> MixedComparison | Unavailable:
    """Fit the proportional-odds mixed model of ordered categories; the effect is the log odds of a higher one.

    Args:
        data, policy, level: as in `linear_comparison`.
    """
    prepared = _prepare(data, policy)
    if isinstance(prepared, Unavailable):
        return prepared
    category = np.unique(prepared.data.value, return_inverse=True)[1].astype(np.int64)
    steps = int(category.max())
    if steps == 0:
        return Unavailable(Reason.ALL_EQUAL)
    design = prepared.design[:, 1:]  # the thresholds are the intercepts
    below = (np.cumsum(np.bincount(category))[:-1] / category.size).clip(0.02, 0.98)
    start = np.concatenate([np.log(below / (1 - below)) + 1e-6 * np.arange(steps), np.zeros(design.shape[1])])
    fixed = dict.fromkeys(range(steps), FLAT) | {steps: WEAK}
    return prepared.generalised(cumulative(category, design), start, fixed, steps - 1, level)


def minutes_comparison(
    data: Measurements, minutes: Floats, policy: Integers | None = None, level: float = 0.95
) -> MixedComparison | Unavailable:
    """Fit the binomial mixed model of counted minutes; the effect is the log odds of such a minute.

    Args:
        data: value is the number of counted minutes (or a share of them, summed over time). minutes: watched, [n], NaN or 0 where none.
        policy: as in `linear_comparison`.

    Raises:
        ValueError: counted minutes below zero or above those watched.
    """
    watched = np.isfinite(minutes) & (minutes > 0)
    prepared = _prepare(data.take(watched), None if policy is None else policy[watched])
    if isinstance(prepared, Unavailable):
        return prepared
    total = minutes[watched][prepared.rows]
    count = prepared.data.value
    if (count == 0).all() or (count == total).all():
        return Unavailable(Reason.ALL_EQUAL)
    q = prepared.design.shape[1]
    design = np.concatenate([prepared.design, np.eye(count.size)], axis=1)
    sessions = {"session": range(q, q + count.size)}
    share = float(np.clip(count.sum() / total.sum(), 0.02, 0.98))
    start = np.zeros(design.shape[1])
    start[INTERCEPT] = np.log(share / (1 - share))
    return prepared.generalised(binomial(count, total, design), start, {INTERCEPT: FLAT, EFFECT: WEAK}, 0, level, sessions)


@dataclass(frozen=True)
class _Prepared:
    """Rows of visits with both arms, their design, and which columns form which group."""

    data: Measurements
    rows: Integers
    contrasts: VisitContrasts
    design: Floats
    groups: dict[str, range]
    policies: Integers

    def generalised(
        self,
        likelihood: Likelihood,
        start: Floats,
        fixed: dict[int, float],
        shift: int,
        level: float,
        more: dict[str, range] | None = None,
    ) -> MixedComparison | Unavailable:
        """Fit a likelihood whose columns come `shift` places after those of the design."""
        groups = {g: range(c.start + shift, c.stop + shift) for g, c in self.groups.items()} | (more or {})
        found: GeneralisedFit = fit(likelihood, start, fixed, groups)
        place = EFFECT + shift
        effect = student(float(found.parameters[place]), float(found.covariance[place, place]), self.contrasts, level, Adjustment.NONE)
        if isinstance(effect, Unavailable):
            return effect
        roots, policies = found.roots, self.policy_effects(found.parameters, found.covariance, shift)
        return MixedComparison(effect, roots["visit"], roots["slope"], roots.get("policy"), roots.get("session"), policies)

    def policy_effects(self, parameters: Floats, covariance: Floats, shift: int) -> tuple[PolicyEffect, ...]:
        """Read the effects of the policies from their own columns."""
        columns = self.groups.get("policy", range(0))
        return tuple(
            PolicyEffect(int(p), float(parameters[c + shift]), float(np.sqrt(covariance[c + shift, c + shift])))
            for p, c in zip(self.policies, columns, strict=True)
        )


def _prepare(data: Measurements, policy: Integers | None) -> _Prepared | Unavailable:
    contrasts = visit_contrasts(data)
    if isinstance(contrasts, Unavailable):
        return contrasts
    if contrasts.visits < 2:
        return Unavailable(Reason.TOO_FEW_VISITS, contrasts.visits, 2)
    rows = np.flatnonzero(np.isfinite(data.value) & np.isin(data.visit, contrasts.visit))
    used = data.take(rows)
    half = np.where(used.tested, 0.5, -0.5)
    levels = (used.visit[:, None] == contrasts.visit).astype(np.float64)
    columns = [np.ones((rows.size, 1)), half[:, None], levels, levels * half[:, None]]
    v = contrasts.visits
    groups = {"visit": range(2, 2 + v), "slope": range(2 + v, 2 + 2 * v)}
    policies = np.zeros(0, dtype=np.int64)
    if policy is not None:
        found = np.unique(policy[rows][used.tested])
        if found.size > 1:
            policies = found.astype(np.int64)
            columns.append(((policy[rows][:, None] == policies) & used.tested[:, None]).astype(np.float64))
            groups["policy"] = range(2 + 2 * v, 2 + 2 * v + policies.size)
    # the effect of a model is no average of contrasts, so that their skewness says nothing of its error
    contrasts = replace(contrasts, bounded=False)
    return _Prepared(used, rows.astype(np.int64), contrasts, np.concatenate(columns, axis=1), groups, policies)
