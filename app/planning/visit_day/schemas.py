"""API types of the clinic day."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, Literal
from uuid import UUID

from pydantic import Field, ValidationError, ValidatorFunctionWrapHandler, WrapValidator, model_validator

from app.planning.visit_day.record import EntryBase, GraspEntry, RatingEntry, SessionEntry
from app.platform.web.schemas import Bool, Int, Model, Number, Text
from app.study.characteristics import PlannedDose
from app.tables.adverse_events import EventKind
from app.tables.visits import Drug

Grade = Literal["none", "mild", "severe"]
StopCause = Literal["participant", "technical", "other"]
NoNames = Annotated[list[Annotated[Text, Field(max_length=60)]], Field(max_length=50)]
Reason = Annotated[Text, Field(min_length=1, max_length=500)]


class Nothing(Model):
    """An entry whose time says it all."""


class StopCausePayload(Model):
    """Cause of a session's stop before its planned end."""

    cause: StopCause = Field(description="`participant`: for the participant's sake.")
    text: Annotated[Text, Field(max_length=500)] = ""


class GradePayload(Model):
    """Grade of a side effect."""

    grade: Grade = Field(description="`severe` is a stop rule.")


class NotePayload(Model):
    """A note without names, dates and long numbers."""

    text: Annotated[Text, Field(min_length=1, max_length=1000)]
    no_names: NoNames = Field(default_factory=list, description="Words that look like names and that the writer says are none.")


class AdverseEventPayload(Model):
    """Something that happened to the participant; it is stored among the adverse events as soon as it arrives."""

    kind: EventKind
    severity: Literal["mild", "moderate", "severe"] = Field(description="`severe` is a stop rule.")
    serious: Bool = Field(False, description="Death, danger to life, hospital, lasting harm, or what a clinician holds equal (ISO 14155).")
    note: Annotated[Text, Field(max_length=1000)] = Field("", description="Needed for the kind `other`; screened as notes are.")
    no_names: NoNames = Field(default_factory=list, description="As in a note.")

    @model_validator(mode="after")
    def _described(self) -> AdverseEventPayload:
        if self.kind is EventKind.OTHER and not self.note.strip():
            raise ValueError("say what happened: the kind is 'other'")
        return self


class DosePayload(Model):
    """A dose of medication; the entry's time is when it was taken, and it is among the visit's doses as soon as it arrives."""

    drug: Drug
    mg: Number = Field(gt=0, le=5000, description="Of the active drug; of levodopa combinations the levodopa.")


class ReasonPayload(Model):
    """Reason why a session was skipped or is repeated."""

    reason: Reason


class Mark(SessionEntry):
    """A session starts, stops, or is finished with all that is asked after it."""

    kind: Literal["start", "stop", "session_end"]
    payload: Nothing = Nothing()


class StopCauseEntry(SessionEntry):
    """Cause of an early stop of a session."""

    kind: Literal["stop_cause"]
    payload: StopCausePayload


class GradeEntry(SessionEntry):
    """A side effect during a session."""

    kind: Literal["dyskinesia", "speech", "gait"]
    payload: GradePayload


class ReasonEntry(SessionEntry):
    """A session is skipped, or run again."""

    kind: Literal["skip", "repeat"]
    payload: ReasonPayload


class NoteEntry(EntryBase):
    """A note on a session or on the day."""

    kind: Literal["note"]
    payload: NotePayload


class AdverseEventEntry(EntryBase):
    """An adverse event during a session or on the day."""

    kind: Literal["adverse_event"]
    payload: AdverseEventPayload


class ClinicalSettingsEntry(EntryBase):
    """Confirmation that the stimulator is back on the clinical settings."""

    kind: Literal["clinical_settings"]
    payload: Nothing = Nothing()


class DoseEntry(EntryBase):
    """Medication that was taken, on the day or before it."""

    kind: Literal["dose"]
    payload: DosePayload


