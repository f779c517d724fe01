"""Screening of notes for identity: dates, long numbers and addresses are refused, words that look like names are questioned.

The tablet screens by the same rules before it keeps a note (`static/visit-day/screening.js`). The words and patterns come from here,
written so that Python and JavaScript read them alike. A name in small letters, or one that is also a common word, is not seen.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal

_MONTHS = (
    "jan(?:uary)?", "feb(?:ruary)?", "mar(?:ch)?", "apr(?:il)?", "may", "june?", "july?", "aug(?:ust)?", "sept?(?:ember)?", "oct(?:ober)?",
    "nov(?:ember)?", "dec(?:ember)?",
)  # fmt: skip
_MONTH = f"(?:{'|'.join(_MONTHS)})"
PATTERNS: dict[str, tuple[str, ...]] = {
    "date": (
        r"\b[0-9]{1,4}[./-][0-9]{1,2}[./-][0-9]{1,4}\b",
        rf"\b[0-9]{{1,2}}(?:st|nd|rd|th)?(?: of)?[ .-]+{_MONTH}\b",
        rf"\b{_MONTH}\.?[ -]+[0-9]{{1,4}}\b",
    ),
    "number": (r"[0-9](?:[ ./()-]?[0-9]){3,}",),
    "address": (r"[^\s@]+@[^\s@]+",),
}
"""What is refused, tried in this order, letters of either case."""

_PLAIN = """
a about after again all also and another any are arm as asked at back battery because been before beta better both bradykinesia but by
cable calm can cannot change clinic clinician complained complains could dbs did difficulty dizziness dizzy drowsy during dysarthria
dyskinesia early eating eyes face fall feels felt fine finger foot for freezing from gait getting good grasp had hand has he headache
her his hz if in is it its jaw lead left leg less light like little lower medication mild moderate more mouth much nausea no none normal
not nothing now of off ok on once one only or our pain paraesthesia parkinson parkinsonian participant patient pause pulling rating
refused repeated reported reports rest rested resting restless right rigid rigidity said same says session severe she shortly sitting
slight slightly slow slowed slower slurred so some speech standing started stiff still stimulation stimulator stopped stronger symptom
symptoms tablet talking that the their then there these they this tingling tired to toilet told too transient tremor twice two unable
unchanged unsteady until very vision voice walking was watch water we weak went were when while with without worse yes
"""
PLAIN_WORDS = frozenset(_PLAIN.split())
"""Words that may begin a sentence with a capital without being questioned."""

_WORD = re.compile(r"[^\W\d_]+(?:['’-][^\W\d_]+)*")

Kind = Literal["date", "number", "address", "name"]


@dataclass(frozen=True)
class Found:
    """Something in a note that may say who the participant is."""

    kind: Kind
    text: str


def screen(text: str, no_names: Collection[str] = ()) -> list[Found]:
    """Find what a note may not contain, in the order date, number, address, name; each piece once.

    Args:
        text: the note.
        no_names: words that its writer says are no names.
    """
    found: list[Found] = []
    rest = text
    for kind, patterns in PATTERNS.items():
        for pattern in patterns:
            for match in re.finditer(pattern, rest, re.IGNORECASE):
                found.append(Found(kind, match[0].strip()))  # type: ignore[arg-type]
            rest = re.sub(pattern, " ", rest, flags=re.IGNORECASE)
    cleared = {w.lower() for w in no_names} | PLAIN_WORDS
    for match in _WORD.finditer(rest):
        word = match[0]
        acronym = word == word.upper() and len(word) <= 6
        if word[0] != word[0].lower() and not acronym and word.lower() not in cleared:
            found.append(Found("name", word))
    return list(dict.fromkeys(found))


def rules() -> dict[str, Any]:
    """Return the rules as the tablet takes them."""
    return {"patterns": {kind: list(patterns) for kind, patterns in PATTERNS.items()}, "plain_words": sorted(PLAIN_WORDS)}
