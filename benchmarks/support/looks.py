"""Count of looks at the parts of the virtual population that nothing may be tuned on, kept in `looks.json`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("looks.json")
COUNTED = ("B", "C")


class LookError(ValueError):
    """This part must not be run now; the message says why and what to do."""


def counts(file: Path = FILE) -> dict[str, list[dict[str, Any]]]:
    """List the looks so far, by part, oldest first."""
    return json.loads(file.read_text())


def look(part: str, what: str, release: str | None = None, file: Path = FILE) -> None:
    """Write down a look before anything of it is computed; part A is free.

    Args:
        part: A, B or C. what: what is run, such as its command. release: the version that a run of part C belongs to. file: of the counts.

    Raises:
        LookError: part C without a release, or a second time for the same one.
    """
    if part not in COUNTED:
        return
    known = counts(file)
    if part == "C":
        if release is None:
            raise LookError("part C is run once, before a release: name it with --release VERSION, or take --part A")
        if any(seen["release"] == release for seen in known["C"]):
            raise LookError(f"part C has been run for release {release}; it can be run once more for another release only")
    anywhere = " ".join("FOLDER" if word.startswith("/") else word for word in what.split(" "))  # a path says nothing to other machines
    known[part].append({"what": anywhere, "release": release})
    file.write_text(json.dumps(known, indent=1) + "\n")


def said(file: Path = FILE) -> str:
    """Describe the looks so far in one sentence."""
    known = counts(file)
    return "; ".join(f"part {p} has been looked at {len(known[p])} time{'' if len(known[p]) == 1 else 's'}" for p in COUNTED)
