"""Facts of BIDS folders: whose clock their times show, what is no reading, what changes the dose."""

from __future__ import annotations

from ml.formats.facts import ClockFact, DoseModifier, Facts
from ml.formats.facts.sentinels import Field

_SPEC = "BIDS 1.10"

FACTS = Facts(
    clocks=(
        ClockFact("computer", "acq_time of scans.tsv, where the data file has no date", "UTC with Z, else unknown", _SPEC),
        ClockFact("computer", "onset of events.tsv", "seconds after the first sample of the data file", _SPEC),
    ),
    counters={},
    fields={"amplitude in events.tsv": Field("mA", 0, 25.5, (), "no implant gives more; a value outside is unknown")},
    dose=(
        DoseModifier(
            "events", "events.tsv, its amplitude in the unit of events.json", "each holds for its duration, or until the next", _SPEC
        ),
        DoseModifier("sample", "events.tsv", "unknown after an event whose sample is not at its onset", "both are stated"),
        DoseModifier("stimulation", "ElectricalStimulationParameters of the sidecar", "none: it has no time", _SPEC),
    ),
)
