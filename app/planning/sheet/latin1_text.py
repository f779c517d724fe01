"""Text for the built-in PDF fonts, which have Latin-1 alone: spelled, never a crash."""

from __future__ import annotations

import unicodedata

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
    """Text in the characters that the built-in fonts have: Greek by name, accents dropped where need be, '?' for what has no spelling."""
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
