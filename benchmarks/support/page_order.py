"""The order in which the ranking page of 0.1.0 puts candidates: the baseline of the evaluation benchmark.

The rule of that page is kept here: the method chosen by left-out controllers, else the first of the usual order that supports a candidate;
unsupported candidates last; intervals widened by what left-out controllers showed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from app.evaluation.estimates.held_out import combined, no_difference_error, widened
from ml.ope.compare.ranking import default_method, rank_policies
from ml.ope.compare.skill import choose_default
from ml.ope.estimate import Estimate
from ml.ope.registry import AGGREGATE, quick_estimators
from ml.trajectories import ReplayBuffer

NEEDED = tuple(quick_estimators())
"""Methods whose estimates the page may choose between."""


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
    outcome: dict[str, Any] = {"choice": choose_default(buffer, quick, horizon_steps=horizon, seed=seed).to_json()}
    both = combined(tables, outcome)
    if "estimates" in both:
        tables[AGGREGATE] = both["estimates"]
    wide = widened(tables, outcome)
    method = chosen_method(wide, outcome["choice"])
    ranked = rank_policies({method: {n: wide[method][n] for n in candidates}}, method)
    return PageOrder(method, wide[method], {r.policy: r.rank for r in ranked})


def chosen_method(estimates: Mapping[str, Mapping[str, Estimate]], held: Mapping[str, Any]) -> str:
    """The method that 0.1.0 took: the most skilful on left-out controllers that supports a candidate, else the first of the usual order.

    A method whose error of differences is no less than that of calling all controllers alike has no skill to be chosen for.

    Args:
        estimates: method -> policy -> estimate. held: `ml.ope.compare.skill.Choice.to_json`.
    """
    if held.get("chosen_by_data"):
        base = no_difference_error(held["predictions"])
        most = max((row["controllers"] for row in held["table"]), default=0)
        errors = {row["method"]: float(row["difference_error"]) for row in held["table"] if row["controllers"] == most}
        for method in dict.fromkeys([str(held["method"]), *errors]):
            skilled = method in errors and (base is None or errors[method] < base)
            if skilled and any(e.supported for e in estimates.get(method, {}).values()):
                return method
    return default_method(estimates)
