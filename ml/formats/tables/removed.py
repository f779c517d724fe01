"""Kinds of columns that were removed from a table: named by what their names resemble, never by the names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

_LIKE = (
    ("a date", re.compile(r"(^|_)(date|dob|born|birth|birthday|day|month|year|when|timestamp|datetime)s?(_|$)|\d{4}-\d\d-\d\d")),
    ("a note", re.compile(r"(^|_)(note|comment|remark|description|diagnosis|free_?text|text|memo|message)s?(_|$)")),
    (
        "an identifier",
        re.compile(
            r"(^|_)(id|ids|uuid|guid|mrn|ssn|serial|name|surname|initials|patient|subject|participant|person|user|wearer|operator|clinician|"
            r"doctor|device|email|mail|phone|address|site|hospital)s?(_|$)"
        ),
    ),
    ("a measurement", re.compile(r"(^|_)(lfp|beta|power|amplitude|accel|acc|gyro|rate|temp|temperature|battery|ma|uv|hz|[xyz])(_|$)")),
)
"""By words of the field, in this order: `birth_date` is like a date, `patient_note` like a note."""


def removed_columns(headers: Iterable[str]) -> list[str]:
    """Describe columns that are not carried over, with how many of them are called like what; empty where there are none."""
    kinds = Counter(_kind(header) for header in headers)
    if not kinds:
        return []
    total = sum(kinds.values())
    listed = [f"{kinds[like]} called like {like}" for like, _ in _LIKE if kinds[like]]
    listed += [f"{kinds['']} of no known kind"] if kinds[""] else []
    return [f"{total} other column{'s' if total != 1 else ''}: {', '.join(listed)}"]


PERSONAL = ("a date", "a note", "an identifier")
"""Likenesses of columns of which no cell is shown to anybody."""


def is_personal(header: str) -> bool:
    """Decide whether a column is called like one that identifies a person."""
    return _kind(header) in PERSONAL


def _kind(header: str) -> str:
    # words apart: patientName, patient-name and "Patient name (full)" are patient_name
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", header.strip())
    plain = re.sub(r"[^a-z0-9-]+|-(?!\d)", "_", words.lower())
    return next((like for like, shape in _LIKE if shape.search(plain)), "")
