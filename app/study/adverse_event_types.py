"""Types of adverse events, and their words."""

from __future__ import annotations

from datetime import datetime
from typing import Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from app.platform.web.schemas import Bool, Int, Model, Moment, Text
from app.tables.adverse_events import Action, EventKind, EventOutcome, Relation, Severity

# Words of adverse events.

EVENT_KINDS = {
    EventKind.DYSKINESIA: "Dyskinesia",
    EventKind.SPEECH: "Speech",
    EventKind.GAIT: "Gait or balance",
    EventKind.FALL: "Fall",
    EventKind.MUSCLE_CONTRACTION: "Muscle contraction",
    EventKind.PARAESTHESIA: "Paraesthesia",
    EventKind.VISION: "Vision",
    EventKind.MOOD: "Mood",
    EventKind.COGNITION: "Thinking or confusion",
    EventKind.PAIN: "Pain",
    EventKind.NAUSEA: "Nausea",
    EventKind.DEVICE: "Device",
    EventKind.STOPPED: "Session stopped for the participant's sake",
    EventKind.OTHER: "Other",
}


EVENT_SEVERITIES = {
    Severity.NONE: "none",
    Severity.MILD: "mild",
    Severity.MODERATE: "moderate",
    Severity.SEVERE: "severe",
    Severity.NOT_STATED: "not stated",
}
RELATIONS = {
    Relation.NOT_RELATED: "not related",
    Relation.POSSIBLE: "possible",
    Relation.PROBABLE: "probable",
    Relation.CAUSAL: "causal",
}
ACTIONS = {
    Action.NONE: "none",
    Action.STIMULATION_CHANGED: "stimulation changed",
    Action.SESSION_STOPPED: "session stopped",
    Action.MEDICATION: "medication",
    Action.OTHER: "other",
}
EVENT_OUTCOMES = {
    EventOutcome.RECOVERED: "recovered",
    EventOutcome.RECOVERING: "recovering",
    EventOutcome.NOT_RECOVERED: "not recovered",
    EventOutcome.LASTING_HARM: "lasting harm",
    EventOutcome.FATAL: "fatal",
}
CHOICES = {"relation": ("Relation to the test", RELATIONS), "action": ("Action taken", ACTIONS), "outcome": ("Outcome", EVENT_OUTCOMES)}
"""Label and words of each further choice, by its field; all may stay open."""
HARM = (EventOutcome.LASTING_HARM, EventOutcome.FATAL)
"""Outcomes that make an event serious (ISO 14155)."""


# API types of adverse events.


class AdverseEventFields(Model):
    """Facts of an adverse event."""

    kind: EventKind | None = Field(None, description="Null only where the severity is `none`: nothing was found.")
    severity: Severity
    serious: Bool = Field(
        False,
        description="Death, danger to life, hospital, lasting harm, or what a clinician holds equal (ISO 14155). "
        "Until a clinician clears it, what ran counts as unsafe.",
    )
    note: Text = Field("", max_length=2000, description="Without names or dates. Needed for the kind `other`.")
    relation: Relation | None = Field(None, description="To what was tested (ISO 14155); null: not judged.")
    ended_at: Moment | None = Field(None, description="Null: not ended, or not known. Without an offset it is UTC.")
    action: Action | None = Field(None, description="Taken because of it; null: not stated.")
    outcome: EventOutcome | None = Field(None, description="Null: not known. `lasting_harm` and `fatal` are serious.")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.severity is Severity.NONE:
            if self.serious:
                raise PydanticCustomError("serious", "an event of severity 'none' cannot be serious")
            return self
        if self.outcome in HARM and not self.serious:
            raise PydanticCustomError("serious", "an event with lasting harm or a fatal one is serious")
        if self.kind is None:
            raise PydanticCustomError("kind", "say what happened: `kind` is missing")
        if self.kind is EventKind.OTHER and not self.note.strip():
            raise PydanticCustomError("note", "say what happened in the note: the kind is 'other'")
        return self


class AdverseEventIn(AdverseEventFields):
    """A new adverse event. A session names its visit and what ran; without one the visit and the policy may be named."""

    session_id: Int | None = Field(None, ge=1)
    visit_id: Int | None = Field(None, ge=1)
    policy_id: Int | None = Field(None, ge=1, description="What ran, where no session is stated.")
    occurred_at: Moment | None = Field(None, description="Without an offset it is UTC.")
    entry_key: Text | None = Field(
        None, min_length=1, max_length=64, description="Name of the entry on the device it was made on: sent twice, it is one event."
    )


class AdverseEventChange(AdverseEventFields):
    """New facts of an adverse event, as a whole, and the reason of the change. The event loses its clearance."""

    revision: Int = Field(ge=1, description="The one that the caller has read.")
    reason: Text = Field(min_length=1, max_length=1000, description="Kept with the revision and in the audit trail.")


class ClearanceIn(Model):
    """A clinician's word that a serious event does not count against what ran."""

    revision: Int = Field(ge=1, description="The one that the caller has read.")
    reason: Text = Field(min_length=1, max_length=1000, description="Kept with the event and in the audit trail.")


class AdverseEventOut(AdverseEventFields):
    """An adverse event as it is known now."""

    id: int
    participant: str
    visit_id: int | None
    session_id: int | None
    policy_id: int | None = Field(
        description="What ran, by the session or as stated; null where none did, or where it is hidden from a blinded assessor."
    )
    occurred_at: datetime | None
    revision: int
    cleared_reason: str | None = Field(description="Why a clinician cleared it; null: not cleared.")
    blocks: bool = Field(description="Serious, or a stop, and not cleared: what ran counts as unsafe.")
    entered_by: str
    reason: str | None = Field(description="Of the newest revision.")
    created_at: datetime = Field(description="Of the newest revision.")
