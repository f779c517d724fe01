"""The API's number types keep the bounds that a field states."""

from __future__ import annotations

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
