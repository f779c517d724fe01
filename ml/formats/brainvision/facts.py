"""Facts of BrainVision recordings: whose clock their dates show, what is no reading, what changes the dose."""

from __future__ import annotations

from ml.formats.facts import ClockFact, DoseModifier, Facts
from ml.formats.facts.sentinels import Field

_DATES = "dates of New Segment markers"

FACTS = Facts(
    clocks=(ClockFact("computer", _DATES, "unknown: a local time without its offset", "BrainVision Core Data Format 1.0"),),
    counters={},
    fields={"amplitude channel in mA": Field("mA", 0, 25.5, (), "no implant gives more; a value outside is unknown")},
    dose=(
        DoseModifier("markers", "Mk entries", "each holds until the next; unknown before the first", "their description"),
        DoseModifier("a gap between segments", _DATES, "unknown until the next marker", "none is recorded in a gap"),
    ),
)
