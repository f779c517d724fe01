"""What the entries of a clinic day amount to. `static/visit-day/record.js` does the same on the tablet.

Entries are only added. Those that a later entry names in `replaces` no longer stand; where two stand that say different things of the same
matter (two tablets, or two people), nothing is taken until somebody decides between them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, Literal, Protocol

from app.planning.visit_day.asked import ASKED, ASKED_BY_KIND

SAME_MOMENT_S = 5.0
"""Two starts (or stops) of one session within this time are the same event pressed twice."""
MANY = ("note", "adverse_event", "clinical_settings", "repeat", "dose")
"""Kinds of which there may be several: one more says nothing against the one before."""
MILD, SEVERE = "mild", "severe"
GRADED = ("dyskinesia", "speech", "gait")


State = Literal["waiting", "running", "asked", "done", "skipped"]
_STATES: tuple[tuple[str, State], ...] = (("skip", "skipped"), ("session_end", "done"), ("stop", "asked"), ("start", "running"))


class Timed(Protocol):
    """By whose clock, and how far that is off."""

    device_time: Any
    clock_offset_ms: Any


class Entry(Timed, Protocol):
    """What is read of an entry."""

    uuid: Any
    plan_item_id: Any
    attempt: Any
    kind: Any
    payload: Any
    replaces: Any
    entered_by: Any


@dataclass(frozen=True)
class Attempt:
    """One run of a session. Times are the service's: the tablet's clock with its offset.

    Attributes:
        number: 1, and one more after every repeat. started_at, stopped_at: None where not entered, or where two entries contradict.
        repeated_because: why it was run again; None for the last one.
    """

    number: int
    started_at: datetime | None
    stopped_at: datetime | None
    repeated_because: str | None


@dataclass(frozen=True)
class SlotTimes:
    """When a session of the plan ran.

    Attributes:
        attempts: in order, the last one counts. skipped_because: None where it was not skipped.
        stop_cause: `participant`, `technical`, `other`; None where it was not stopped early, or nobody said why. stop_text: in words.
    """

    attempts: tuple[Attempt, ...]
    skipped_because: str | None
    stop_cause: str | None
    stop_text: str

    @property
    def started_at(self) -> datetime | None:
        """Start of the attempt that counts."""
        return self.attempts[-1].started_at

    @property
    def stopped_at(self) -> datetime | None:
        """Its end."""
        return self.attempts[-1].stopped_at


@dataclass(frozen=True)
class SlotOutcome:
    """What was entered about the attempt of a session that counts; None where nothing was, or where two entries contradict.

    Attributes:
        qocs: of the outcomes that are asked for, by `Outcome.field`; those that were entered.
        dyskinesia, speech, gait: `none`, `mild` or `severe`. notes: in order.
        contradictions: kinds of which two different entries stand. entered_by: of the outcomes, by kind of entry.
    """

    qocs: Mapping[str, float] = field(default_factory=dict)
    dyskinesia: str | None = None
    speech: str | None = None
    gait: str | None = None
    notes: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()
    entered_by: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Contradiction:
    """Entries of one matter that say different things, and none replaces the other."""

    plan_item_id: int
    attempt: int
    kind: str
    entries: tuple[Entry, ...]


def moment(entry: Timed) -> datetime:
    """When an entry was made, by the service's clock."""
    return entry.device_time + timedelta(milliseconds=entry.clock_offset_ms or 0)  # type: ignore[no-any-return]


def standing(entries: Iterable[Entry]) -> list[Entry]:
    """The entries that no other replaces, in the order of their moments."""
    entries = list(entries)
    replaced = {str(u) for e in entries for u in e.replaces}
    return sorted((e for e in entries if str(e.uuid) not in replaced), key=moment)


def last_attempt(entries: Iterable[Entry], plan_item_id: int) -> int:
    """Number of the attempt that counts."""
    return 1 + max((e.attempt for e in entries if e.plan_item_id == plan_item_id and e.kind == "repeat"), default=0)


def attempt_at(entries: Sequence[Entry], plan_item_id: int, began: datetime | None) -> int:
    """Return the number of the attempt that began nearest to a recording; that which counts, where either clock says nothing."""
    last = last_attempt(entries, plan_item_id)
    starts = {n: moment(said["start"]) for n in range(1, last + 1) if "start" in (said := said_of(entries, plan_item_id, n))}
    if began is None or last not in starts:
        return last
    return min(starts, key=lambda n: (abs(starts[n] - began), -n))


