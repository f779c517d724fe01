"""Errors of methods on these data: each predicts the return of controllers that its fit excluded, compared with what their sessions
returned. No true return, no simulator: sessions alone.

A controller is held out whole, as a new policy would be. Methods get what it did as a policy: the policy itself where it is at hand,
uniform draws for the random controller, else a clone. The errors widen the intervals of the methods.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from ml.faults import BROKE, own_words
from ml.ope.behaviour import Key, clones, controllers
from ml.ope.compare.aggregate import combine
from ml.ope.compare.metrics import spearman
from ml.ope.estimate import Estimate, Estimator, checked_horizon
from ml.ope.observed import Observed, observed
from ml.ope.registry import AGGREGATE
from ml.policies.policy import Policy
from ml.progress import Report, silent
from ml.trajectories import ReplayBuffer

FEWEST_CONTROLLERS = 3
"""Controllers with r_end that make a comparison by whole returns."""

NINETY = 1.645
"""Half-width of a normal's 90 % interval, the level of all estimates, in standard deviations."""


@dataclass(frozen=True)
class Prediction:
    """Prediction of a method for a controller that it has not seen, and the observed return."""

    method: str
    controller: str
    sessions: int
    predicted: float
    observed: float
    observed_standard_error: float | None
    supported: bool


@dataclass(frozen=True)
class Skill:
    """Held-out skill of one method.

    Attributes:
        method: its key. controllers: predicted ones.
        difference_error: mean absolute error of the predicted differences between two controllers, share of the observed range.
        error: mean absolute error, share of the observed range. bias: root mean squared error, unit of the return.
        excess: root of the mean squared error beyond what the standard errors of the observed means explain, unit of the return.
        rank_correlation: of predicted with observed returns; None where one side has no spread.
        pairs_in_order: share of pairs of controllers that are predicted in the observed order.
    """

    method: str
    controllers: int
    difference_error: float
    error: float
    bias: float
    excess: float
    rank_correlation: float | None
    pairs_in_order: float

    def to_json(self) -> dict[str, Any]:
        """Return all numbers, by name."""
        return asdict(self)


@dataclass(frozen=True)
class HeldOut:
    """Skill of the methods on left-out controllers.

    Attributes:
        table: skill of every method, best first. predictions: all of them. failed: methods that could not be fitted, with the reason.
    """

    table: tuple[Skill, ...]
    predictions: tuple[Prediction, ...]
    failed: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """Return everything, JSON-able."""
        return asdict(self) | {"failed": dict(self.failed)}


def held_out_skill(
    buffer: ReplayBuffer,
    estimators: Mapping[str, Estimator],
    *,
    policies: Mapping[int, Policy] | None = None,
    horizon_steps: int | None = None,
    aggregate: bool = True,
    seed: int = 0,
    report: Report = silent,
) -> HeldOut:
    """Compare predictions of left-out controllers with what their sessions returned.

    Args:
        buffer: all sessions. estimators: methods by key; each is fitted once per controller, so give quick settings.
        policies: logged policies by `policy_id`; the others are cloned.
        horizon_steps: H, the buffer's median session length by default.
        aggregate: include the combination of all.
        seed: of clones.
    """
    horizon = checked_horizon(buffer, horizon_steps)
    predictions, failed = held_out_predictions(buffer, estimators, policies or {}, horizon, aggregate, seed, report)
    return HeldOut(tuple(sorted(skills(predictions), key=lambda s: s.difference_error)), predictions, failed)


def with_held_out_error(estimate: Estimate, error: float) -> Estimate:
    """Widen an estimate's interval by what held-out controllers showed of the method's errors (`Skill.excess`).

    Resampled sessions see how uncertain a model's numbers are, not that the model is wrong; a controller that it has not seen shows that.
    The two are independent, so their reaches add up as the sides of a right angle, like their standard errors.
    """
    return replace(
        estimate,
        low=estimate.value - reach_with(estimate.value - estimate.low, error),
        high=estimate.value + reach_with(estimate.high - estimate.value, error),
        standard_error=float(np.hypot(estimate.standard_error, error)),
        details={**estimate.details, "held_out_error": error},
    )


def reach_with(reach: float, error: float) -> float:
    """Compute half of a 90 % interval that has an independent error of standard deviation `error` besides."""
    return float(np.hypot(reach, NINETY * error))


