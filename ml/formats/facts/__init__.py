"""Facts about a format that decide which amplitude was on and when: clocks, counters, fields without a reading, changes of the dose.

Each package of a format has one `FACTS`, and docs/ingest/facts.md has them all as a table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ml.formats.facts.clocks import Clock
from ml.formats.facts.counters import Counter
from ml.formats.facts.sentinels import Field


@dataclass(frozen=True, slots=True)
class ClockFact:
    """Clock that some fields of a format show.

    Attributes:
        clock: the clock. fields: that show it. offset: how its offset from UTC is known. source: of the fact.
    """

    clock: Clock
    fields: str
    offset: str
    source: str


@dataclass(frozen=True, slots=True)
class DoseModifier:
    """A setting by which the delivered amplitude is not the one that the file states.

    Attributes:
        name: of the setting. fields: where the file has it. effect: what the decoder does. source: of the fact.
    """

    name: str
    fields: str
    effect: str
    source: str


@dataclass(frozen=True, slots=True)
class Facts:
    """All facts of one format; counters and fields by their name in the file."""

    clocks: tuple[ClockFact, ...]
    counters: Mapping[str, Counter]
    fields: Mapping[str, Field]
    dose: tuple[DoseModifier, ...]
