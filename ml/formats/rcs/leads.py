"""Side and target of the leads of an RC+S recording: the one fact of SubjectInfo that is stored, through a closed grammar.

`LeadTargets` names the target of each of four leads, with or without a side ("STN", "Left STN", "R GPi"). `LeadLocation` gives the side as
a code: 1 is left, 2 is right (recordings with code 2 call their programs "R STN" and "R GPi"). Leads 0 and 1 belong to the first bore
(time-domain keys 0 and 1, contacts 0 to 7), leads 2 and 3 to the second.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from ml.formats.rcs.settings import get, integer
from ml.formats.recording import Hemisphere

LEADS = 4
TARGETS = ("STN", "GPi", "GPe", "VIM", "Vo", "ANT", "CM", "PPN", "SNr", "ZI", "NAc", "VC/VS", "M1", "S1", "PMC", "SMA", "PFC", "OFC", "ACC")
_SIDES: dict[str, Hemisphere] = {"l": "left", "left": "left", "r": "right", "right": "right"}
_CODES: dict[int, Hemisphere] = {1: "left", 2: "right"}
_KNOWN = {target.lower(): target for target in TARGETS}
_WORDS = re.compile(r"[a-z0-9/]+", re.IGNORECASE)


def clean_leads(subject: Any) -> dict[str, Any]:
    """Reduce SubjectInfo to side and target per lead, always in the same spelling; empty where neither is known.

    A text with any word outside the grammar says nothing: what remains can be no name.
    """
    texts, codes = get(subject, "LeadTargets"), get(subject, "LeadLocation")
    targets = [_target(get(texts, i)) for i in range(LEADS)] if isinstance(texts, list) else [""] * LEADS
    sides = [integer(get(codes, i)) for i in range(LEADS)] if isinstance(codes, list) else [None] * LEADS
    known = [code if code in _CODES else 0 for code in sides]
    return {"LeadTargets": targets, "LeadLocation": known} if any(targets) or any(known) else {}


def _target(text: Any) -> str:
    """Extract `right STN`, `STN`, `right` or nothing."""
    if not isinstance(text, str) or len(text) > 40:
        return ""
    words = [word.lower() for word in _WORDS.findall(text)]
    sides = {_SIDES[word] for word in words if word in _SIDES}
    targets = {_KNOWN[word] for word in words if word in _KNOWN}
    if len(words) != len(sides) + len(targets) or len(sides) > 1 or len(targets) > 1:
        return ""
    return " ".join([*sides, *targets])


def leads_only(record: dict[str, Any]) -> dict[str, Any]:
    """Reduce the `SubjectInfo` entry of a settings record to its leads, empty where it names none."""
    found = clean_leads(record["SubjectInfo"]) if "SubjectInfo" in record else {}
    return {"SubjectInfo": found} if found else {}


def sides(subject: Any) -> tuple[Hemisphere | None, ...]:
    """Find the side of each lead, from its name and its code; None where both are silent, they differ, or no lead is there."""
    found = clean_leads(subject)
    out: list[Hemisphere | None] = []
    for i in range(LEADS):
        words = str(get(found, "LeadTargets", i) or "").split()
        named = next((_SIDES[word] for word in words if word in _SIDES), None)
        coded = _CODES.get(get(found, "LeadLocation", i) or 0)
        out.append((named or coded) if words and (named is None or coded is None or named == coded) else None)
    return tuple(out)


def hemisphere(subject: Any, keys: Iterable[int]) -> Hemisphere | None:
    """Find the side that all leads behind the given time-domain keys share; all leads where no key is given. None when they do not
    agree."""
    bores = {key // 2 for key in keys} or {0, 1}
    found, targets = sides(subject), get(clean_leads(subject), "LeadTargets") or [""] * LEADS
    there = {found[i] for bore in bores for i in (2 * bore, 2 * bore + 1) if targets[i]}
    return there.pop() if len(there) == 1 else None


def described(subject: Any) -> list[str]:
    """Describe leads in words for the recording's settings, such as `right STN`; empty where there is none."""
    targets = get(clean_leads(subject), "LeadTargets") or [""] * LEADS
    return [
        " ".join([side, *(w for w in target.split() if w not in _SIDES)]) if side else target
        for side, target in zip(sides(subject), targets, strict=True)
    ]
