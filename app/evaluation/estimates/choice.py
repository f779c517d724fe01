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

from ml.ope.compare.aggregate import combine
from ml.ope.compare.ranking import default_method
from ml.ope.compare.skill import with_held_out_error
from ml.ope.estimate import Estimate
from ml.ope.flags import Flag
from ml.ope.registry import AGGREGATE, preference, shown

Tables = Mapping[str, Mapping[str, Estimate]]


def choose(estimates: Tables, outcome: Mapping[str, Any] | None) -> dict[str, Any]:
    """The default method of a ranking, JSON-able for the evaluation's diagnostics.

    Args:
        estimates: method -> candidate -> estimate; every method that could speak.
        outcome: what the compute function `choose_method` gave; None where it was not run.

    Returns:
        `method`, `chosen_by_data`, `reasons` (flags as JSON), `table` of held-out skill, `no_difference_error`, `predictions`, `failed` and
        `not_compared`, the methods with estimates that were not held against left-out controllers.

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
        method, reasons = _by_skill(estimates, held, base)
        if method is not None:
            return result | {"method": method, "chosen_by_data": True, "reasons": [r.to_json() for r in reasons]}
    elif outcome is None:
        reasons = [Flag("not_compared")]
    elif "failed" in outcome:
        reasons = [Flag.of("cannot_choose", text=str(outcome["failed"]))]
    else:
        reasons = stored_reasons(held)
    usual = Flag.of("usual_order", methods=tuple(m for m in preference() if m in estimates))
    return result | {"method": default_method(estimates), "chosen_by_data": False, "reasons": [r.to_json() for r in (*reasons, usual)]}


def stored_reasons(choice: Mapping[str, Any]) -> list[Flag]:
    """The reasons of a stored choice; betaloop 0.1.0 stored one sentence."""
    return [Flag.from_json(r) for r in choice.get("reasons", [choice["reason"]] if "reason" in choice else [])]


def _by_skill(estimates: Tables, held: Mapping[str, Any], base: float | None) -> tuple[str | None, list[Flag]]:
    """The most skilful method that supports a candidate with the reasons; None with the reasons against all of them.

    A method whose error of differences is no less than `base`, that of calling all controllers alike, has no skill to be chosen for.
    """
    first, most = str(held["method"]), max((row["controllers"] for row in held["table"]), default=0)
    errors = {row["method"]: float(row["difference_error"]) for row in held["table"] if row["controllers"] == most}
    skilled = [m for m in dict.fromkeys([first, *errors]) if m in errors and (base is None or errors[m] < base)]
    able = [m for m in skilled if _supports(estimates.get(m, {}))]
    if not skilled:
        return None, [Flag("no_skill")]
    if able[:1] == [first]:
        return first, stored_reasons(held)
    doubt = Flag.of("best_supports_none" if estimates.get(skilled[0]) else "best_has_no_estimate", method=skilled[0])
    if not able:
        return None, [doubt, Flag("nor_another")] if len(skilled) > 1 else [doubt]
    if able[0] == skilled[0]:
        return able[0], [Flag.of("skilled", method=able[0])]
    return able[0], [doubt, Flag.of("best_of_supporting", method=able[0])]


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
    return shown(method).name


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
