"""Shared API types: strict numbers and booleans (`"3"` is no integer), paged lists, problem documents."""

from __future__ import annotations

from datetime import UTC, date, datetime
from typing import Annotated, Any, Generic, TypeVar, cast

from fastapi import Depends, Query
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, Strict
from pydantic_core import CoreSchema

Item = TypeVar("Item")


LEAST_INT, MOST_INT = -(2**31), 2**31 - 1
"""What an integer column of the database holds."""


class _FitsTheDatabase:
    """Default bounds of a whole number that states no narrower ones.

    A validator of its own would make pydantic publish a field's bounds by their names in the code (`ge`, `le`), which JSON schema lacks.
    It is no `Field(ge=…, le=…)` either: it would silently replace the bounds that a field states.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema: dict[str, Any] = {**handler(source), "strict": True}
        for bound, other, limit in (("ge", "gt", LEAST_INT), ("le", "lt", MOST_INT)):
            if other not in schema:
                schema.setdefault(bound, limit)
        return cast(CoreSchema, schema)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        described = handler(schema)
        for bound, limit in (("minimum", LEAST_INT), ("maximum", MOST_INT)):
            if described.get(bound) == limit:  # the format says as much
                del described[bound]
        return described | {"format": "int32"}


Int = Annotated[int, _FitsTheDatabase()]
Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Bool = Annotated[bool, Strict()]


def sensible_time(value: datetime) -> datetime:
    """Convert a time to UTC and check that its year is plausible; an offset could otherwise carry it out of the calendar.

    Raises:
        ValueError: a year outside 1990-2200.
    """
    if value.tzinfo is None:
        value = value.replace(tzinfo=UTC)
    if not 1990 <= value.year <= 2200:
        raise ValueError("the year must lie between 1990 and 2200")
    return value.astimezone(UTC)


Moment = Annotated[datetime, AfterValidator(sensible_time)]
"""A time; without an offset it is UTC."""


def sensible_day(value: date) -> date:
    """Check that a day's year is plausible; a mistyped year would sort before, or after, every other visit.

    Raises:
        ValueError: a year outside 1990-2200.
    """
    if not 1990 <= value.year <= 2200:
        raise ValueError("the year must lie between 1990 and 2200")
    return value


Day = Annotated[date, AfterValidator(sensible_day)]
"""A day of the calendar."""
RowId = Annotated[int, Field(ge=1, le=2**31 - 1)]
Text = Annotated[str, Field(pattern=r"^[^\x00]*$")]
"""Text without the zero character, which PostgreSQL cannot hold."""
CodeOf = Annotated[str, BeforeValidator(lambda row: getattr(row, "code", row))]
"""The code of a row that has one, such as a participant, for an answer."""


class Model(BaseModel):
    """Base of every API type: unknown members are refused, attributes of rows are read."""

    model_config = ConfigDict(extra="forbid", from_attributes=True)


class Page(BaseModel, Generic[Item]):
    """One page of a list."""

    items: list[Item]
    total: int
    limit: int
    offset: int


class Paging(BaseModel):
    """Page of a list: its limit and offset."""

    limit: int
    offset: int


def _paging(
    limit: Annotated[int, Query(ge=1, le=500, description="Items per page.")] = 50,
    offset: Annotated[int, Query(ge=0, le=2**31 - 1, description="Items to skip.")] = 0,
) -> Paging:
    return Paging(limit=limit, offset=offset)


PagingQuery = Annotated[Paging, Depends(_paging)]


class Problem(BaseModel):
    """RFC 9457 problem document."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    instance: str
    hint: str | None = None
    errors: list[dict[str, Any]] | None = None


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Build the OpenAPI entries for the problems that a route may answer with."""
    return {s: {"model": Problem, "content": {"application/problem+json": {}}} for s in statuses}