AnyEntry = (
    Mark | StopCauseEntry | RatingEntry | GraspEntry | GradeEntry | ReasonEntry | NoteEntry | AdverseEventEntry | ClinicalSettingsEntry
    | DoseEntry
)  # fmt: skip
EntryIn = Annotated[AnyEntry, Field(discriminator="kind")]


@dataclass(frozen=True)
class Unreadable:
    """An entry of a batch that makes no sense. uuid: None where even that cannot be read. why: a sentence on what is wrong where."""

    uuid: UUID | None
    why: str


def _one_by_one(value: Any, read: ValidatorFunctionWrapHandler) -> Any:
    """Read an entry; what makes no sense becomes `Unreadable`, so that it refuses none of the others."""
    try:
        return read(value)
    except ValidationError as error:
        wrong = "; ".join(f"{' > '.join(map(str, e['loc'])) or 'entry'}: {e['msg']}" for e in error.errors()[:5])
        try:
            uuid = UUID(str(value["uuid"]))
        except (KeyError, TypeError, ValueError):
            uuid = None
        return Unreadable(uuid, f"The entry makes no sense: {wrong}.")


class EntriesIn(Model):
    """Entries of a tablet, in the order in which they were made."""

    plan_id: Annotated[Int, Field(ge=1)] = Field(description="The plan that the tablet showed.")
    entries: list[Annotated[EntryIn, WrapValidator(_one_by_one)]] = Field(min_length=1, max_length=200)


class EntryResult(Model):
    """Result of one entry."""

    uuid: UUID | None = Field(description="Null where a refused entry has none that can be read.")
    outcome: Literal["stored", "known", "refused"] = Field(description="`refused`: not stored; keep it and show why.")
    detail: str = ""
    hint: str = ""
    field: str = Field("", description="Of the payload, where one is what is wrong with a refused entry; empty where it is the whole.")


class EntriesOut(Model):
    """Results of every entry of a batch, in its order."""

    server_time: datetime
    results: list[EntryResult]


class EntryOut(Model):
    """An entry as it is stored."""

    uuid: UUID
    plan_id: int
    plan_item_id: int | None
    attempt: int | None
    kind: str
    payload: dict[str, Any]
    replaces: list[UUID]
    device_time: datetime
    clock_offset_ms: int | None
    received_at: datetime
    entered_by: str


class LimitsOut(Model):
    """Amplitudes within which a session stays, mA, and how fast they change, mA/s."""

    min_ma: float
    max_ma: float
    ramp_ma_per_s: float | None


class SlotOut(Model):
    """One session of the plan, as far as the reader may know it."""

    plan_item_id: int
    position: int
    label: str = Field(description="Text in large letters: the controller, or a label where it is not to be known.")
    controller: str | None = Field(description="Null where it is not to be known.")
    detail: str = Field(description="Policy or design; empty where it is not to be known.")
    minutes: float
    washout_minutes: float
    limits: LimitsOut | None
    note: str


class DayDoseOut(Model):
    """A dose that is written down at the visit."""

    drug: Drug
    mg: float
    taken_at: datetime


class DayOut(Model):
    """A clinic day: the sessions of the approved plan, and what has been entered."""

    visit_id: int
    visit: int
    date: dt.date | None
    participant: str
    plan_id: int
    blinded: bool = Field(description="Labels replace controllers.")
    locked: bool = Field(description="The visit takes no entries any more.")
    not_runnable: str = Field(description="Why nothing of the plan may be started, such as a broken signature; empty where it may.")
    note: str
    stop_rules: list[str]
    slots: list[SlotOut]
    entries: list[EntryOut]
    doses: list[DayDoseOut] = Field(description="Written down at this visit so far, by whichever way, by time.")
    planned_doses: list[PlannedDose] = Field(description="The participant's schedule of an ordinary day: what the page offers to enter.")
    reader: str
    may_enter: bool
    may_dose: bool = Field(description="Whether the reader may write down doses; blinded assessors may not.")
    server_time: datetime
