"""The method that a ranking rests on: of those that support a candidate the one that predicted left-out controllers best, else the first
of a stated order; and the combination of all methods. Which way it was, and the scores behind it, are stored with the evaluation.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

from app.evaluation.estimates.methods import AGGREGATE, METHOD_NAMES
from ml.ope.compare.aggregate import combine
from ml.ope.compare.ranking import PREFERENCE, default_method
from ml.ope.compare.skill import with_held_out_error
from ml.ope.estimate import Estimate

Tables = Mapping[str, Mapping[str, Estimate]]


def choose(estimates: Tables, outcome: Mapping[str, Any] | None) -> dict[str, Any]:
    """The default method of a ranking, JSON-able for the evaluation's diagnostics.

    Args:
        estimates: method -> candidate -> estimate; every method that could speak.
        outcome: what the compute function `choose_method` gave; None where it was not run.

    Returns:
        `method`, `chosen_by_data`, `reason`, `table` of held-out skill, `no_difference_error`, `predictions`, `failed` and `not_compared`,
        the methods with estimates that were not held against left-out controllers.

    Raises:
        ValueError: no method has any estimate.
    """
    held: Mapping[str, Any] = (outcome or {}).get("choice") or {}
    table, base = list(held.get("table", [])), no_difference_error(held.get("predictions", []))
    result = {
        "table": table,
        "no_difference_error": base,
        "predictions": list(held.get("predictions", [])),
        "failed": dict(held.get("failed", {})),
        "not_compared": [m for m in estimates if m not in {row["method"] for row in table}],
    }
    if held.get("chosen_by_data"):
        method, words = _by_skill(estimates, held, base)
        if method is not None:
            return result | {"method": method, "chosen_by_data": True, "reason": words}
    elif outcome is None:
        words = "No method was held against left-out controllers"
    elif "failed" in outcome:
        words = f"The data cannot choose: {outcome['failed']}"
    else:
        # the science's sentence ends in what it would take; which method is taken is said here
        words = str(held.get("reason", "the data cannot choose")).split(";")[0]
        words = words[:1].upper() + words[1:]
    order = ", ".join(_name(m) for m in PREFERENCE if m in estimates)
    reason = f"{words}. Taken is the first method of the usual order that supports a candidate: {order}"
    return result | {"method": default_method(estimates), "chosen_by_data": False, "reason": reason}


def _by_skill(estimates: Tables, held: Mapping[str, Any], base: float | None) -> tuple[str | None, str]:
    """The most skilful method that supports a candidate with the reason in words; None with the reason against all of them.

    A method whose error of differences is no less than `base`, that of calling all controllers alike, has no skill to be chosen for.
    """
    first, most = str(held["method"]), max((row["controllers"] for row in held["table"]), default=0)
    errors = {row["method"]: float(row["difference_error"]) for row in held["table"] if row["controllers"] == most}
    skilled = [m for m in dict.fromkeys([first, *errors]) if m in errors and (base is None or errors[m] < base)]
    able = [m for m in skilled if _supports(estimates.get(m, {}))]
    alike = "better than if it had said that all return the same"
    if not skilled:
        return None, f"No method predicted left-out controllers {alike}"
    if able[:1] == [first]:
        return first, str(held["reason"])
    what = "supports none of the candidates" if estimates.get(skilled[0]) else "has no estimate of these policies"
    doubt = f"{_name(skilled[0])} predicted left-out controllers best, but {what}"
    if not able:
        return None, f"{doubt}, nor does another one that predicted them {alike}" if len(skilled) > 1 else doubt
    if able[0] == skilled[0]:
        return able[0], f"{_name(able[0])} predicted the differences between left-out controllers {alike}"
    return able[0], f"{doubt}; {_name(able[0])} is the best of those that support a candidate"


def widened(estimates: Tables, outcome: Mapping[str, Any] | None) -> dict[str, dict[str, Estimate]]:
    """The estimates with their intervals widened by what left-out controllers showed of each method's errors, where they showed any.

    Resampled sessions see how uncertain a model's numbers are, not that the model is wrong. Beside the widened interval an estimate keeps
    `held_out_difference_error`, the error of differences beyond the noise of the observed means, for the interval of a gain. The
    combination takes those of its parts by their weights.
    """
    held: Mapping[str, Any] = (outcome or {}).get("choice") or {}
    excess = {row["method"]: float(row["excess"]) for row in held.get("table", []) if row.get("excess") is not None}
    apart = difference_errors(held.get("predictions", []))

    def wider(method: str, e: Estimate) -> Estimate:
        shares = {method: 1.0} if method != AGGREGATE else {m: float(w) for m, w in e.details.get("weights", {}).items() if w > 0}
        if not shares or any(m not in excess or m not in apart for m in shares):
            return e
        more, between = (sum(w * known[m] for m, w in shares.items()) for known in (excess, apart))
        wide = with_held_out_error(e, more)
        return replace(wide, details={**wide.details, "held_out_difference_error": between})

    return {m: {name: wider(m, e) for name, e in table.items()} for m, table in estimates.items()}


def difference_errors(predictions: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Root mean squared error of predicted differences between two controllers beyond the noise of their observed means, by method.

    Over pairs of controllers that the method supported though it had not seen them; over all pairs where there is no such pair.
    """
    result = {}
    for method in dict.fromkeys(p["method"] for p in predictions):
        own = [p for p in predictions if p["method"] == method]
        pairs = list(combinations([p for p in own if p["supported"]], 2)) or list(combinations(own, 2))
        if pairs:
            result[method] = math.sqrt(max(0.0, sum(_squared_error(a, b) for a, b in pairs) / len(pairs)))
    return result


