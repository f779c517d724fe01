"""The masked parts of a blinded session's log, read again: the inverse of what `ml.deploy.runtime.decision_log` masks."""

from __future__ import annotations

import hashlib
import json
import math
import struct
from typing import Any

_NONCE_DIGITS = 32
_ROW = struct.Struct(">id")


def facts_of(text: str) -> tuple[str, dict[str, Any]]:
    """Read the nonce of a log, and the facts in its head. Raises ValueError for another text."""
    nonce, masked = text[:_NONCE_DIGITS], bytes.fromhex(text[_NONCE_DIGITS:])
    facts = json.loads(_unmask(masked, nonce, "facts"))
    if not isinstance(facts, dict):
        raise ValueError("no object")
    return nonce, facts


def row_of(text: str, nonce: str) -> tuple[int, float]:
    """Read hold and log density of a row, -1 and NaN where nothing was drawn. Raises ValueError for another text."""
    number, _, masked = text.partition(":")
    try:
        hold, density = _ROW.unpack(_unmask(bytes.fromhex(masked), nonce, f"row {int(number)}"))
    except struct.error as error:
        raise ValueError("of another length") from error
    if hold < -1 or math.isinf(density):
        raise ValueError("no hold")
    return hold, density


def _unmask(content: bytes, nonce: str, part: str) -> bytes:
    stream = hashlib.shake_256(bytes.fromhex(nonce) + part.encode()).digest(len(content))
    return bytes(a ^ b for a, b in zip(content, stream, strict=True))
