"""Meaning of the entries of a clinic day. `static/visit-day/record.js` does the same on the tablet.

Entries are only added. Those that a later entry names in `replaces` are no longer valid. Where two valid ones of the same matter differ
(two tablets, or two people), nothing is taken until a person decides between them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Literal, Protocol
from uuid import UUID

import numpy as np
from pydantic import AfterValidator, Field, Strict, model_validator

from app.platform.web.schemas import Int, Model, Number
from ml.qoc import grasp_frequency

SAME_MOMENT_S = 5.0
"""Two starts (or stops) of one session within this time are the same event pressed twice."""
MANY = ("note", "adverse_event", "clinical_settings", "repeat", "dose")
"""Kinds of which there may be several: one more says nothing against the one before."""
MILD, SEVERE = "mild", "severe"
GRADED = ("dyskinesia", "speech", "gait")
MOST_TAPS = 200
_LONGEST_OFFSET_MS = 10**13  # a tablet whose battery was empty may wake in 1970, and what it holds must be taken all the same


def _utc(value: datetime) -> datetime:
    value = value.replace(tzinfo=UTC) if value.tzinfo is None else value
    if not 1970 <= value.year <= 2200:
        raise ValueError("the year must lie between 1970 and 2200")
    return value.astimezone(UTC)


DeviceTime = Annotated[datetime, AfterValidator(_utc)]


class EntryBase(Model):
    """Members that every entry has."""

    uuid: UUID = Field(description="Drawn by the tablet; the same one again is the same entry.")
    plan_item_id: Annotated[Int, Field(ge=1)] | None = Field(None, description="Session of the plan; null for the day as a whole.")
    attempt: Annotated[Int, Field(ge=1, le=20)] | None = Field(None, description="1, and one more after every repeat.")
    replaces: list[UUID] = Field(default_factory=list, max_length=20, description="Entries that this one corrects.")
    device_time: DeviceTime
    clock_offset_ms: Annotated[int, Strict(), Field(ge=-_LONGEST_OFFSET_MS, le=_LONGEST_OFFSET_MS)] | None = Field(
        None, description="Service's clock less the tablet's, as last measured."
    )


class SessionEntry(EntryBase):
    """Members that belong to one session of the plan."""

    plan_item_id: Annotated[Int, Field(ge=1)]
    attempt: Annotated[Int, Field(ge=1, le=20)] = 1


class RatingPayload(Model):
    """The participant's rating."""

    value: Int = Field(ge=1, le=10)


class GraspPayload(Model):
    """A grasp test: counted by taps, or a number that was read elsewhere."""

    method: Literal["taps", "typed"]
    hz: Number | None = Field(None, ge=0, lt=20, description="As typed; of taps it is computed from them.")
    taps_s: list[Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)]] = Field(
        default_factory=list, max_length=MOST_TAPS, description="Time of each open fist, s after `began_at`."
    )
    began_at: DeviceTime | None = Field(None, description="First moment of the count, by the tablet's clock.")
    ended_at: DeviceTime | None = Field(None, description="Its last moment.")

    @model_validator(mode="after")
    def _whole(self) -> GraspPayload:
        if self.method == "typed":
            if self.hz is None or self.taps_s:
                raise ValueError("a typed grasp frequency has `hz` and no taps")
        elif self.hz is not None or len(self.taps_s) < 2 or self.began_at is None or self.ended_at is None:
            raise ValueError("a counted grasp test has two taps at least, `began_at`, `ended_at` and no `hz`")
        elif any(later <= earlier for earlier, later in itertools.pairwise(self.taps_s)):
            raise ValueError("the taps must follow one another")
        return self


class RatingEntry(SessionEntry):
    """The participant's rating of a session."""

    kind: Literal["rating"]
    payload: RatingPayload


class GraspEntry(SessionEntry):
    """The grasp test of a session."""

    kind: Literal["grasp"]
    payload: GraspPayload


@dataclass(frozen=True, kw_only=True)
class AskedOutcome:
    """An outcome that the clinic day asks for after a session.

    Attributes:
        kind: of its entries. field: of `Outcome.field`. payload: of its entries. form: fields that the plain form adds.
        labels: of the form's fields.
        one, several: its entries in words. unit: after a value in a sentence.
        value: of a payload, in the outcome's unit. decimals: of a value in a list of entries; None where it is shown as entered.
    """

    kind: str
    field: str
    payload: type[Model]
    form: Mapping[str, str]
    labels: Mapping[str, str]
    one: str
    several: str
    unit: str
    value: Callable[[Mapping[str, Any]], float]
    decimals: int | None = None

    def words(self, payload: Mapping[str, Any]) -> str:
        """Return the value of a payload in words."""
        value = self.value(payload)
        return str(value) if self.decimals is None else f"{value:.{self.decimals}f}{self.unit}"


def _grasp_hz(payload: Mapping[str, Any]) -> float:
    """Compute the grasp frequency of a test, Hz (eq:grasp_speed)."""
    if payload["method"] == "typed":
        return float(payload["hz"])
    return grasp_frequency(np.asarray(payload["taps_s"], dtype=np.float64))


