"""Meanings of markers and channels as a lab states them, once for all of its recordings; and the questions about those without one."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeVar, get_args

from ml.formats.dose import UPPER_PLAUSIBLE_MA
from ml.formats.labs.content import Channel, Content, Course
from ml.formats.labs.marks import UNCLEAR, Side, Statement, parse, render
from ml.formats.labs.names import MA, TURNS

Amplitude = TypeVar("Amplitude", Channel, Course)
Means = Literal["nothing", "off", "amplitude", "stated", "unknown", "unit", "lever"]
MEANS: tuple[str, ...] = get_args(Means)
AMPLITUDE_UNITS = (*MA, "V")
"""Units of an amplitude channel. One in V is no current, so that the dose stays unknown."""
MOST_QUESTIONS = 60
CHANNEL_KEY, LEVER_KEY = "channel ", "gyroscope "
LONGEST_LEVER_CM = 100.0


@dataclass(frozen=True, slots=True)
class Meaning:
    """Meaning of a marker, or the unit of an amplitude channel.

    Attributes:
        means: one of `MEANS`. `stated`: the amplitude in mA among its words holds. `unknown`: the amplitude is unknown after it.
        amplitude_ma: in force from the marker on, with `amplitude` alone.
        side: of the stimulation, where the marker names none; None: both.
        unit: one of `AMPLITUDE_UNITS`, with `unit` alone.
        lever_cm: from the joint about which a gyroscope turns to the fingertip, with `lever` alone.
    """

    means: Means
    amplitude_ma: float | None = None
    side: Side | None = None
    unit: str = ""
    lever_cm: float | None = None

    def __post_init__(self) -> None:
        amplitude = self.amplitude_ma
        if self.means not in MEANS or (self.means == "amplitude") != (amplitude is not None) or (self.means == "unit") != bool(self.unit):
            raise ValueError("an amplitude has a number, a unit has its name, and no other meaning has either")
        if (self.means == "lever") != (self.lever_cm is not None) or not 1 <= (self.lever_cm or 1) <= LONGEST_LEVER_CM:
            raise ValueError(f"a lever alone has a length, 1 to {LONGEST_LEVER_CM:g} cm")
        if amplitude is not None and not 0 <= amplitude < UPPER_PLAUSIBLE_MA:
            raise ValueError(f"an amplitude is at least 0 and below {UPPER_PLAUSIBLE_MA:g} mA, not {amplitude:g} mA")
        if self.unit and self.unit not in AMPLITUDE_UNITS:
            raise ValueError(f"the unit is one of {', '.join(AMPLITUDE_UNITS)}, not '{self.unit}'")

    def apply(self, statement: Statement) -> Statement:
        """Return the dose that a marker states under this meaning; a side that it names itself stays."""
        side = statement.side or self.side
        if self.means == "nothing":
            return Statement()
        if self.means in ("off", "amplitude"):
            on = False if self.means == "off" else None
            return replace(statement, on=on, side=side, amplitude_ma=self.amplitude_ma, volts=None, mentions=True, clear=True)
        if self.means == "stated":
            return replace(statement, side=side, mentions=True, clear=statement.amplitude_ma is not None)
        return replace(statement, side=side, mentions=True, clear=False)


@dataclass(frozen=True, slots=True)
class Question:
    """Marker or channel whose meaning is not known.

    Attributes:
        key: of its meaning. shown: words for a person. count: of its marks, 0 of a channel.
        first_s, last_s: of its marks in the recording, s. states_ma: amplitude that is among its words.
        asked: whether the dose is unknown for want of its meaning.
    """

    key: str
    shown: str
    count: int
    first_s: float | None
    last_s: float | None
    states_ma: float | None
    asked: bool


def explain(content: Content, meanings: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Apply stated meanings to markers and channels; returns those that were used, by key."""
    used: dict[str, Mapping[str, Any]] = {}

    def meaning(key: str) -> Meaning | None:
        if key not in meanings:
            return None
        used[key] = meanings[key]
        return Meaning(**meanings[key])

    for i, mark in enumerate(content.marks):
        found = parse(mark.label)
        if found.key and (stated := meaning(found.key)) is not None and stated.means != "unit":
            content.marks[i] = replace(mark, explained=stated.apply(found))
    if key := lever_key(content):
        meaning(key)
    content.channels[:] = [_with_unit(c, meaning) for c in content.channels]
    content.courses[:] = [_with_unit(c, meaning) for c in content.courses]
    return used


def _with_unit(part: Amplitude, meaning: Callable[[str], Meaning | None]) -> Amplitude:
    """Give an amplitude channel its stated unit, where the file states no current."""
    if not _lacks_unit(part) or (stated := meaning(CHANNEL_KEY + part.shown)) is None:
        return part
    return replace(part, unit=stated.unit)


def _lacks_unit(part: Channel | Course) -> bool:
    return part.name.kind == "stimulation" and part.unit not in MA


def open_questions(content: Content, answers: Mapping[str, Any], origin_s: float) -> list[dict[str, Any]]:
    """List what has no meaning yet, as JSON: first what leaves the dose unknown, then by number of marks."""
    found = [*_of_channels(content, answers), *_of_marks(content, answers, origin_s)]
    return [asdict(q) for q in sorted(found, key=lambda q: (not q.asked, -q.count, q.key))[:MOST_QUESTIONS]]


def _of_channels(content: Content, answers: Mapping[str, Any]) -> Iterator[Question]:
    parts: list[Channel | Course] = [*content.channels, *content.courses]
    for name in dict.fromkeys(part.shown for part in parts if _lacks_unit(part)):
        if CHANNEL_KEY + name not in answers:
            yield Question(CHANNEL_KEY + name, f"amplitude channel {name}: its unit", 0, None, None, None, True)
    if (key := lever_key(content)) and key not in answers:
        yield Question(key, f"{key}: from the joint that it turns about to the fingertip", 0, None, None, None, False)


def lever_key(content: Content) -> str:
    """Return the key of the lever of the only gyroscope; empty where there is none, or several."""
    groups = {c.group: c.name.side for c in content.channels if c.name.kind == "rotation" and c.unit in TURNS}
    return f"{LEVER_KEY}{next(iter(groups.values())) or 'hand'}" if len(groups) == 1 else ""


def _of_marks(content: Content, answers: Mapping[str, Any], origin_s: float) -> Iterator[Question]:
    times: dict[str, list[float]] = defaultdict(list)
    statements: dict[str, Statement] = {}
    for mark in content.marks:
        found = parse(mark.label)
        if found.key and found.key not in answers:
            times[found.key].append(mark.t_s - origin_s)
            statements.setdefault(found.key, found)
    for key, at in times.items():
        found = statements[key]
        words = found.code or found.shown or render(replace(found, words="")).removeprefix(UNCLEAR).strip()
        yield Question(key, words, len(at), round(min(at), 1), round(max(at), 1), found.amplitude_ma, found.mentions)
