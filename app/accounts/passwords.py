"""Passwords: which are too easy to guess, and argon2 with few at once, so that many sign-ins at once delay no other request.

Refused are rows of keys, few different characters, common words and one's own address and name with additions.

`zxcvbn` knows what people choose most: passwords that became known, words and names of English, dates, ways over the keyboard. It estimates
after how many guesses each would be found. Our own rules add words of a clinic and of other languages.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from pwdlib.hashers.argon2 import Argon2Hasher

from app.platform.errors import TooMany

MIN_PASSWORD = 10
LEAST_GUESSES = 1e9
"""More than a common word with a year and a sign behind it takes, and less than ten characters drawn at random do (1e10)."""
MOST_JUDGED = 32
"""Characters that are estimated, the first of a longer password: to estimate these takes a second at worst, 72 ten times as long."""
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


AT_ONCE = 2
"""How many passwords are hashed at the same moment in a process: argon2 takes all of a core, and 19 MiB, each time."""
MOST_PRESENT = 20
"""Number of users who may hash or wait for their turn, in addition to sign-ins, which wait elsewhere: half of the threads that answer
requests."""

_turns = threading.BoundedSemaphore(AT_ONCE)
_places = threading.BoundedSemaphore(MOST_PRESENT)
_estimating = threading.Lock()


def weakness(password: str, email: str = "", name: str = "") -> str | None:
    """Explain why a password is too easy to guess, to follow "The password"; None where it is not.

    Args:
        email, name: of whom it is; their parts count as common words.
    """
    if len(password) < MIN_PASSWORD:
        return f"has {len(password)} characters"
    folded = password.casefold()
    if len(set(folded)) < _LEAST_DIFFERENT:
        return f"has only {len(set(folded))} different characters"
    if len(re.sub(r"[^\w]|_", "", _without_rows(folded))) < _LEAST_REST:
        return "is a row of keys, letters or digits"
    own = {part for part in re.split(r"[\W\d_]+", f"{email} {name}".casefold()) if len(part) >= 3}
    words = sorted({*_WORDS, *own}, key=len, reverse=True)
    # digits were read as letters where they replace some; the rest of a year or of an exclamation mark is no word
    kept = [typed for typed, read in zip(folded, _aligned(folded, words), strict=True) if read and typed.isalpha()]
    if len(kept) < _LEAST_REST:
        return f"has fewer than {_LEAST_REST} letters that belong neither to a common word nor to the e-mail address or name"
    if _guesses(password, [email, name, *words]) < LEAST_GUESSES:
        return "is one of those that are guessed first: a common password, word, name, date or way over the keyboard, or little more"
    return None


def _guesses(password: str, words: list[str]) -> float:
    """Estimate after how many guesses the first characters of a password would be found, beginning with what is chosen most."""
    from zxcvbn import zxcvbn  # its lists take a moment to load, and are needed where a password is set alone

    with _estimating:  # it keeps the words of its caller where every thread reads them
        return float(zxcvbn(password[:MOST_JUDGED], user_inputs=words)["guesses"])


def _aligned(folded: str, words: list[str]) -> list[bool]:
    """Mark the characters that are part of no word."""
    read, kept = folded.translate(_READ_AS), [True] * len(folded)
    for word in words:
        for found in re.finditer(re.escape(word), read):
            kept[found.start() : found.end()] = [False] * len(word)
    return kept


def _without_rows(text: str) -> str:
    """Remove stretches of a row of keys, forwards or backwards, and repetitions of one character."""
    left = re.sub(r"(.)\1{2,}", "", text)
    for row in _ROWS:
        for line in (row, row[::-1]):
            for length in range(len(line), _LEAST_RUN - 1, -1):
                for start in range(len(line) - length + 1):
                    left = left.replace(line[start : start + length], "")
    return left


class FewAtOnce(Argon2Hasher):
    """Argon2, of which AT_ONCE run at the same moment in this process, in whichever threads; the others wait."""

    def hash(self, password: str | bytes, *, salt: bytes | None = None) -> str:
        """Compute the hash to store."""
        with _turns:
            return super().hash(password, salt=salt)

    def verify(self, password: str | bytes, hash: str | bytes) -> bool:
        """Verify a password against a stored hash."""
        with _turns:
            return super().verify(password, hash)


@contextmanager
def place() -> Iterator[None]:
    """Take a place among those who wait for their turn, before a try is counted: a user who is sent away has tried nothing.

    Raises:
        TooMany: MOST_PRESENT are here; more would hold up every other request, for each holds a thread.
    """
    if not _places.acquire(blocking=False):
        raise TooMany("Too many people give a password at the same moment.", "Nothing was changed; wait a few seconds and try again.")
    try:
        yield
    finally:
        _places.release()
