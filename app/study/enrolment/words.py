"""Words of what is asked about a study code."""

from __future__ import annotations

from collections.abc import Iterable

from app.study.enrolment.codes import CodeQuestion

CODE_QUESTIONS = {
    CodeQuestion.NAME: "it holds a word that may be a name",
    CodeQuestion.BIRTH_YEAR: "it holds a year in which a participant may have been born",
    CodeQuestion.BIRTH_DATE: "it holds a date on which a participant may have been born",
}
CODE_HINT = "Choose a code that tells nothing about the person, or confirm that this is a study code."
CODE_CONFIRMED = "looked at by a person: a study code"


def code_questions(code: str, found: Iterable[CodeQuestion]) -> str:
    """What a study code looks like."""
    return f"The code '{code}' may tell who the participant is: {' and '.join(CODE_QUESTIONS[q] for q in found)}."
