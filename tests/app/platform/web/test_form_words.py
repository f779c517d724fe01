"""What a form says of a value that its type refuses."""

from __future__ import annotations

import pytest

from app.platform.errors import Invalid
from app.platform.web.forms import parse
from app.study.enrolment.schemas import ParticipantIn


def test_a_pattern_is_not_shown_to_people() -> None:
    with pytest.raises(Invalid) as refused:
        parse(ParticipantIn, {"code": "bad code!!"}, {"code": "Code (letters, digits, - and _)"})
    assert refused.value.problem("/")["errors"] == [
        {"where": "Code (letters, digits, - and _)", "what": "'bad code!!' is not written as this field takes it", "name": "code"}
    ]
