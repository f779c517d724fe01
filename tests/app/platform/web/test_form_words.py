"""Words of a form on a value that its type refuses."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from app.platform.errors import Invalid
from app.platform.numbers import counted
from app.platform.web.forms import parse
from app.study.participation import ParticipantIn
from app.study.schemas import QocIn


def test_a_pattern_is_not_shown_to_people() -> None:
    with pytest.raises(Invalid) as refused:
        parse(ParticipantIn, {"code": "bad code!!"}, {"code": "Code (letters, digits, - and _)"})
    assert refused.value.problem("/")["errors"] == [
        {"where": "Code (letters, digits, - and _)", "what": "'bad code!!' is not written as this field takes it", "name": "code"}
    ]


@pytest.mark.parametrize(
    ("number", "words"),
    [(0, "0 minutes"), (1, "1 minute"), (1.0, "1 minute"), (2, "2 minutes"), (0.5, "0.5 minutes"), (10.0, "10 minutes")],
)
def test_one_of_a_thing_is_told_in_the_singular(number: float, words: str) -> None:
    assert counted(number, "minute") == words


def test_a_plural_of_its_own_is_kept() -> None:
    assert [counted(n, "policy", "policies") for n in (1, 2)] == ["1 policy", "2 policies"]


@pytest.mark.parametrize("text", ["8", "8.0", "8,0", "8.00", " 8. "])
def test_a_whole_number_may_have_decimals_that_say_nothing(text: str) -> None:
    assert parse(QocIn, {"rating": text}, {}).rating == 8


@pytest.mark.parametrize("text", ["8.5", "8,1", "8.000", "8,000", ".0", "8.0.0"])
def test_other_decimals_are_no_whole_number(text: str) -> None:
    with pytest.raises(Invalid) as refused:
        parse(QocIn, {"rating": text}, {"rating": "Rating"})
    assert [e["what"] for e in refused.value.problem("/")["errors"]] == [f"'{text}' is no whole number"]


def test_the_interface_takes_a_whole_number_with_a_decimal() -> None:
    assert QocIn(rating=8.0).rating == 8  # type: ignore[arg-type]
    for wrong in (8.5, "8.0", True, float("nan")):
        with pytest.raises(ValidationError):
            QocIn(rating=wrong)  # type: ignore[arg-type]
