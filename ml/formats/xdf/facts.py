"""Facts of XDF files: whose clock their stamps show, what is no reading, what changes the dose."""

from __future__ import annotations

from ml.formats.facts import ClockFact, DoseModifier, Facts
from ml.formats.facts.sentinels import Field

FACTS = Facts(
    clocks=(
        ClockFact(
            "computer", "stamps of samples", "clock offsets of each stream bring them to the recorder's clock", "XDF 1.0, ClockOffset"
        ),
        ClockFact("computer", "datetime of the file's header", "its own offset from UTC; without one unknown", "XDF 1.0, FileHeader"),
    ),
    counters={},
    fields={"amplitude in mA": Field("mA", 0, 25.5, (), "no implant gives more; a value outside is unknown")},
    dose=(
        DoseModifier("markers", "streams of text", "each holds until the next; unknown before the first", "what a marker states"),
        DoseModifier("damage", "a lost chunk", "unknown until the next marker", "a marker could have been in it"),
    ),
)