def held_out_predictions(
    buffer: ReplayBuffer,
    estimators: Mapping[str, Estimator],
    policies: Mapping[int, Policy],
    horizon: int,
    aggregate: bool,
    seed: int,
    report: Report,
) -> tuple[tuple[Prediction, ...], dict[str, str]]:
    """Predict every controller that can be held out by every method; return the methods that failed too."""
    groups, stand_ins, truth = controllers(buffer), clones(buffer, seed), observed(buffer, horizon, seed)
    groups, whole = _comparable(groups, truth)
    predictions: list[Prediction] = []
    failed: dict[str, str] = {}
    for k, (key, indices) in enumerate(groups.items()):
        rest = tuple(s for i, s in enumerate(buffer.sessions) if i not in set(indices))
        usable = sum(bool(s.usable().any()) for s in rest)
        if usable >= 2 and key in truth:
            part = replace(buffer, sessions=rest)
            known = policies.get(key[1]) if key[1] is not None else None
            policy = known if known is not None else stand_ins[key][0]
            found = _predict(part, estimators, policy, horizon, failed)
            if aggregate and len(found) > 1:
                found |= _combined(found)
            predictions += [_prediction(method, key, estimate, truth[key], whole) for method, estimate in found.items()]
        report((k + 1) / len(groups), "predicting left-out controllers")
    return tuple(predictions), failed


def skills(predictions: tuple[Prediction, ...]) -> list[Skill]:
    """Compute the skill of every method that predicted at least two controllers."""
    result = []
    for method in dict.fromkeys(p.method for p in predictions):
        own = [p for p in predictions if p.method == method]
        said, seen = np.array([p.predicted for p in own]), np.array([p.observed for p in own])
        noise = np.array([(p.observed_standard_error or 0.0) ** 2 for p in own])
        spread = float(np.ptp(seen))
        if len(own) < 2 or spread <= 0:
            continue
        pairs = list(combinations(range(len(own)), 2))
        differences = [abs((said[i] - said[j]) - (seen[i] - seen[j])) for i, j in pairs]
        order = [np.sign(said[i] - said[j]) == np.sign(seen[i] - seen[j]) for i, j in pairs]
        result.append(
            Skill(
                method=method,
                controllers=len(own),
                difference_error=float(np.mean(differences)) / spread,
                error=float(np.abs(said - seen).mean()) / spread,
                bias=float(np.sqrt(np.mean((said - seen) ** 2))),
                excess=float(np.sqrt(max(0.0, float(np.mean((said - seen) ** 2 - noise))))),
                rank_correlation=spearman(said, seen),
                pairs_in_order=float(np.mean(order)),
            )
        )
    return result


def _predict(
    part: ReplayBuffer, estimators: Mapping[str, Estimator], policy: Policy, horizon: int, failed: dict[str, str]
) -> dict[str, Estimate]:
    found = {}
    for method, estimator in estimators.items():
        if method in failed:
            continue
        try:
            found[method] = estimator.fit(part).evaluate({"left out": policy}, horizon)["left out"]
        except ValueError as error:  # what a method says of data that it cannot work on
            failed[method] = own_words(error) or BROKE
    return found


def _combined(found: Mapping[str, Estimate]) -> dict[str, Estimate]:
    tables = {method: {"left out": estimate} for method, estimate in found.items() if estimate.supported}
    return {AGGREGATE: combine(tables)["left out"]} if len(tables) > 1 else {}


def _comparable(groups: Mapping[Key, list[int]], truth: Mapping[Key, Observed]) -> tuple[dict[Key, list[int]], bool]:
    """Find the controllers that can be compared, and whether by whole returns.

    A return with r_end and one without differ by r_end alone. Where enough controllers have it, the others are excluded. Else all are
    compared by their steps.
    """
    complete = {k: i for k, i in groups.items() if k in truth and truth[k].end_reward is not None}
    return (complete, True) if len(complete) >= FEWEST_CONTROLLERS else (dict(groups), len(complete) == len(groups))


def _prediction(method: str, key: Key, estimate: Estimate, truth: Observed, whole: bool) -> Prediction:
    # Compared with the same parts: a method without r_end is compared by its steps.
    with_end = whole and estimate.end_reward is not None and truth.end_reward is not None
    name = key[0] if key[1] is None else f"{key[0]} {key[1]}"
    return Prediction(
        method,
        name,
        truth.n,
        estimate.value if with_end else estimate.step_return,
        truth.value if with_end else truth.step_return,
        truth.standard_error,
        estimate.supported,
    )