def _squared_error(a: Mapping[str, Any], b: Mapping[str, Any]) -> float:
    error = float((a["predicted"] - b["predicted"]) - (a["observed"] - b["observed"]))
    return error**2 - sum(float(p["observed_standard_error"] or 0.0) ** 2 for p in (a, b))


def no_difference_error(predictions: Sequence[Mapping[str, Any]]) -> float | None:
    """Error of differences, share of the observed range, of a prediction that all controllers return the same; None below two."""
    by_method: dict[str, dict[str, float]] = defaultdict(dict)
    for p in predictions:
        by_method[p["method"]][p["controller"]] = float(p["observed"])
    seen = list(max(by_method.values(), key=len).values()) if by_method else []
    spread = max(seen) - min(seen) if seen else 0.0
    if spread <= 0:
        return None
    pairs = [abs(a - b) for a, b in combinations(seen, 2)]
    return sum(pairs) / len(pairs) / spread


def _name(method: str) -> str:
    return METHOD_NAMES.get(method, method)


def _supports(table: Mapping[str, Estimate]) -> bool:
    return any(e.supported for e in table.values())


def combined(estimates: Tables, outcome: Mapping[str, Any] | None) -> dict[str, Any]:
    """The combination as one more method's result: `{"estimates": {policy id: Estimate}}` or `{"failed": reason}`.

    A method's error has a part that no resampling shows: its bias. Where left-out controllers have shown it, only methods of known bias
    take part, so that an unknown bias is not taken for none.

    Args:
        estimates: method -> policy -> estimate. outcome: of `choose_method`.
    """
    table = ((outcome or {}).get("choice") or {}).get("table", [])
    bias = {row["method"]: float(row["bias"]) for row in table if row["method"] != AGGREGATE}
    parts = {m: by_policy for m, by_policy in estimates.items() if m != AGGREGATE and (not bias or m in bias)}
    if len(parts) < 2:
        spoke = ", ".join(_name(m) for m in parts) or "none"
        return {"failed": f"at least two methods are needed to combine; those that can take part: {spoke}"}
    try:
        return {"estimates": combine(parts, bias or None)}
    except ValueError as error:
        return {"failed": str(error)}
