"""Which passwords are too easy to guess: rows of keys, few different characters, common words and one's own address with additions."""

from __future__ import annotations

import re

MIN_PASSWORD = 10
_LEAST_DIFFERENT = 5
_LEAST_REST = 4
"""So many characters must be left when rows of keys, or common words, are taken out."""
_LEAST_RUN = 4

_ROWS = (
    "abcdefghijklmnopqrstuvwxyz", "01234567890", "qwertyuiop", "qwertzuiop", "azertyuiop", "asdfghjkl", "qsdfghjklm", "zxcvbnm", "yxcvbnm",
)  # fmt: skip
_WORDS = (
    "password", "passwort", "passphrase", "passcode", "passwd", "kennwort", "parola", "motdepasse", "contrasena", "welcome", "willkommen",
    "bienvenue", "administrator", "admin", "letmein", "secret", "default", "changeme", "changeit", "login", "signin", "access", "iloveyou",
    "sunshine", "princess", "dragon", "monkey", "football", "baseball", "superman", "batman", "master", "shadow", "freedom", "whatever",
    "trustno", "hello", "summer", "winter", "spring", "autumn", "january", "february", "march", "april", "june", "july", "august",
    "september", "october", "november", "december", "monday", "friday", "hospital", "clinic", "doctor", "nurse", "patient", "neurology",
    "parkinson", "stimulation", "stimulator", "brain", "betaloop", "guest", "demo", "user", "study", "test",
)  # fmt: skip
_READ_AS = str.maketrans({"0": "o", "1": "i", "3": "e", "4": "a", "5": "s", "7": "t", "8": "b", "@": "a", "$": "s", "!": "i", "|": "i"})


def weakness(password: str, email: str = "") -> str | None:
    """Why a password is too easy to guess, to follow "The password"; None where it is not.

    Args:
        email: of whom it is; its parts count as common words.
    """
    if len(password) < MIN_PASSWORD:
        return f"has {len(password)} characters"
    folded = password.casefold()
    if len(set(folded)) < _LEAST_DIFFERENT:
        return f"has only {len(set(folded))} different characters"
    if len(re.sub(r"[^\w]|_", "", _without_rows(folded))) < _LEAST_REST:
        return "is a row of keys, letters or digits"
    words = sorted({*_WORDS, *(part for part in re.split(r"[^a-z]+", email.casefold()) if len(part) >= 3)}, key=len, reverse=True)
    # digits were read as letters where they stand for some; what is left of a year or of an exclamation mark is no word
    kept = [typed for typed, read in zip(folded, _aligned(folded, words), strict=True) if read and typed.isalpha()]
    if len(kept) < _LEAST_REST:
        return f"has fewer than {_LEAST_REST} letters that belong neither to a common word nor to the e-mail address"
    return None


def _aligned(folded: str, words: list[str]) -> list[bool]:
    """Which characters are part of no word."""
    read, kept = folded.translate(_READ_AS), [True] * len(folded)
    for word in words:
        for found in re.finditer(re.escape(word), read):
            kept[found.start() : found.end()] = [False] * len(word)
    return kept


def _without_rows(text: str) -> str:
    """The text without stretches of a row of keys, forwards or backwards, and without repetitions of one character."""
    left = re.sub(r"(.)\1{2,}", "", text)
    for row in _ROWS:
        for line in (row, row[::-1]):
            for length in range(len(line), _LEAST_RUN - 1, -1):
                for start in range(len(line) - length + 1):
                    left = left.replace(line[start : start + length], "")
    return left
