"""Whether a policy should be tested next, needs more data, or should be rejected: stated rules, each with its reasons as typed flags.

No rule looks at one number alone. The measure is the gain over cDBS, because what a method gets wrong for all policies cancels in it, and
its lower 95 % bound, because a policy that may be worse than today's treatment has no claim to a patient's time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from app.evaluation.schemas import Decision, TestedBefore
from ml.ope.compare.skill import reach_with
from ml.ope.estimate import Estimate
from ml.ope.flags import Flag
from ml.ope.support.coverage import UNSUPPORTED_SHARE, thin
from ml.returns import FEWEST_DRAWS, Gain, gain

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


def gain_over(policy: Estimate, reference: Estimate) -> Gain:
    """Difference of two estimates of one method: over their aligned draws, in which what both share cancels, where both kept them.

    The interval is widened by the method's error of differences between controllers that it had not seen, where that is known.
    """
    value = policy.value - reference.value
    unseen = float(policy.details.get("held_out_difference_error", 0.0))
    ours, theirs = (np.asarray(e.details.get("draws") or [], dtype=np.float64) for e in (policy, reference))
    tail = (1 - policy.level) / 2
    if ours.size == theirs.size >= FEWEST_DRAWS:
        drawn = gain(ours, theirs, 1 - tail)
        below, above = max(drawn.value - drawn.low, 0.0), max(drawn.high - drawn.value, 0.0)
        error = math.hypot(drawn.standard_error, unseen)
        return Gain(value, value - reach_with(below, unseen), error, value + reach_with(above, unseen), policy.level)
    errors = [math.sqrt(max(0.0, e.standard_error**2 - e.details.get("held_out_error", 0.0) ** 2)) for e in (policy, reference)]
    reach = reach_with(float(norm.ppf(1 - tail)) * math.hypot(*errors), unseen)
    return Gain(value, value - reach, math.hypot(*errors, unseen), value + reach, policy.level)


class Decided(NamedTuple):
    """A decision and what it rests on, in the order in which it was looked at; `wording.decision` makes a sentence of it."""

    decision: Decision
    reasons: tuple[Flag, ...]


def decide(
    estimates: Mapping[str, Estimate],
    cdbs: Mapping[str, Estimate],
    method: str,
    *,
    retired_reason: str | None = None,
    tested: TestedBefore | None = None,
    unchecked: str | None = None,
) -> Decided:
    """The decision on one candidate and its reasons.

    Args:
        estimates: of the candidate, by method. cdbs: of the cDBS reference, by method; empty where it has none.
        method: the ranking's.
        retired_reason: why a person withdrew it. tested: what its sessions returned.
        unchecked: why what the data cover could not be checked; None where it was.
    """
    if retired_reason:
        return Decided("reject", (Flag.of("retired", text=retired_reason),))
    own, reference = estimates.get(method), cdbs.get(method)
    if own is None:
        return Decided("needs_data", (Flag.of("no_estimate", method=method),))
    if not own.supported:
        return Decided("needs_data", failing_checks(own))
    if unchecked is not None:
        return Decided("needs_data", (Flag.of("coverage_unchecked", text=unchecked),))
    if reference is None:
        return Decided("needs_data", (Flag("reference_missing"),))
    if not reference.supported:
        return Decided("needs_data", (Flag("reference_unsupported"), *failing_checks(reference)))
    over = gain_over(own, reference)
    widened = "held_out_difference_error" in own.details
    found = Flag.of(
        "gain", over.value, 0.0, "reward", low=over.low, high=over.high, level=over.level, method=method, widened=widened
    )  # fmt: skip
    if over.high < 0:
        return Decided("reject", (found, Flag("all_below_zero", over.high, 0.0, "reward")))
    if over.low <= 0:
        return Decided("needs_data", (found, Flag("may_be_none", over.low, 0.0, "reward")))
    doubts = (*_symptoms(own, reference), *_disagreement(estimates, cdbs, method), *_experience(own, tested))
    if doubts:
        return Decided("needs_data", (found, *doubts))
    return Decided("test_next", (found, Flag("nothing_against", over.low, 0.0, "reward")))


def failing_checks(estimate: Estimate) -> tuple[Flag, ...]:
    """Why an estimate is not supported: the first flag that refuses it, else what its simulated sessions showed, else all that is known.

    Estimates stored by betaloop 0.1.0 have sentences for flags, and only their numbers are looked at.
    """
    refusing = next((flag for flag in estimate.flags if flag.refuses), None)
    if refusing is not None:
        return (refusing,)
    share = (estimate.details.get("coverage_simulated") or {}).get("thin", 0.0)
    if share > UNSUPPORTED_SHARE:
        return (thin(share, "simulated"),)
    return (Flag("not_supported"), *estimate.flags)


def _symptoms(own: Estimate, reference: Estimate) -> list[Flag]:
    checks = (
        ("rating_lower", "rating", "points", -1, RATING_POINTS, 0.0),
        ("tremor_higher", "tremor_percent", "percent of time", 1, TREMOR_POINTS, 0.0),
        ("grasp_slower", "grasp_hz", "Hz", -1, 0.0, GRASP_SHARE),
    )
    found = []
    for code, name, unit, worse, points, share in checks:
        ours, theirs = own.predicted.get(name), reference.predicted.get(name)
        if ours is None or theirs is None:
            continue
        limit = theirs * (1 + worse * share) + worse * points
        if worse * (ours - limit) > 0:
            found.append(Flag.of(code, ours, limit, unit, cdbs=theirs))
    return found


def _disagreement(estimates: Mapping[str, Estimate], cdbs: Mapping[str, Estimate], method: str) -> list[Flag]:
    """Other methods that support both and whose whole interval of the gain lies below 0."""
    found = []
    for other, estimate in estimates.items():
        reference = cdbs.get(other)
        if other == method or reference is None or not (estimate.supported and reference.supported):
            continue
        over = gain_over(estimate, reference)
        if over.high < 0:
            found.append(Flag.of("method_sees_loss", over.value, 0.0, "reward", method=other, low=over.low, high=over.high))
    return found


def _experience(own: Estimate, tested: TestedBefore | None) -> list[Flag]:
    if tested is None or tested.sessions_with_return < FEWEST_TESTED or tested.mean_return is None or own.end_reward is None:
        return []
    if tested.mean_return >= own.low:
        return []
    return [Flag.of("returned_less", tested.mean_return, own.low, "reward", sessions=float(tested.sessions_with_return))]
