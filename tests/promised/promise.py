"""One promise of docs/trust.md, and how it is broken on purpose; they are listed in `tests/promises.py`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Promise:
    """Promise, a change of the code that breaks it (a file, a text that is in it once, another text), and the test."""

    said: str
    file: str
    old: str
    new: str
    test: str
    at_start: bool = False
    """Whether it is kept when the databases of all tests are made, so that it must be broken before."""


def of(file: str, *broken: tuple[str, str, str, str], at_start: bool = False) -> list[Promise]:
    """List promises that one file keeps: sentence, text, other text, test."""
    return [Promise(said, f"app/{file}.py", old, new, test, at_start) for said, old, new, test in broken]
