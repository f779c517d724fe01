"""Results of each method on held-out controllers, stored with the evaluation and shown next to the methods.

A method's intervals are widened by it, and the combination of all methods excludes methods whose bias it does not show.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

from app.tables.evaluations import Evaluation
from ml.ope import AGGREGATE, POSTERIOR, Estimate, combine, shown, with_held_out_error

STORED = "held_out"
"""Member of an evaluation's diagnostics."""

Tables = Mapping[str, Mapping[str, Estimate]]


def stored(outcome: Mapping[str, Any] | None, methods: Iterable[str]) -> dict[str, Any]:
    """Convert the results of the methods on held-out controllers to JSON for the evaluation's diagnostics.

    Args:
        outcome: what the compute function `choose_method` gave; None where it was not run. methods: those with estimates.

    Returns:
        `table` of held-out skill, `no_difference_error`, `predictions`, `failed` by method (or one reason for all under the key "") and
        `not_compared`, the methods with estimates that were not tested on held-out controllers.
    """
    held: Mapping[str, Any] = (outcome or {}).get("held_out") or {}
    table = list(held.get("table", []))
    failed = dict(held.get("failed", {})) | ({"": str(outcome["failed"])} if outcome and "failed" in outcome else {})
    return {
        "table": table,
        "no_difference_error": no_difference_error(held.get("predictions", [])),
        "predictions": list(held.get("predictions", [])),
        "failed": failed,
        "not_compared": [m for m in methods if m not in {row["method"] for row in table}],
    }


def of_evaluation(evaluation: Evaluation) -> dict[str, Any]:
    """Return what `stored` gave when an evaluation was made; empty for one without."""
    kept = evaluation.diagnostics.get(STORED) or {}
    return {"table": [], "no_difference_error": None, "predictions": [], "failed": {}, "not_compared": []} | kept if kept else {}


def widened(estimates: Tables, outcome: Mapping[str, Any] | None) -> dict[str, dict[str, Estimate]]:
    """Widen the intervals of the estimates by each method's errors on held-out controllers, where these are known.

    Resampled sessions see how uncertain a model's numbers are, not that the model is wrong. Besides the widened interval an estimate keeps
    `held_out_difference_error`, the error of differences beyond the noise of the observed means, for the interval of a gain. The
    combination takes those of its parts by their weights.
    """
    held: Mapping[str, Any] = (outcome or {}).get("held_out") or {}
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
    """Compute the root mean squared error of predicted differences between two controllers beyond the noise of their observed means, by
    method.

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
    """Compute the error of differences, share of the observed range, of predicting equal returns for all controllers; None below two."""
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


def combined(estimates: Tables, outcome: Mapping[str, Any] | None) -> dict[str, Any]:
    """Combine the methods to one more method's result: `{"estimates": {policy id: Estimate}}` or `{"failed": reason}`.

    The posterior, an average of its own, is no part of it. A method's error has a part that no resampling shows: its bias. Where left-out
    controllers have shown it, only methods of known bias take part, so that an unknown bias is not taken for none.

    Args:
        estimates: method -> policy -> estimate. outcome: of `choose_method`.
    """
    table = ((outcome or {}).get("held_out") or {}).get("table", [])
    bias = {row["method"]: float(row["bias"]) for row in table if row["method"] != AGGREGATE}
    parts = {m: by_policy for m, by_policy in estimates.items() if m not in (AGGREGATE, POSTERIOR) and (not bias or m in bias)}
    if len(parts) < 2:
        spoke = ", ".join(_name(m) for m in parts) or "none"
        return {"failed": f"at least two methods are needed to combine; those that can take part: {spoke}"}
    try:
        return {"estimates": combine(parts, bias or None)}
    except ValueError as error:
        return {"failed": str(error)}
