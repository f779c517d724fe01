"""Colours and times of the printed sheet, and text as its built-in PDF fonts can spell it, which have Latin-1 alone."""

from __future__ import annotations

import unicodedata
from datetime import datetime, time, timedelta

from app.planning.plans.view import PlanLine
from app.tables.learning import Policy
from app.tables.sessions import Controller

INK, MUTED, LINE = (20, 30, 38), (95, 108, 118), (150, 160, 168)
_PLANNED = (246, 248, 250)
_SHADES = {
    Controller.CDBS: (210, 228, 242),
    Controller.RL: (250, 221, 199),
    Controller.DISTILLED: (240, 214, 234),
    Controller.NO_DBS: (226, 229, 232),
    Controller.RANDOM: (207, 236, 226),
    Controller.OTHER: (240, 232, 200),
}

_SPELLED = str.maketrans(
    {
        "\u2013": "-", "\u2014": "-", "\u2212": "-", "\u2010": "-", "\u2011": "-", "\u2018": "'", "\u2019": "'",
        "\u201c": '"', "\u201d": '"', "\u201e": '"', "\u2026": "...", "\u2022": "-",
        "\u2264": "<=", "\u2265": ">=", "\u2260": "!=", "\u2248": "~", "\u2192": "->",
        "\u2190": "<-", "\u202f": " ", "\u2009": " ", "\u20ac": "EUR", "\u0152": "OE", "\u0153": "oe", "\u0141": "L", "\u0142": "l",
        "\u1e9e": "SS", "\u0131": "i", "\t": " ", "\r": "",
    }
)  # fmt: skip


def latin(text: str) -> str:
    """Spell text in the built-in fonts: Greek by name, accents dropped where need be, '?' for what has no spelling."""
    out = []
    for char in unicodedata.normalize("NFC", text).translate(_SPELLED):
        if char == "\n" or (32 <= ord(char) < 127) or (160 <= ord(char) < 256):
            out.append(char)
            continue
        name = unicodedata.name(char, "")
        if name.startswith(("GREEK SMALL LETTER ", "GREEK CAPITAL LETTER ")):
            letter = name.split(" LETTER ")[1].split(" WITH ")[0].removeprefix("FINAL ").lower()
            out.append(letter.capitalize() if "CAPITAL" in name else letter)
            continue
        plain = "".join(c for c in unicodedata.normalize("NFKD", char) if 32 <= ord(c) < 127)
        out.append(plain or ("" if unicodedata.category(char) in ("Mn", "Cf", "Cc") else "?"))
    return "".join(out)


def shade(line: PlanLine) -> tuple[int, int, int]:
    """Return the colour of a session's controller; of none while the key is sealed."""
    return _SHADES[Controller(line.item.controller)] if line.item.controller else _PLANNED


def printed_name(policy: Policy) -> str:
    """Spell a policy's name for the fonts, with its number where that is not the name itself: two policies never look alike."""
    printed = latin(policy.name)
    return printed if printed == policy.name else f"{printed} (#{policy.id})"


def printed_warning(text: str, policy: Policy | None) -> str:
    """Spell a warning with its policy's name for the fonts."""
    return text.replace(f"'{policy.name}'", f"'{printed_name(policy)}'") if policy else text


def clock(minutes: float, starts_at: time | None) -> str:
    """Write when something is due, `minutes` after the first session's start: by the clinic's clock, else h:mm from that start."""
    if starts_at is None:
        return f"{round(minutes) // 60}:{round(minutes) % 60:02d}"
    return f"{datetime.combine(datetime.min, starts_at) + timedelta(minutes=round(minutes)):%H:%M}"
