"""Shared API types: strict numbers and booleans (`"3"` is no integer), paged lists, problem documents."""

from __future__ import annotations

from datetime import UTC, date, datetime
from typing import Annotated, Any, Generic, TypeVar

from fastapi import Depends, Query
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict

Item = TypeVar("Item")


def _fits_the_database(value: int) -> int:
    if not -(2**31) <= value < 2**31:
        raise ValueError(f"the number must lie between {-(2**31)} and {2**31 - 1}")
    return value


# a validator and no `Field(ge=…, le=…)`: bounds written here would silently replace the bounds that a field states for itself
Int = Annotated[int, Strict(), AfterValidator(_fits_the_database), Field(json_schema_extra={"format": "int32"})]
Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Bool = Annotated[bool, Strict()]


def sensible_time(value: datetime) -> datetime:
    """UTC, and within the years that any recording can have; offsets would otherwise carry a time out of the calendar.

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
    """A day within the same years; a year that was mistyped would stand before, or after, every other visit.

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
    """Which page."""

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
    """OpenAPI entries for the problems that a route may answer with."""
    return {s: {"model": Problem, "content": {"application/problem+json": {}}} for s in statuses}
