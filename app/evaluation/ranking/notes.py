"""What a ranking says at a glance: the best candidate against cDBS, and candidates whose place is not their value's."""

from __future__ import annotations

from collections.abc import Sequence

from app.evaluation.schemas import EstimateOut, RankedPolicy


def ranking_notes(policies: Sequence[RankedPolicy], references: Sequence[RankedPolicy], method: str) -> list[str]:
    """Sentences above a ranking.

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
        notes.append("No candidate is supported by the data: these estimates cannot say whether one improves on cDBS.")
    cdbs = next((p.estimates[method] for p in references if p.reference == "cdbs" and method in p.estimates), None)
    if cdbs and supported:
        notes += _against_cdbs(cdbs, supported, all(e.value < cdbs.value for _, e in others))
    passed = [f"{p.name} ({e.value:.1f})" for p, e in others if supported and e.value > min(s.value for _, s in supported)]
    if passed:
        notes.append(
            "Policies that the data do not support stand below all supported ones, whatever their estimated value: "
            + f"{', '.join(passed)}."
        )
    return notes


def _against_cdbs(cdbs: EstimateOut, supported: Sequence[tuple[RankedPolicy, EstimateOut]], others_below: bool) -> list[str]:
    """The best supported candidate against cDBS; nothing to say where its whole interval lies above that of cDBS."""
    best, e = max(supported, key=lambda pair: pair[1].value)
    reference = "The cDBS reference" + ("" if cdbs.supported else ", which the data do not support,")
    overlap = e.low <= cdbs.high and cdbs.low <= e.high
    if cdbs.value >= e.value:
        which = "candidate" if others_below else "supported candidate"
        doubt = " The intervals overlap." if overlap else ""
        return [
            f"{reference} is estimated at {cdbs.value:.1f}, above every {which} (best: {best.name}, {e.value:.1f}): "
            f"by this estimate no {which} improves on cDBS in return.{doubt}"
        ]
    if overlap:
        return [
            f"{reference} is estimated at {cdbs.value:.1f}, the best candidate, {best.name}, at {e.value:.1f}; the intervals overlap: "
            "whether it improves on cDBS in return is open."
        ]
    return []
