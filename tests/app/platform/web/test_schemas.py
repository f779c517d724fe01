"""The API's number types keep the bounds that a field states."""

from __future__ import annotations

from typing import Annotated

import pytest
from pydantic import Field, ValidationError

from app.platform.web.schemas import Int, Model


class Bounded(Model):
    """One bounded whole number and one that only the database bounds."""

    place: Int = Field(1, ge=1, le=10)
    count: Int = 0


@pytest.mark.parametrize(
    "values", [{"place": 0}, {"place": 11}, {"count": 2**31}, {"count": -(2**31) - 1}, {"place": "3"}, {"place": True}]
)
def test_whole_numbers_out_of_bounds_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Bounded(**values)  # type: ignore[arg-type]


def test_whole_numbers_at_their_bounds_are_taken() -> None:
    assert [Bounded(place=1).place, Bounded(place=10).place, Bounded(count=2**31 - 1).count] == [1, 10, 2**31 - 1]


def test_a_fields_own_bounds_stand_in_the_document() -> None:
    place = Bounded.model_json_schema()["properties"]["place"]
    assert (place["minimum"], place["maximum"]) == (1, 10)


class Nullable(Model):
    """Bounds next to null, on the items of a list, and one that is left to the database."""

    rating: Int | None = Field(None, ge=1, le=10)
    policies: list[Annotated[Int, Field(ge=1)]] = []
    above: Int | None = Field(None, gt=0, lt=7)
    count: Int | None = None


@pytest.mark.parametrize(
    "values",
    [
        *({"rating": v} for v in (0, 11, "3", True, 2.0, 2**31)),
        *({"policies": [v]} for v in (0, 2**31, "1")),
        *({"above": v} for v in (0, 7)),
        *({"count": v} for v in (2**31, -(2**31) - 1)),
    ],
)
def test_bounds_beside_null_and_of_items_hold(values: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Nullable(**values)  # type: ignore[arg-type]


def test_bounds_beside_null_and_of_items_are_those_of_a_json_schema() -> None:
    assert Nullable(rating=10, policies=[1], above=6, count=-(2**31)).rating == 10
    fields = Nullable.model_json_schema()["properties"]
    whole = {"type": "integer", "format": "int32"}
    assert fields["rating"]["anyOf"] == [whole | {"minimum": 1, "maximum": 10}, {"type": "null"}]
    assert fields["policies"]["items"] == whole | {"minimum": 1}
    assert fields["above"]["anyOf"] == [whole | {"exclusiveMinimum": 0, "exclusiveMaximum": 7}, {"type": "null"}]
    assert fields["count"]["anyOf"] == [whole, {"type": "null"}]
