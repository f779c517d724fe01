"""Study codes that may tell who somebody is. A code is questioned, never refused: only a person knows what it stands for."""

from __future__ import annotations

import re
from datetime import date
from enum import StrEnum
from itertools import pairwise


class CodeQuestion(StrEnum):
    """What a code looks like."""

    NAME = "name"
    BIRTH_YEAR = "birth_year"
    BIRTH_DATE = "birth_date"


STUDY_WORDS = frozenset(
    {"adapt", "baseline", "beta", "case", "clinic", "cohort", "control", "ctrl", "demo", "east", "group", "main", "north", "part"}
    | {"participant", "patient", "person", "pilot", "practice", "proband", "random", "screen", "site", "south", "study", "subj"}
    | {"subject", "test", "training", "trial", "volunteer", "west"}
)
"""Words of four letters and more that studies number their participants with."""
_OLDEST, _YOUNGEST = 110, 15
_DIGITS = re.compile(r"\d+")


def questions(code: str, today: date) -> tuple[CodeQuestion, ...]:
    """What there is to ask about a code; empty for one that tells nothing.

    A word with small letters after a capital (`JSmith`, `Lee`) or of four letters (`smith`, `ANNA`) looks like a name unless studies use it
    (STUDY_WORDS); four digits that can be the year somebody living was born in look like one (`P-1961`), and so do eight that are such a
    date (`19610412`, `12041961`).

    Args:
        code: letters, digits, hyphens and underscores. today: from which ages are counted.
    """
    found = []
    if any(w.lower() not in STUDY_WORDS for w in _names(code)):
        found.append(CodeQuestion.NAME)
    numbers = _DIGITS.findall(code)
    if any(len(n) == 4 and _of_somebody(int(n), today) for n in numbers):
        found.append(CodeQuestion.BIRTH_YEAR)
    if any(len(n) == 8 and _is_birth_date(n, today) for n in numbers) or _written_date(code, today):
        found.append(CodeQuestion.BIRTH_DATE)
    return tuple(found)


def _names(code: str) -> list[str]:
    """Runs of letters that can be names; a capital begins a new word within small letters, as in `JSmith`."""
    words = []
    for run in re.findall(r"[A-Za-z]+", code):
        if run.lower() in STUDY_WORDS:
            continue
        parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", run)
        mixed = not (run.isupper() or run.islower())
        words += [p for p in parts if (mixed and len(p) > 2 and p[0].isupper() and not p.isupper()) or len(p) > 3]
    return words


def _of_somebody(year: int, today: date) -> bool:
    return today.year - _OLDEST <= year <= today.year - _YOUNGEST


def _is_birth_date(digits: str, today: date) -> bool:
    orders = ((digits[:4], digits[4:6], digits[6:]), (digits[4:], digits[2:4], digits[:2]), (digits[4:], digits[:2], digits[2:4]))
    return any(_is_day(int(y), int(m), int(d), today) for y, m, d in orders)


def _written_date(code: str, today: date) -> bool:
    """Whether three numbers that follow each other are a date, as in `12-04-1961`."""
    parts = re.split(r"[-_]", code)
    triples = zip(pairwise(parts), parts[2:], strict=False)
    written = ("".join([*pair, last]) for pair, last in triples)
    return any(text.isdecimal() and len(text) == 8 and _is_birth_date(text, today) for text in written)


def _is_day(year: int, month: int, day: int, today: date) -> bool:
    if not _of_somebody(year, today):
        return False
    try:
        date(year, month, day)
    except ValueError:
        return False
    return True
