"""The page order: candidates by one method that is chosen on the data, the baseline of the evaluation benchmark.

Its rule: the method chosen by left-out controllers, else the first of the usual order that supports a candidate;
unsupported candidates last; intervals widened by what left-out controllers showed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from app.evaluation.estimates.held_out import combined, no_difference_error, widened
from ml.ope.compare.ranking import default_method, rank_policies
from ml.ope.compare.skill import FEWEST_CONTROLLERS, HeldOut, Prediction, held_out_skill
from ml.ope.estimate import Estimate
from ml.ope.registry import AGGREGATE, preference, quick_estimators
from ml.trajectories import ReplayBuffer

NEEDED = tuple(quick_estimators())
"""Methods whose estimates the page may choose between."""
NEEDED_LEAD = 1.0
"""A method takes the place of the first of the usual order only where its errors are smaller by more than so many standard errors."""


@dataclass(frozen=True)
class PageOrder:
    """The page's method, its widened estimates of every policy, and the place of each candidate, 1 is first."""

    method: str
    estimates: Mapping[str, Estimate]
    places: Mapping[str, int]


def page_order(
    buffer: ReplayBuffer, estimates: Mapping[str, Mapping[str, Estimate]], candidates: list[str], horizon: int, seed: int = 0
) -> PageOrder:
    """What the page shows.

    Args:
        buffer: the data. estimates: method -> policy -> estimate, references among the policies. candidates: names of those that rank.
        horizon: steps of a session. seed: of clones and models.
    """
    tables: dict[str, Mapping[str, Estimate]] = {m: dict(t) for m, t in estimates.items()}
    quick = {m: e for m, e in quick_estimators(seed).items() if m in tables}
    held = held_out_skill(buffer, quick, horizon_steps=horizon, seed=seed)
    outcome: dict[str, Any] = {"held_out": held.to_json()}
    both = combined(tables, outcome)
    if "estimates" in both:
        tables[AGGREGATE] = both["estimates"]
    wide = widened(tables, outcome)
    method = chosen_method(wide, held)
    ranked = rank_policies({method: {n: wide[method][n] for n in candidates}}, method)
    return PageOrder(method, wide[method], {r.policy: r.rank for r in ranked})


def chosen_method(estimates: Mapping[str, Mapping[str, Estimate]], held: HeldOut) -> str:
    """Return the most skilful method on left-out controllers that supports a candidate, else the first of the usual order.

    A method whose error of differences is no less than that of calling all controllers alike has no skill to be chosen for.

    Args:
        estimates: method -> policy -> estimate. held: the methods' predictions of left-out controllers.
    """
    first = most_skilful(held)
    if first is not None:
        base = no_difference_error([asdict(p) for p in held.predictions])
        most = max(s.controllers for s in held.table)
        errors = {s.method: s.difference_error for s in held.table if s.controllers == most}
        for method in dict.fromkeys([first, *errors]):
            skilled = base is None or errors[method] < base
            if skilled and any(e.supported for e in estimates.get(method, {}).values()):
                return method
    return default_method(estimates)


def most_skilful(held: HeldOut) -> str | None:
    """Return the first of the usual order, or one that is better by more than `NEEDED_LEAD` standard errors; None on too few."""
    most = max((s.controllers for s in held.table), default=0)
    if most < FEWEST_CONTROLLERS:
        return None
    full = [s for s in held.table if s.controllers == most]
    order = {m: k for k, m in enumerate(preference())}
    first = min((s for s in full if s.method != AGGREGATE), key=lambda s: order.get(s.method, len(order)), default=full[0])
    leads = {s.method: lead(held.predictions, first.method, s.method) for s in full if s is not first}
    return next((s.method for s in full if s is not first and leads[s.method][0] > NEEDED_LEAD * leads[s.method][1]), first.method)


def lead(predictions: tuple[Prediction, ...], first: str, other: str) -> tuple[float, float]:
    """By how much `other` predicts differences between left-out controllers better than `first`: mean over pairs, and its standard error.

    The pairs share controllers, so the standard error is the jackknife's over controllers; infinite below three common ones.
    """
    tables = [{p.controller: p.predicted - p.observed for p in predictions if p.method == m} for m in (first, other)]
    common = [c for c in tables[0] if c in tables[1]]

    def gain(names: list[str]) -> float:
        errors = [np.array([table[c] for c in names]) for table in tables]
        upper = np.triu_indices(len(names), 1)
        own, others = (np.abs(np.subtract.outer(e, e))[upper].mean() for e in errors)
        return float(own - others)

    if len(common) < FEWEST_CONTROLLERS:
        return 0.0, float("inf")
    left = np.array([gain([c for c in common if c != out]) for out in common])
    k = len(common)
    return gain(common), float(np.sqrt((k - 1) / k * np.sum((left - left.mean()) ** 2)))