ASKED = (
    AskedOutcome(
        kind="rating",
        field="rating",
        payload=RatingPayload,
        form={},
        labels={"value": "Rating"},
        one="a rating",
        several="ratings",
        unit="",
        value=lambda payload: payload["value"],
    ),
    AskedOutcome(
        kind="grasp",
        field="grasp_hz",
        payload=GraspPayload,
        form={"method": "typed"},
        labels={"hz": "Grasp frequency"},
        one="a grasp test",
        several="grasp tests",
        unit=" Hz",
        value=_grasp_hz,
        decimals=2,
    ),
)
ASKED_BY_KIND: Mapping[str, AskedOutcome] = {one.kind: one for one in ASKED}


State = Literal["waiting", "running", "asked", "done", "skipped"]
_STATES: tuple[tuple[str, State], ...] = (("skip", "skipped"), ("session_end", "done"), ("stop", "asked"), ("start", "running"))


class Timed(Protocol):
    """By whose clock, and how far that is off."""

    device_time: Any
    clock_offset_ms: Any


class Entry(Timed, Protocol):
    """Members of an entry that are read here."""

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
    """Times of one session of the plan.

    Attributes:
        attempts: in order, the last one counts. skipped_because: None where it was not skipped.
        stop_cause: `participant`, `technical`, `other`; None where it was not stopped early, or no cause is stated. stop_text: in words.
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
    """Entries about the attempt of a session that counts; None where nothing was entered, or where two entries contradict.

    Attributes:
        qocs: of the outcomes that are asked for, by `Outcome.field`; those that were entered.
        dyskinesia, speech, gait: `none`, `mild` or `severe`. notes: in order.
        contradictions: kinds with two different valid entries. entered_by: of the outcomes, by kind of entry.
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
    """Return when an entry was made, by the service's clock."""
    return entry.device_time + timedelta(milliseconds=entry.clock_offset_ms or 0)  # type: ignore[no-any-return]


def standing(entries: Iterable[Entry]) -> list[Entry]:
    """Select the entries that no other replaces, in the order of their moments."""
    entries = list(entries)
    replaced = {str(u) for e in entries for u in e.replaces}
    return sorted((e for e in entries if str(e.uuid) not in replaced), key=moment)


def last_attempt(entries: Iterable[Entry], plan_item_id: int) -> int:
    """Return the number of the attempt that counts."""
    return 1 + max((e.attempt for e in entries if e.plan_item_id == plan_item_id and e.kind == "repeat"), default=0)


def attempt_at(entries: Sequence[Entry], plan_item_id: int, began: datetime | None) -> int:
    """Return the number of the attempt that began nearest to a recording; that which counts, where either clock says nothing."""
    last = last_attempt(entries, plan_item_id)
    starts = {n: moment(said["start"]) for n in range(1, last + 1) if "start" in (said := said_of(entries, plan_item_id, n))}
    if began is None or last not in starts:
        return last
    return min(starts, key=lambda n: (abs(starts[n] - began), -n))


def said_of(entries: Iterable[Entry], item: int, attempt: int) -> dict[str, Entry]:
    """Return by kind the valid entry of one attempt; the earliest of several that agree, none where they do not."""
    rows: dict[str, list[Entry]] = {}
    for entry in standing(entries):
        if (entry.plan_item_id, entry.attempt) == (item, attempt):
            rows.setdefault(entry.kind, []).append(entry)
    return {kind: those[0] for kind, those in rows.items() if kind == "repeat" or all(agree(those[0], e) for e in those[1:])}


def agree(one: Entry, other: Entry) -> bool:
    """Check whether two entries of one matter state the same."""
    if one.kind in ("start", "stop"):
        return abs((moment(one) - moment(other)).total_seconds()) <= SAME_MOMENT_S
    if (asked := ASKED_BY_KIND.get(one.kind)) is not None:
        return asked.value(one.payload) == asked.value(other.payload)
    return bool(one.payload == other.payload)


def contradictions(entries: Iterable[Entry]) -> list[Contradiction]:
    """List every matter with two valid entries that differ."""
    matters: dict[tuple[int, int, str], list[Entry]] = {}
    for entry in standing(entries):
        if entry.plan_item_id is not None and entry.kind not in MANY:
            matters.setdefault((entry.plan_item_id, entry.attempt, entry.kind), []).append(entry)
    return [Contradiction(*key, tuple(rows)) for key, rows in matters.items() if not all(agree(rows[0], row) for row in rows[1:])]


def open_severe(entries: Iterable[Entry]) -> Entry | None:
    """Find the severe side effect after which the clinical settings are not confirmed yet."""
    rows = standing(entries)
    severe = [e for e in rows if _grade(e) == SEVERE]
    confirmed = max((moment(e) for e in rows if e.kind == "clinical_settings"), default=None)
    return next((e for e in reversed(severe) if confirmed is None or moment(e) >= confirmed), None)


def _grade(entry: Entry) -> str | None:
    if entry.kind in GRADED:
        return str(entry.payload["grade"])
    return str(entry.payload["severity"]) if entry.kind == "adverse_event" else None


def state_of(entries: Sequence[Entry], plan_item_id: int) -> State:
    """Determine how far a session of the plan is: `asked` after its stop, until a person states that all is entered."""
    rows = [e for e in standing(entries) if e.plan_item_id == plan_item_id and e.attempt == last_attempt(entries, plan_item_id)]
    kinds = {e.kind for e in rows}
    for kind, state in _STATES:
        if kind in kinds:
            return state
    return "waiting"


def times_of(entries: Sequence[Entry]) -> dict[int, SlotTimes]:
    """Return when each session ran, by its id in the plan."""
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
    """Return what was entered about each session, by its id in the plan."""
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
