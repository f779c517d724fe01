"""Annotations and symptom ratings of a Percept report, under whatever keys its version writes them.

Their keys differ between versions and are in no public document, so they are found by their words. Below a key about annotations, ratings,
scores, symptoms or notes, every object with a time is one. Three things of it stay: its time, a number from 0 to 100 under a key of known
words, and a text of known words alone. Both the original report and the redacted one give the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Any

from ml.formats.percept.report_json import entries, finite, moment, packet_list
from ml.formats.percept.words import SYMPTOMS, cleaned, parts, typed

SECTION = "Annotations"
"""Where the redacted report holds them."""

SPEAKS_OF = frozenset(
    {
        *("annotation", "annotations", "rating", "ratings", "score", "scores", "symptom", "symptoms", "severity"),
        *("note", "notes", "comment", "comments", "marker", "markers", "diary", "questionnaire"),
    }
)
VALUES = frozenset({"rating", "score", "severity", "value", "level", "intensity", "symptom", "scale", "patient", "clinician", "reported"})
"""Words of keys whose number is a rating, in addition to names of symptoms."""

TIMES = frozenset({"date", "time", "datetime", "timestamp", "stamp", "utc", "unix", "event", "start", "begin", "annotation", "rating"})
OFFSETS_S = {"milliseconds": 1e-3, "ms": 1e-3, "mses": 1e-3, "seconds": 1.0, "s": 1.0}
"""How many seconds the unit is that a key ends with; the longer ending counts."""

LARGEST = 100.0
"""No rating goes beyond: a larger number may be an identifier."""

MOST = 5_000
DEEPEST = 40
_CLOSED = frozenset({"PatientInformation", "PrescriptionSummary"})
"""Sections that identify a person."""


@dataclass(frozen=True)
class Annotation:
    """One annotation, or one number of a rating.

    Attributes:
        at: when. label: its text, in known words; else the key above it.
        value: the rating, 0 to 100; None of an annotation. under: its key, as far as that is technical.
    """

    at: datetime
    label: str
    value: float | None
    under: str


@dataclass
class Found:
    """The annotations of a report in time order, and what of their objects was not kept: by reason, how often."""

    kept: list[Annotation] = field(default_factory=list)
    lost: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
class _Run:
    """The streaming run that an object is in: its start, and the tick before its first packet, ms."""

    start: datetime | None = None
    first_tick_ms: float | None = None


def gather(report: Mapping[str, Any]) -> Found:
    """Collect all annotations and ratings of a report."""
    found = Found()
    for name, value in report.items():
        if name not in _CLOSED:
            for under, record, run in _records(value, str(name), speaks_of(str(name)), _Run(), 1):
                _keep(record, under, run, found)
    found.kept = sorted(dict.fromkeys(found.kept), key=lambda a: (a.at, a.under, a.label))[:MOST]
    return found


def as_section(found: Found) -> list[dict[str, Any]]:
    """Write the annotations as the redacted report has them."""
    said = ({"DateTime": a.at.isoformat(), "Name": a.label, "Under": a.under, "Value": a.value} for a in found.kept)
    return [{name: value for name, value in one.items() if value is not None} for one in said]


def speaks_of(key: str) -> bool:
    """Decide, by the words of a key, whether its value is annotations or ratings."""
    return bool(SPEAKS_OF & set(parts(key))) or key == "EventSummary"


def _records(value: Any, key: str, inside: bool, run: _Run, depth: int) -> Iterator[tuple[str, dict[str, Any], _Run]]:
    """Yield objects at or below a key about annotations, the outermost with a time of their own; with that key, cleaned."""
    if depth > DEEPEST:
        return
    if isinstance(value, list):
        for item in value:
            if isinstance(item, dict | list):
                yield from _records(item, key, inside, run, depth + 1)
        return
    if not isinstance(value, dict):
        return
    run = _run_of(value, run)
    if inside and (_time(value, run) is not None or not any(isinstance(v, dict | list) for v in value.values())):
        yield cleaned(key), value, run
        return
    for name, item in value.items():
        if isinstance(item, dict | list) and name not in _CLOSED:
            speaks = speaks_of(str(name))
            yield from _records(item, str(name) if speaks or not inside else key, inside or speaks, run, depth + 1)


def _run_of(value: dict[str, Any], outer: _Run) -> _Run:
    start = moment(value.get("FirstPacketDateTime"))
    if start is None:
        return outer
    ticks = packet_list(value.get("TicksInMses"))
    rows = entries(value.get("LfpData"))
    first = float(ticks[0]) if ticks.size else finite(rows[0].get("TicksInMs")) if rows else None
    return replace(outer, start=start, first_tick_ms=first)


def _time(record: dict[str, Any], run: _Run) -> datetime | None:
    """Find the time: a date, Unix seconds or milliseconds, or seconds or ticks within the run around it."""
    for key, value in record.items():
        words = set(parts(key))
        if words and words <= TIMES and words & {"date", "time", "datetime", "timestamp", "stamp"}:
            when = moment(value) or _unix(finite(value))
            if when is not None:
                return when
    if run.start is None:
        return None
    for key, value in record.items():
        number, words_of = finite(value), parts(key)
        if number is None or not words_of:
            continue
        if "ticks" in words_of and run.first_tick_ms is not None:
            return run.start + timedelta(milliseconds=number - run.first_tick_ms) if abs(number) < 1e10 else None
        named = "".join(words_of)
        scale = next((s for unit, s in OFFSETS_S.items() if named.endswith(unit)), None)
        if scale is not None and set(words_of) & {"offset", "time", "start", "begin"} and 0 <= number * scale < 86_400:
            return run.start + timedelta(seconds=number * scale)
    return None


def _unix(number: float | None) -> datetime | None:
    """Convert Unix seconds or milliseconds to a time of the years in which implants of this kind exist."""
    for scale in (1.0, 1000.0):
        if number is not None and 1.2e9 <= number / scale < 4e9:
            return datetime.fromtimestamp(number / scale, UTC)
    return None


def _keep(record: dict[str, Any], under: str, run: _Run, found: Found) -> None:
    when = _time(record, run)
    if when is None:
        found.lost["entries without a time"] += 1
        return
    # of a redacted report, which has them all in one section
    stated = record.get("Under")
    under = stated if isinstance(stated, str) and cleaned(stated) == stated != "…" else under
    label, ratings = "", []
    for key, value in record.items():
        words = parts(key)
        if isinstance(value, str) and finite(value) is None and moment(value) is None and (key, value) != ("Under", under):
            said = under if value == under else typed(value)
            if said is None and value.strip():
                found.lost["texts with other than known words"] += 1
            label = label or said or ""
        elif (number := finite(value)) is not None and words and set(words) <= VALUES | SYMPTOMS:
            if 0 <= number <= LARGEST:
                ratings.append((" ".join(w for w in words if w in SYMPTOMS), number))
            else:
                found.lost["numbers beyond those of a rating"] += 1
    if not ratings:
        found.kept.append(Annotation(when, label or under, None, under))
    for named, number in ratings:
        found.kept.append(Annotation(when, named or label or under, number, under))
