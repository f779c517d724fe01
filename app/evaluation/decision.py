"""Whether a policy should be tested next, needs more data, or should be rejected: stated rules, each with its reason in words.

No rule looks at one number alone. The measure is the gain over cDBS, because what a method gets wrong for all policies cancels in it, and
its lower 95 % bound, because a policy that may be worse than today's treatment has no claim to a patient's time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from app.evaluation.estimates.methods import METHOD_NAMES
from app.evaluation.schemas import Decision, TestedBefore
from ml.ope.compare.skill import reach_with
from ml.ope.estimate import Estimate
from ml.ope.support.coverage import UNSUPPORTED_SHARE

FEWEST_DRAWS = 20
"""Aligned draws below which a gain's interval comes from the two standard errors as if they were independent, which is wider."""

RATING_POINTS, TREMOR_POINTS, GRASP_SHARE = 1.0, 10.0, 0.10
"""A predicted rating lower, a tremor higher (percentage points of time) or a grasp slower by more than this is worse than under cDBS."""

FEWEST_TESTED = 3
"""Sessions of a policy from which its actual return speaks against an estimate."""

RULES = (
    "Reject: it was retired, or the whole interval of its gain over cDBS lies below 0.",
    "Needs more data: the data do not support its estimate, or that of cDBS; or what they cover could not be checked; or its gain over "
    "cDBS may be 0 or less (lower 95 % bound).",
    f"Needs more data, although the gain is above 0: its rating is predicted more than {RATING_POINTS:g} point lower than under cDBS, its "
    f"tremor more than {TREMOR_POINTS:g} percentage points higher or its grasp more than {100 * GRASP_SHARE:.0f} % slower; or another "
    f"method sees a loss; or at least {FEWEST_TESTED} sessions of it returned less than the estimate's lower bound.",
    "Test next: none of these.",
)
"""What the page prints; `decide` follows them."""


@dataclass(frozen=True)
class Gain:
    """Estimated return less that of a reference, with a two-sided interval of `level`."""

    value: float
    low: float
    high: float
    level: float


def gain_over(policy: Estimate, reference: Estimate) -> Gain:
    """Difference of two estimates of one method: over their aligned draws, in which what both share cancels, where both kept them.

    The interval is widened by the method's error of differences between controllers that it had not seen, where that is known.
    """
    value = policy.value - reference.value
    unseen = float(policy.details.get("held_out_difference_error", 0.0))
    ours, theirs = (np.asarray(e.details.get("draws") or [], dtype=np.float64) for e in (policy, reference))
    tail = (1 - policy.level) / 2
    if ours.size == theirs.size >= FEWEST_DRAWS:
        differences = ours - theirs
        low, high = np.quantile(differences - differences.mean(), [tail, 1 - tail]) + value
        below, above = max(value - float(low), 0.0), max(float(high) - value, 0.0)
        return Gain(value, value - reach_with(below, unseen), value + reach_with(above, unseen), policy.level)
    errors = [math.sqrt(max(0.0, e.standard_error**2 - e.details.get("held_out_error", 0.0) ** 2)) for e in (policy, reference)]
    reach = reach_with(float(norm.ppf(1 - tail)) * math.hypot(*errors), unseen)
    return Gain(value, value - reach, value + reach, policy.level)


