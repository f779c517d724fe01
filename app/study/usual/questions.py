"""What is asked about unusual values before they are kept: typed, and a person's word answers it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from app.platform.errors import Invalid
from app.study.usual import words
from app.study.usual.values import FAR, USUAL, Question, question


class Unusual(Invalid):
    """Values that a person has to confirm; `questions` has them."""

    def __init__(self, questions: Sequence[Question]) -> None:
        super().__init__(words.UNUSUAL, words.UNUSUAL_HINT, questions=[_told(q) for q in questions])
        self.questions = tuple(questions)


def require_sure(
    given: Mapping[str, Any], sure: Collection[str] | None, known: object = None, others: Mapping[str, Sequence[float]] | None = None
) -> None:
    """Raises Unusual for values outside the usual that nobody has confirmed; those that stand already are not asked about again.

    Args:
        given: name to value. known: the row with the present values.
        sure: names that a person has confirmed; None where no person can be asked, as of a program's call: nothing is asked then.
        others: by name, values of the visit's other sessions.
    """
    if sure is None:
        return
    asked = [
        question(name, value, (others or {}).get(name, ()))
        for name, value in given.items()
        if (name in USUAL or name in FAR) and value != getattr(known, name, None)
    ]
    refuse(replace(q, confirmed=q.field in sure) for q in asked if q is not None)


def refuse(asked: Iterable[Question]) -> None:
    """Raises Unusual with all questions where one is not confirmed, so that an answer to one is not lost while another is open."""
    found = list(asked)
    if not all(q.confirmed for q in found):
        raise Unusual(found)


def _told(asked: Question) -> dict[str, Any]:
    return {k: v for k, v in asdict(asked).items() if v is not None} | {"text": words.unusual(asked)}
