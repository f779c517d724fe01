"""Facts of EDF files: whose clock their dates show, what is no reading, what changes the dose."""

from __future__ import annotations

from ml.formats.facts import ClockFact, DoseModifier, Facts
from ml.formats.facts.sentinels import Field

FACTS = Facts(
    clocks=(
        ClockFact("computer", "startdate, starttime", "unknown: a local time without its offset", "EDF specification, 1992"),
        ClockFact("computer", "time-keeping annotation of each record", "seconds after the start", "EDF+ specification, 2003"),
    ),
    counters={},
    fields={"amplitude channel in mA": Field("mA", 0, 25.5, (), "no implant gives more; a value outside is unknown")},
    dose=(
        DoseModifier(
            "annotations", "EDF Annotations", "each holds until the next, or for its duration; unknown before the first", "their text"
        ),
        DoseModifier("a gap of EDF+D", "time-keeping annotations", "unknown until the next annotation", "none is recorded in a gap"),
    ),
)