def decide(
    estimates: Mapping[str, Estimate],
    cdbs: Mapping[str, Estimate],
    method: str,
    *,
    retired_reason: str | None = None,
    tested: TestedBefore | None = None,
    unchecked: str | None = None,
) -> tuple[Decision, str]:
    """The decision on one candidate and its reason.

    Args:
        estimates: of the candidate, by method. cdbs: of the cDBS reference, by method; empty where it has none.
        method: the ranking's.
        retired_reason: why a person withdrew it. tested: what its sessions returned.
        unchecked: why what the data cover could not be checked; None where it was.
    """
    if retired_reason:
        return "reject", f"retired: {retired_reason}"
    own, reference = estimates.get(method), cdbs.get(method)
    name = METHOD_NAMES.get(method, method)
    if own is None:
        return "needs_data", f"{name} has no estimate of it"
    if not own.supported:
        return "needs_data", failing_check(own)
    if unchecked is not None:
        return "needs_data", f"what the data cover could not be checked: {unchecked}"
    if reference is None or not reference.supported:
        why = "has no estimate" if reference is None else f"is itself {failing_check(reference)}"
        return "needs_data", f"the cDBS reference, which it is held against, {why}"
    gain = gain_over(own, reference)
    words = f"gain over cDBS {_signed(gain.value)}, {100 * gain.level:.0f} % interval {_signed(gain.low)} to {_signed(gain.high)}"
    if "held_out_difference_error" not in own.details:
        words += f" (not widened: how {name} errs on controllers that it has not seen is not known)"
    if gain.high < 0:
        return "reject", f"{words}: all of it below 0"
    if gain.low <= 0:
        return "needs_data", f"{words}: it may be none"
    doubts = [*_symptoms(own, reference), *_disagreement(estimates, cdbs, method), *_experience(own, tested)]
    if doubts:
        return "needs_data", f"{words}, but {'; '.join(doubts)}"
    return "test_next", f"{words}: its lower 95 % bound is above 0, and no other check speaks against it"


def failing_check(estimate: Estimate) -> str:
    """Why an estimate is not supported: its flag that says so, else what its simulated sessions showed, which flags may leave out."""
    named = next((flag for flag in estimate.flags if "not supported" in flag), None)
    if named is not None:
        return named
    thin = (estimate.details.get("coverage_simulated") or {}).get("thin", 0.0)
    if thin > UNSUPPORTED_SHARE:
        return (
            f"not supported by the data: in {100 * thin:.0f} % of the steps of its simulated sessions it asks for amplitudes with "
            "hardly any logged step near them"
        )
    return "; ".join(("not supported by the data", *estimate.flags))


def _symptoms(own: Estimate, reference: Estimate) -> list[str]:
    ours, theirs = own.predicted, reference.predicted
    found = []
    if "rating" in ours and "rating" in theirs and ours["rating"] < theirs["rating"] - RATING_POINTS:
        found.append(f"its rating is predicted at {ours['rating']:.1f} against {theirs['rating']:.1f} under cDBS")
    if "tremor_percent" in ours and "tremor_percent" in theirs and ours["tremor_percent"] > theirs["tremor_percent"] + TREMOR_POINTS:
        found.append(f"its tremor is predicted at {ours['tremor_percent']:.0f} % against {theirs['tremor_percent']:.0f} % under cDBS")
    if "grasp_hz" in ours and "grasp_hz" in theirs and ours["grasp_hz"] < theirs["grasp_hz"] * (1 - GRASP_SHARE):
        found.append(f"its grasp is predicted at {ours['grasp_hz']:.2f} Hz against {theirs['grasp_hz']:.2f} Hz under cDBS")
    return found


def _disagreement(estimates: Mapping[str, Estimate], cdbs: Mapping[str, Estimate], method: str) -> list[str]:
    """Other methods that support both and whose whole interval of the gain lies below 0."""
    found = []
    for other, estimate in estimates.items():
        reference = cdbs.get(other)
        if other == method or reference is None or not (estimate.supported and reference.supported):
            continue
        gain = gain_over(estimate, reference)
        if gain.high < 0:
            found.append(f"{METHOD_NAMES.get(other, other)} sees a loss ({_signed(gain.low)} to {_signed(gain.high)})")
    return found


def _experience(own: Estimate, tested: TestedBefore | None) -> list[str]:
    if tested is None or tested.sessions_with_return < FEWEST_TESTED or tested.mean_return is None or own.end_reward is None:
        return []
    if tested.mean_return >= own.low:
        return []
    return [f"its {tested.sessions_with_return} sessions returned {tested.mean_return:.1f} on average, below the estimate's {own.low:.1f}"]


def _signed(value: float) -> str:
    shown = round(value, 1)
    return f"{shown:+.1f}".replace("-", "\N{MINUS SIGN}") if shown else "0.0"
