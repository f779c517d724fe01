"""What a form says of a value that its type refuses."""

from __future__ import annotations

import pytest

from app.platform.errors import Invalid
from app.platform.web.charts import counted
from app.platform.web.forms import parse
from app.study.enrolment.schemas import ParticipantIn


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
