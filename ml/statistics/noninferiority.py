"""Energy saved without loss: non-inferiority of every outcome first, then the saving.

A controller is non-inferior where each outcome is shown to be no worse than cDBS by its margin. This is an intersection-union test (Berger
1982): every outcome is tested at the full level, and all must pass. Only then is the saving tested, at the same level, so that no
correction is due (gatekeeping). Sessions that were stopped for the patient's sake are failures and never missing. Fewer than three visits
with both arms give no verdict, whatever they show. Margins are inputs: they are stated before the data are seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from ml.statistics.effects import Saving, energy_saving, saving_contrasts
from ml.statistics.multiplicity import hommel
from ml.statistics.power import MOST_VISITS, Posterior, Target, first_reaching, posterior, success
from ml.statistics.within_visits.averages import primary
from ml.statistics.within_visits.contrasts import (
    Adjustment,
    Average,
    Measurements,
    Reason,
    Scale,
    Unavailable,
    average,
    visit_contrasts,
)

Floats = NDArray[np.float64]

LEAST_VISITS = 3
WANTED_POWER = 0.8
PLANNED_SESSIONS = 3
"""Sessions of either arm in a further visit, unless another number is stated."""
ENERGY = "energy"
Reasons = tuple[tuple[str, Reason], ...]
"""Outcomes (or `energy`), each with the reason why a result is missing."""


class FailureRule(StrEnum):
    """Value of a session that was stopped for the patient's sake.

    WORST_CASE: the failure value under the controller; under cDBS what was measured, so that no failure of cDBS helps the controller.
    BOTH_ARMS: the failure value under either. AS_MEASURED: what was measured, or excluded where nothing was. END_OF_SCALE: under the
        controller the worst end
    of the scale, also where the failure value is not that bad.
    """

    WORST_CASE = "worst_case"
    BOTH_ARMS = "both_arms"
    AS_MEASURED = "as_measured"
    END_OF_SCALE = "end_of_scale"


@dataclass(frozen=True)
class Outcome:
    """One outcome that must not get worse; n sessions.

    Attributes:
        name: of the outcome. data: values of both arms, NaN where not measured.
        stopped: sessions stopped for the patient's sake, [n].
        margin: largest loss that is accepted, above zero; in the unit of the values, or a probability below 0.5 for `win_probability`.
        higher_is_better: direction. scale: of the contrast (`visits.visit_contrasts`). With `ordinal` the controller's values are made
            better by the margin, and must then win at least half of the pairs: that its shift is no loss of the margin or more is shown
            without taking steps of a rating for equal distances.
        failure: value of a failed session, to which no margin is added; None where it is unknown, so that the session has no value.
        worst_possible: the worst end of the scale; NaN where it has none.

    Raises:
        ValueError: a margin that is not above zero (or not below 0.5 for a probability), `ordinal` values without a step, or `stopped` of
            another shape.
    """

    name: str
    data: Measurements
    stopped: NDArray[np.bool_]
    margin: float
    higher_is_better: bool
    scale: Scale = "difference"
    failure: float | None = None
    worst_possible: float = float("nan")

    def __post_init__(self) -> None:
        if not self.margin > 0:
            raise ValueError(f"the margin of {self.name} must be above 0, not {self.margin}")
        if self.scale == "win_probability" and not self.margin < 0.5:
            raise ValueError(f"the margin of {self.name} is a probability and must be below 0.5, not {self.margin}")
        if self.scale == "ordinal" and not self.data.resolution > 0:
            raise ValueError(f"{self.name} is to be compared in steps, so its `resolution` must be above 0")
        if self.stopped.shape != self.data.value.shape:
            raise ValueError(f"`stopped` of {self.name} has the shape {self.stopped.shape}, its values {self.data.value.shape}")

    def counted(self, rule: FailureRule) -> Measurements:
        """Fill in failures and turn values so that higher is better; `ordinal` values of the controller get the margin added.

        They count as unbounded. One-sided, to free Student's ratio from skewness corrects little of its error and costs conclusions.
        """
        sign = 1.0 if self.higher_is_better else -1.0
        value = sign * self.data.value
        if self.scale == "ordinal":
            value = np.where(self.data.tested, value + self.margin, value)
        if rule is not FailureRule.AS_MEASURED:
            rows = self.stopped if rule is FailureRule.BOTH_ARMS else self.stopped & self.data.tested
            failure = self.worst_possible if rule is FailureRule.END_OF_SCALE else np.nan if self.failure is None else self.failure
            value = np.where(rows, sign * failure, value)
        return replace(self.data, value=value, bounded=False)

    @property
    def loss(self) -> float:
        """The contrast that is to be excluded, higher being better."""
        return {"difference": -self.margin, "win_probability": 0.5 - self.margin, "ordinal": 0.5}[self.scale]


@dataclass(frozen=True)
class OutcomeResult:
    """Non-inferiority of one outcome.

    Attributes:
        average: the average contrast, turned so that higher is better; or why there is none. loss: of it, that is to be excluded.
        p_non_inferior: one-sided, of a loss of the margin or more. p_inferior: one-sided, of a loss of less than the margin. None without
            average.
        failures: failed sessions of the controller. missing: sessions without a value that are not failures.
    """

    name: str
    margin: float
    loss: float
    average: Average | Unavailable
    p_non_inferior: float | None
    p_inferior: float | None
    failures: int
    missing: int


@dataclass(frozen=True)
class NonInferiorAndSaving:
    """No outcome is worse by its margin, and energy is saved: per cent with its interval."""

    percent: float
    low: float
    high: float


@dataclass(frozen=True)
class Inferior:
    """Outcomes that are worse than cDBS by more than their margin."""

    outcomes: tuple[str, ...]


@dataclass(frozen=True)
class Inconclusive:
    """Verdict without a conclusion, and what is missing for one.

    Attributes:
        open: outcomes (or `energy`) that are not shown yet.
        more_visits: further visits after which a conclusion has a probability of `WANTED_POWER`. None where `MOST_VISITS` are not enough,
            or where `unplanned` gives the reason why it is unknown.
        untested: of `open`, what could not be tested, with the reason.
        fewest_visits: the same with any number of sessions in each of them: what sessions cannot replace.
        unplanned: outcomes (or `energy`) that prevent planning of further visits, with the reason.
    """

    open: tuple[str, ...]
    more_visits: int | None
    untested: Reasons = ()
    fewest_visits: int | None = None
    unplanned: Reasons = ()


Verdict = NonInferiorAndSaving | Inferior | Inconclusive


@dataclass(frozen=True)
class Assessment:
    """Verdict of the stated rule with everything behind it.

    Attributes:
        verdict: by `FailureRule.WORST_CASE`.
        outcomes: in the order given. p_non_inferior: the largest of their p-values; None where one has none.
        saving: also given where the gate before it is closed. sensitivity: verdicts under the other rules, without planning.
    """

    verdict: Verdict
    outcomes: tuple[OutcomeResult, ...]
    p_non_inferior: float | None
    saving: Saving | Unavailable
    alpha: float
    sensitivity: tuple[tuple[FailureRule, Verdict], ...]


def assess(
    outcomes: Sequence[Outcome],
    energy: Measurements,
    stopped: NDArray[np.bool_],
    *,
    alpha: float = 0.05,
    level: float = 0.95,
    sessions_per_arm: int = PLANNED_SESSIONS,
    seed: int = 0,
    plan: bool = True,
) -> Assessment:
    """Assess non-inferiority of all outcomes, then the saving.

    Args:
        outcomes: at least one. energy: of every session; a stopped session of the controller saves nothing. stopped: of `energy`'s
            sessions.
        alpha: one-sided level of every test. level: coverage of the intervals. sessions_per_arm: in the further visits that are planned
            for.
        seed: of bootstrap and planning. plan: whether to simulate how many more visits it takes.

    Raises:
        ValueError: no outcome, or a level outside (0, 0.5).
    """
    if not outcomes:
        raise ValueError("non-inferiority needs at least one outcome with its margin")
    if not 0 < alpha < 0.5:
        raise ValueError(f"the level of a one-sided test must be between 0 and 0.5, not {alpha}")
    rule = FailureRule.WORST_CASE
    results = tuple(_outcome(o, rule, level) for o in outcomes)
    spent = counted_energy(energy, stopped, rule)
    saving = energy_saving(spent, level, seed=seed)
    verdict = _verdict(results, saving, alpha)
    if plan and isinstance(verdict, Inconclusive):
        verdict = _with_plan(verdict, outcomes, spent, alpha, sessions_per_arm, seed)
    others = []
    failed = bool(stopped.any()) or any(o.stopped.any() for o in outcomes)
    for other in (FailureRule.BOTH_ARMS, FailureRule.AS_MEASURED, FailureRule.END_OF_SCALE):
        if not failed:  # without failures the rules are one
            others.append((other, _verdict(results, saving, alpha)))
            continue
        found = tuple(_outcome(o, other, level) for o in outcomes)
        others.append((other, _verdict(found, energy_saving(counted_energy(energy, stopped, other), level, seed=seed), alpha)))
    p_values = [r.p_non_inferior for r in results if r.p_non_inferior is not None]
    joint = max(p_values) if len(p_values) == len(results) else None
    return Assessment(verdict, results, joint, saving, alpha, tuple(others))


def counted_energy(energy: Measurements, stopped: NDArray[np.bool_], rule: FailureRule) -> Measurements:
    """Give a failed session of the controller the energy of cDBS at that visit, or its own where that is more."""
    if rule is FailureRule.AS_MEASURED:
        return energy
    value = energy.value.copy()
    for i in np.flatnonzero(stopped & energy.tested):
        same = energy.value[(energy.visit == energy.visit[i]) & ~energy.tested & np.isfinite(energy.value)]
        if same.size:
            value[i] = np.nanmax([same.mean(), energy.value[i]])
    return replace(energy, value=value)


def _outcome(outcome: Outcome, rule: FailureRule, level: float) -> OutcomeResult:
    counted = outcome.counted(rule)
    found: Average | Unavailable
    if len(counted.arms) in range(1, LEAST_VISITS):
        found = Unavailable(Reason.TOO_FEW_VISITS, len(counted.arms), LEAST_VISITS)
    else:
        found = primary(counted, level, outcome.scale)
        if rule is not FailureRule.AS_MEASURED and isinstance(found, Average) and found.adjustment is not Adjustment.NONE:
            found = _less_favourable(found, average(visit_contrasts(counted, outcome.scale), level), outcome)
    failures = int(np.sum(outcome.stopped & outcome.data.tested))
    missing = int(np.sum(~np.isfinite(counted.value)))
    if isinstance(found, Unavailable):
        return OutcomeResult(outcome.name, outcome.margin, outcome.loss, found, None, None, failures, missing)
    p = found.p_above(outcome.loss), found.p_below(outcome.loss)
    if outcome.scale != "difference":  # a share of pairs ends at 0 and 1
        found = replace(found, low=max(0.0, found.low), high=min(1.0, found.high))
    return OutcomeResult(outcome.name, outcome.margin, outcome.loss, found, *p, failures, missing)


def _less_favourable(adjusted: Average, plain: Average | Unavailable, outcome: Outcome) -> Average:
    """Choose, where a session of the controller failed, the worse of the averages with and without adjustment for the order.

    Sessions that are stopped come late in a visit, so that a drift fitted through their failures would explain them away.
    """
    if not (outcome.stopped & outcome.data.tested).any() or isinstance(plain, Unavailable):
        return adjusted
    return max(adjusted, plain, key=lambda a: a.p_above(outcome.loss))


def _verdict(results: Sequence[OutcomeResult], saving: Saving | Unavailable, alpha: float) -> Verdict:
    # That one outcome of several is inferior is a union. Outcomes of the same sessions get worse together, so that Hommel keeps its level.
    judged = [r for r in results if r.p_inferior is not None]
    adjusted = hommel([r.p_inferior for r in judged if r.p_inferior is not None])
    worse = tuple(r.name for r, p in zip(judged, adjusted, strict=True) if p < alpha)
    if worse:
        return Inferior(worse)
    unshown = tuple(r.name for r in results if r.p_non_inferior is None or not r.p_non_inferior < alpha)
    if unshown:
        return Inconclusive(unshown, None, tuple((r.name, r.average.reason) for r in results if isinstance(r.average, Unavailable)))
    if isinstance(saving, Unavailable):
        return Inconclusive((ENERGY,), None, ((ENERGY, saving.reason),))
    if len(saving.visits) < LEAST_VISITS:
        return Inconclusive((ENERGY,), None, ((ENERGY, Reason.TOO_FEW_VISITS),))
    if not saving.p_value < alpha:
        return Inconclusive((ENERGY,), None)
    return NonInferiorAndSaving(saving.percent, saving.low, saving.high)


def _with_plan(
    verdict: Inconclusive, outcomes: Sequence[Outcome], energy: Measurements, alpha: float, sessions: int, seed: int
) -> Inconclusive:
    """Add the fewest further visits after which all is shown with the wanted probability. Outcomes count as independent. The number is
    given for so many sessions of either arm per visit, and for any number of them."""
    chances, limit = np.ones(MOST_VISITS), np.ones(MOST_VISITS)
    shares = _energy_posterior(energy, seed)
    wanted = [(o.name, posterior(o.counted(FailureRule.WORST_CASE), o.scale, seed=seed + i), o.loss) for i, o in enumerate(outcomes)] + [
        (ENERGY, shares, 0.0)
    ]
    unplanned = tuple((name, found.reason) for name, found, _ in wanted if isinstance(found, Unavailable))
    for i, (_, found, value) in enumerate(wanted):
        if isinstance(found, Unavailable):
            return replace(verdict, unplanned=unplanned)
        target = Target(value, "greater", alpha, LEAST_VISITS)
        chances *= success(found, target, sessions, seed=seed + 100 + i).mean(0)
        limit *= success(found, target, np.inf, seed=seed + 100 + i).mean(0)
    return replace(verdict, more_visits=first_reaching(chances, WANTED_POWER), fewest_visits=first_reaching(limit, WANTED_POWER))


def _energy_posterior(energy: Measurements, seed: int) -> Posterior | Unavailable:
    """Draw the posterior of the share saved: energies of each visit relative to the mean of its cDBS sessions."""
    shares = saving_contrasts(energy)
    if isinstance(shares, Unavailable):
        return shares
    value = np.full(energy.value.shape, np.nan)
    for visit, _, two in energy.arms:
        rows = energy.visit == visit
        value[rows] = -energy.value[rows] / energy.value[two].mean()
    return posterior(replace(energy, value=value), seed=seed)
