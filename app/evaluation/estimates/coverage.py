"""Coverage of each policy by the data: checks that are made before any estimate and stored with the evaluation.

A check that refuses a policy counts for every method; a note informs those who pick the policy and refuses nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from app.evaluation.schemas import CheckOut, CoverageOut
from app.evaluation.wording import flag_out
from app.tables.evaluations import Evaluation
from ml.ope import Estimate, Flag, distinct

STORED = "coverage"
"""Member of an evaluation's diagnostics."""

VERDICTS: dict[str, tuple[str, str]] = {
    "passed": ("passed", "good"),
    "refused": ("failed", "bad"),
    "weights": ("too few", ""),
    "noted": ("to know", "warn"),
    "told": ("for information", ""),
}
"""Word and tone of each verdict."""


@dataclass(frozen=True)
class CheckText:
    """A check for a clinician: a short name, what is counted, and what it means."""

    label: str
    unit: str
    meaning: str


CHECKS: dict[str, CheckText] = {
    "outside_range": CheckText(
        "Outside the logged amplitudes",
        "% of steps",
        "How often the policy asks for an amplitude below the lowest or above the highest that any session held. Nothing is known there.",
    ),
    "thin": CheckText(
        "Amplitudes hardly tried",
        "% of steps",
        "How often it asks for an amplitude that hardly any logged step came near. Those outside the logged amplitudes count here too.",
    ),
    "far": CheckText(
        "Unlike any logged moment",
        "% of steps",
        "How often beta and the amplitude together lie further from every logged moment of another session than twice the distance that "
        "holds 95 % of the logged moments: an amplitude may be well known, and yet not at such beta.",
    ),
    "below_random_bound": CheckText(
        "Below the random controller",
        "% of steps",
        "How often it asks for less than B, the least that the random controller gave. Only sessions of other controllers speak there.",
    ),
    "unseen_dose": CheckText(
        "Dose that no session held",
        "% of steps",
        "How often its average amplitude of the last minute is one that no session kept up. What a lasting low dose does is then a "
        "model's guess.",
    ),
    "distance": CheckText(
        "Distance to the logged moments",
        "1 holds 95 % of them",
        "How far the policy's moments lie from the nearest logged moment of another session, in the middle of all its moments.",
    ),
    "effective_sessions": CheckText(
        "Sessions that speak for it",
        "effective sessions",
        "How many sessions the importance weights rest on when they are reweighted to what the policy would have done. It concerns "
        "importance sampling alone; over a whole session it is nearly always too few.",
    ),
    "largest_weight_share": CheckText(
        "Heaviest session", "% of all weight", "The share of all importance weight that one session carries."
    ),
    "horizon_of_ten": CheckText(
        "Steps with ten sessions",
        "steps",
        "How many steps it takes until the running importance weights rest on fewer than ten effective sessions: the horizon over which "
        "importance sampling can speak.",
    ),
}
"""In the order of the page; the names are those of `ml.ope.support.diagnostics`."""

_SHARES = {"outside_range", "thin", "far", "below_random_bound", "unseen_dose", "largest_weight_share"}


def refused(estimates: Mapping[str, Mapping[str, Estimate]], outcome: Mapping[str, Any] | None) -> dict[str, dict[str, Estimate]]:
    """Mark the estimates of refused policies as not supported, by every method, the failing checks first among their flags.

    Args:
        estimates: method -> policy id -> estimate.
        outcome: what the compute function `check_coverage` gave; None where it was not run.
    """
    checked: Mapping[str, Any] = (outcome or {}).get("policies") or {}

    def marked(policy_id: str, e: Estimate) -> Estimate:
        found = checked.get(policy_id) or {}
        failing = _flags(found, "failing")
        return replace(e, supported=False, flags=distinct((*failing, *e.flags))) if failing else e

    return {m: {i: marked(i, e) for i, e in table.items()} for m, table in estimates.items()}


def coverage_by_policy(evaluation: Evaluation) -> dict[int, CoverageOut]:
    """Return the checks of every policy of an evaluation; empty for one that was made before they were stored, or where they failed."""
    stored = evaluation.diagnostics.get(STORED) or {}
    return {int(i): _out(found) for i, found in stored.get("policies", {}).items()}


def coverage_failed(evaluation: Evaluation) -> str | None:
    """Explain why nothing could be checked; None where it was, or where the evaluation was made before checks were stored."""
    reason = (evaluation.diagnostics.get(STORED) or {}).get("failed")
    return None if reason is None else str(reason)


def _out(found: Mapping[str, Any]) -> CoverageOut:
    checks = [CheckOut.model_validate(c) for c in found["checks"]]
    return CoverageOut(
        supported=bool(found["supported"]),
        sessions=found["sessions"],
        checks=checks,
        failing=[flag_out(f) for f in _flags(found, "failing")],
        notes=[flag_out(f) for f in _flags(found, "notes")],
        weights_failing=[flag_out(f) for f in _flags(found, "weights_failing")],
    )


def _flags(found: Mapping[str, Any], name: str) -> list[Flag]:
    return [Flag.from_json(stored) for stored in found.get(name, [])]


def shown_value(check: CheckOut, sessions: int | None = None) -> str:
    """Write a check's value for the page, with its total where that helps."""
    if check.value is None:
        return "\u2014"
    if check.name in _SHARES:
        return f"{_percent(check.value)} %"
    if check.name == "effective_sessions":
        return f"{check.value:.1f}" + (f" of {sessions}" if sessions is not None else "")
    if check.name == "horizon_of_ten":
        return f"{check.value:.0f}" + (f" of {check.limit:.0f}" if check.limit is not None else "")
    return f"{check.value:.2f}"


def shown_limit(check: CheckOut) -> str:
    """Write a check's limit for the page; empty where it has none."""
    if check.limit is None:
        return ""
    words = "at least" if check.at_least else "at most"
    return f"{words} {100 * check.limit:.0f} %" if check.name in _SHARES else f"{words} {check.limit:.0f}"


def _percent(share: float) -> str:
    """Write a share in percent; a small one does not look like nothing."""
    return "< 1" if 0 < share < 0.005 else f"{100 * share:.0f}"


def refusals(checks: Sequence[CheckOut]) -> list[str]:
    """List labels of the checks that refuse a policy."""
    return [CHECKS[c.name].label for c in checks if c.verdict == "refused" and c.name in CHECKS]
