"""What a ranking says at a glance: the best candidate against cDBS, and candidates whose place is not their value's."""

from __future__ import annotations

from collections.abc import Sequence

from app.evaluation.schemas import EstimateOut, RankedPolicy
from ml.ope.flags import Flag


def ranking_notes(policies: Sequence[RankedPolicy], references: Sequence[RankedPolicy], method: str) -> list[Flag]:
    """What stands above a ranking.

    Args:
        policies: candidates; retired ones, and those without an estimate by the method, say nothing here.
        references: policies beside them, cDBS among them or not.
        method: whose estimates rank.
    """
    present = [(p, p.estimates[method]) for p in policies if method in p.estimates and not p.retired]
    supported = [(p, e) for p, e in present if p.supported]
    others = [(p, e) for p, e in present if not p.supported]
    notes = []
    if present and not supported:
        notes.append(Flag("none_supported"))
    cdbs = next((p.estimates[method] for p in references if p.reference == "cdbs" and method in p.estimates), None)
    if cdbs and supported:
        notes += _against_cdbs(cdbs, supported, all(e.value < cdbs.value for _, e in others))
    lowest = min((e.value for _, e in supported), default=float("inf"))
    passed = tuple(f"{p.name} ({e.value:.1f})" for p, e in others if e.value > lowest)
    if passed:
        notes.append(Flag.of("placed_below", policies=passed))
    return notes


def _against_cdbs(cdbs: EstimateOut, supported: Sequence[tuple[RankedPolicy, EstimateOut]], above_all: bool) -> list[Flag]:
    """The best supported candidate against cDBS; nothing to say where its whole interval lies above that of cDBS."""
    best, e = max(supported, key=lambda pair: pair[1].value)
    overlap = e.low <= cdbs.high and cdbs.low <= e.high
    if cdbs.value >= e.value:
        known = cdbs.supported
        return [Flag.of("cdbs_above", e.value, cdbs.value, "reward", best=best.name, supported=known, overlap=overlap, above_all=above_all)]
    if overlap:
        return [Flag.of("cdbs_overlaps", e.value, cdbs.value, "reward", best=best.name, supported=cdbs.supported)]
    return []