def said_of(entries: Iterable[Entry], item: int, attempt: int) -> dict[str, Entry]:
    """By kind, the entry that stands of one attempt; the earliest of several that agree, none where they do not."""
    rows: dict[str, list[Entry]] = {}
    for entry in standing(entries):
        if (entry.plan_item_id, entry.attempt) == (item, attempt):
            rows.setdefault(entry.kind, []).append(entry)
    return {kind: those[0] for kind, those in rows.items() if kind == "repeat" or all(agree(those[0], e) for e in those[1:])}


def agree(one: Entry, other: Entry) -> bool:
    """Whether two entries of one matter say the same."""
    if one.kind in ("start", "stop"):
        return abs((moment(one) - moment(other)).total_seconds()) <= SAME_MOMENT_S
    if (asked := ASKED_BY_KIND.get(one.kind)) is not None:
        return asked.value(one.payload) == asked.value(other.payload)
    return bool(one.payload == other.payload)


def contradictions(entries: Iterable[Entry]) -> list[Contradiction]:
    """Every matter of which two entries stand that say different things."""
    matters: dict[tuple[int, int, str], list[Entry]] = {}
    for entry in standing(entries):
        if entry.plan_item_id is not None and entry.kind not in MANY:
            matters.setdefault((entry.plan_item_id, entry.attempt, entry.kind), []).append(entry)
    return [Contradiction(*key, tuple(rows)) for key, rows in matters.items() if not all(agree(rows[0], row) for row in rows[1:])]


def open_severe(entries: Iterable[Entry]) -> Entry | None:
    """The severe side effect after which nobody has confirmed the clinical settings yet."""
    rows = standing(entries)
    severe = [e for e in rows if _grade(e) == SEVERE]
    confirmed = max((moment(e) for e in rows if e.kind == "clinical_settings"), default=None)
    return next((e for e in reversed(severe) if confirmed is None or moment(e) >= confirmed), None)


def _grade(entry: Entry) -> str | None:
    if entry.kind in GRADED:
        return str(entry.payload["grade"])
    return str(entry.payload["severity"]) if entry.kind == "adverse_event" else None


def state_of(entries: Sequence[Entry], plan_item_id: int) -> State:
    """How far a session of the plan is: `asked` after its stop, until somebody says that all is entered."""
    rows = [e for e in standing(entries) if e.plan_item_id == plan_item_id and e.attempt == last_attempt(entries, plan_item_id)]
    kinds = {e.kind for e in rows}
    for kind, state in _STATES:
        if kind in kinds:
            return state
    return "waiting"


def times_of(entries: Sequence[Entry]) -> dict[int, SlotTimes]:
    """When each session ran, by its id in the plan."""
    found = {}
    for item in _items(entries):
        count = last_attempt(entries, item)
        said = {number: said_of(entries, item, number) for number in range(1, count + 1)}
        attempts = tuple(
            Attempt(
                number,
                moment(about["start"]) if "start" in about else None,
                moment(about["stop"]) if "stop" in about else None,
                about["repeat"].payload["reason"] if "repeat" in about else None,
            )
            for number, about in said.items()
        )
        last = said[count]
        cause = last["stop_cause"].payload if "stop_cause" in last else {}
        skipped = last["skip"].payload["reason"] if "skip" in last else None
        found[item] = SlotTimes(attempts, skipped, cause.get("cause"), cause.get("text", ""))
    return found


def outcomes_of(entries: Sequence[Entry]) -> dict[int, SlotOutcome]:
    """What was entered about each session, by its id in the plan."""
    return {item: outcome_of(entries, item, last_attempt(entries, item)) for item in _items(entries)}


def outcome_of(entries: Sequence[Entry], item: int, number: int) -> SlotOutcome:
    """Return what was entered about one attempt of a session."""
    said = said_of(entries, item, number)
    mine = [e for e in standing(entries) if (e.plan_item_id, e.attempt) == (item, number)]
    return SlotOutcome(
        qocs={one.field: one.value(said[one.kind].payload) for one in ASKED if one.kind in said},
        **{name: said[name].payload["grade"] if name in said else None for name in GRADED},
        notes=tuple(e.payload["text"] for e in mine if e.kind == "note"),
        contradictions=tuple(c.kind for c in contradictions(entries) if (c.plan_item_id, c.attempt) == (item, number)),
        entered_by={name: said[name].entered_by for name in ASKED_BY_KIND if name in said},
    )


def _items(entries: Iterable[Entry]) -> list[int]:
    return sorted({e.plan_item_id for e in entries if e.plan_item_id is not None})
