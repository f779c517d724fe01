"""Common part of the redactors: the account of what one did, and the keyed pseudonym of a device."""

from __future__ import annotations

import hmac
import re
from dataclasses import dataclass, field
from hashlib import sha256

REDACTOR_VERSION = 8
PSEUDONYM = re.compile(r"device-[0-9a-f]{16}")


@dataclass(slots=True)
class Redaction:
    """Account of a redaction, in sentences for the upload's report.

    Attributes:
        removed: identity that was taken out.
        repaired: defects met; the redacted file is whole and no longer shows them.
        flagged: losses met; the redacted file has a mark in their place.
        ignored: files and rows not carried over.
        unreadable: files of the session that could not be read at all, so could not be redacted.
    """

    removed: list[str] = field(default_factory=list)
    repaired: list[str] = field(default_factory=list)
    flagged: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)


def pseudonym(serial: str, key: bytes) -> str:
    """Make the keyed pseudonym of a device; a pseudonym stays as it is. Raises ValueError for a key under 16 bytes."""
    if len(key) < 16:
        raise ValueError("the pseudonym key must have at least 16 bytes")
    if PSEUDONYM.fullmatch(serial):
        return serial
    return "device-" + hmac.new(key, serial.strip().upper().encode(errors="replace"), sha256).hexdigest()[:16]


_NUMBER = re.compile(r"\s*([+-]?\d{1,6}(?:\.\d{1,12})?(?:[eE][+-]?\d{1,2})?)\s*", re.ASCII)


def number_in(text: str) -> float | None:
    """Read a number that is written as text, as some versions of a program do; None for anything else.

    Longer whole numbers may be those of a person, and are not read.
    """
    found = _NUMBER.fullmatch(text)
    return float(found[1]) if found else None
