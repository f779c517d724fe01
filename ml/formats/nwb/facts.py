"""Facts of NWB files: whose clock their times show, what is no reading, what changes the dose."""

from __future__ import annotations

from ml.formats.facts import ClockFact, DoseModifier, Facts
from ml.formats.facts.sentinels import Field

_SCHEMA = "NWB 2 schema"

FACTS = Facts(
    clocks=(
        ClockFact("computer", "timestamps_reference_time, session_start_time", "its own offset from UTC; without one unknown", _SCHEMA),
        ClockFact("computer", "timestamps, or starting_time and rate", "seconds after the reference time", _SCHEMA),
    ),
    counters={},
    fields={"amplitude series in mA": Field("mA", 0, 25.5, (), "no implant gives more; a value outside is unknown")},
    dose=(
        DoseModifier(
            "events", "TimeIntervals, EventsTable, AnnotationSeries", "each holds for its duration, or until the next", "their text"
        ),
        DoseModifier(
            "a gap of the samples", "timestamps, invalid_times", "unknown until the next event", "assumed: none is recorded in a gap"
        ),
        DoseModifier("a gap within an event of known duration", "stop_time, duration", "none", "the event states that it lasts"),
    ),
)
