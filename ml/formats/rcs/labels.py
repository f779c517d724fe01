"""Operator's notes of the RC+S event log, reduced to what a closed grammar allows: nothing else of the free text is kept.

`parse(render(parse(text))) == parse(text)`, so a redacted log gives the same labels as the original.
"""

from __future__ import annotations

import re
from typing import Any

_NUMBER = r"(?<![\w.,])(\d{1,%d}(?:\.\d{1,2})?)\s*"
_AMPLITUDE = re.compile(_NUMBER % 2 + r"mA\b", re.IGNORECASE)
_RATE = re.compile(_NUMBER % 3 + r"Hz\b", re.IGNORECASE)
_WIDTH = re.compile(_NUMBER % 4 + r"[μµu]s\b")
_GROUP = re.compile(r"\bgroup\s+([A-D])\b", re.IGNORECASE)
_CONFIG = re.compile(r"\bconfig\s?(\d{1,2})\b", re.IGNORECASE)
_VERB = re.compile(r"^\s*(start|stop)\b", re.IGNORECASE)
NO_LABEL = "note"


def parse(*texts: object) -> dict[str, Any]:
    """Parse what the texts state about stimulation: any of `verb`, `amplitude_ma`, `rate_hz`, `pulse_width_us`, `group`, `config`.

    A quantity named with two different values is ignored: the note cannot be compared with the device.
    """
    found: dict[str, Any] = {}
    whole = [text[:2000] for text in texts if isinstance(text, str)]
    verbs = {match[1].lower() for text in whole if (match := _VERB.match(text))}
    if len(verbs) == 1:
        found["verb"] = verbs.pop()
    for name, pattern in (("amplitude_ma", _AMPLITUDE), ("rate_hz", _RATE), ("pulse_width_us", _WIDTH)):
        values = {float(value) for text in whole for value in pattern.findall(text)}
        if len(values) == 1:
            found[name] = values.pop()
    groups = {value.upper() for text in whole for value in _GROUP.findall(text)}
    if len(groups) == 1:
        found["group"] = groups.pop()
    configs = {int(value) for text in whole for value in _CONFIG.findall(text)}
    if len(configs) == 1:
        found["config"] = configs.pop()
    return found


def render(found: dict[str, Any]) -> str:
    """Write the label in one fixed spelling; `note` when nothing of it is known."""
    parts = [found["verb"]] if "verb" in found else []
    for name, text in (
        ("amplitude_ma", "{:g} mA"),
        ("rate_hz", "{:g} Hz"),
        ("pulse_width_us", "{:g} us"),
        ("group", "group {}"),
        ("config", "config {}"),
    ):
        if name in found:
            parts.append(text.format(found[name]))
    return ", ".join(parts) or NO_LABEL
