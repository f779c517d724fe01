"""API types of data queries."""

from __future__ import annotations

from datetime import datetime
from typing import Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from app.platform.web.schemas import Int, Model, Text
from app.study.data_queries.models import QueriedField, QueryState


class DataQueryIn(Model):
    """A question about a value of a session, or about an upload."""

    session_id: Int | None = Field(None, ge=1)
    upload_id: Int | None = Field(None, ge=1)
    field: QueriedField
    text: Text = Field(min_length=1, max_length=2000, description="What is asked, without names or dates.")

    @model_validator(mode="after")
    def _one_subject(self) -> Self:
        if (self.session_id is None) == (self.upload_id is None):
            raise PydanticCustomError("subject", "name a session or an upload, one of the two")
        if self.upload_id is not None and self.field not in (QueriedField.FILE, QueriedField.OTHER):
            raise PydanticCustomError("field", "an upload is asked about as 'file' or 'other'")
        if self.session_id is not None and self.field is QueriedField.FILE:
            raise PydanticCustomError("field", "a file is asked about at its upload")
        return self


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
    participant: str
    session_id: int | None
    upload_id: int | None
    field: QueriedField
    state: QueryState
    entries: list[DataQueryEntryOut]
