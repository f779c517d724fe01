"""API types of data queries."""

from __future__ import annotations

from datetime import datetime
from typing import Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from app.platform.web.schemas import CodeOf, Int, Model, Text
from app.study.data_queries.fields import FIELDS
from app.tables.data_queries import OF_PARTICIPANT, QueryState, Subject

_NAMED = "; ".join(f"of {subject.value} {', '.join(names[:-1])}" for subject, names in FIELDS.items())


class DataQueryIn(Model):
    """A question about a value, or about an upload: of a session, upload, visit, dose or adverse event, or of the participant's settings or
    characteristics."""

    session_id: Int | None = Field(None, ge=1)
    upload_id: Int | None = Field(None, ge=1)
    visit_id: Int | None = Field(None, ge=1)
    dose_id: Int | None = Field(None, ge=1)
    event_id: Int | None = Field(None, ge=1, description="Of an adverse event.")
    record: Literal["settings", "characteristics"] | None = Field(None, description="Of the participant: the present version.")
    field: Text = Field(min_length=1, max_length=40, description="Which value, by its name: " + _NAMED + ". `other` is said in the text.")
    text: Text = Field(min_length=1, max_length=2000, description="What is asked, without names or dates.")

    @model_validator(mode="after")
    def _one_subject(self) -> Self:
        if len(self._stated()) != 1:
            raise PydanticCustomError("subject", "name one thing that is asked about: a session, upload, visit, dose, event or record")
        if self.field not in FIELDS[self.subject]:
            raise PydanticCustomError(
                "field",
                "a {subject} is asked about as one of {fields}",
                {"subject": self.subject.value, "fields": ", ".join(FIELDS[self.subject])},
            )
        return self

    def _stated(self) -> list[Subject]:
        numbered = [s for s in Subject if s not in OF_PARTICIPANT and getattr(self, f"{s.value}_id") is not None]
        return [*numbered, *([Subject(self.record)] if self.record is not None else [])]

    @property
    def subject(self) -> Subject:
        """What the value stands in."""
        return self._stated()[0]


class DataQueryEntryIn(Model):
    """An answer, a closing, or a question asked again."""

    state: QueryState = Field(description="`answered` by those who enter data; `closed` and `open` by those who ask.")
    text: Text = Field(min_length=1, max_length=2000)
    entries: Int = Field(ge=1, description="How many entries the caller has read; 409 where there are more by now.")


class DataQueryEntryOut(Model):
    """What was said."""

    state: QueryState
    text: str
    value: str | None = Field(description="The value as it stood; null where there was none, and of controllers and files.")
    entered_by: str
    created_at: datetime


class DataQueryOut(Model):
    """A data query with all that was said."""

    id: int
    participant: CodeOf
    session_id: int | None
    upload_id: int | None
    visit_id: int | None
    dose_id: int | None
    event_id: int | None
    record: Literal["settings", "characteristics"] | None
    field: str
    state: QueryState
    entries: list[DataQueryEntryOut]
