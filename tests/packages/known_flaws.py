"""Are flaws of the pinned packages publicly known? `make check` asks OSV (https://osv.dev) about requirements.lock, in one request.

Exit code 1: flaws are known. Where the list cannot be asked, that is reported in one line: exit code 0, or 2 with `--required` (`make
audit`).
"""

from __future__ import annotations

import argparse
import json
import sys
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
OSV = "https://api.osv.dev"
PATIENCE_S = 15.0
"""Longest time of all of it: a machine without network must not wait, and looking up a name can take longer than a socket may."""
CANARY = ("jinja2", "2.4.1")
"""A version with known flaws, asked about as well: who knows of none for it is not the list, whatever it answers."""
ACCEPTED: dict[str, str] = {}
"""Known flaws that do not touch betaloop and cannot be corrected by another version, by number, each with the reason."""


class NotDone(Exception):
    """The list could not be asked."""


@dataclass(frozen=True)
class Flaw:
    """A known flaw of a pinned package."""

    package: str
    version: str
    number: str
    summary: str


def pinned(lock: Path) -> list[tuple[str, str]]:
    """Name, written as the list writes it, and version of every package of a lock."""
    lines = [line.split("#")[0].strip() for line in lock.read_text().splitlines()]
    return [(canonicalize_name(name), version) for name, _, version in (line.partition("==") for line in lines) if version]


def known_flaws(packages: list[tuple[str, str]], address: str) -> list[Flaw]:
    """Find every known flaw of some packages but the accepted and the withdrawn ones. Raises NotDone."""
    queries = [{"package": {"name": n, "ecosystem": "PyPI"}, "version": v} for n, v in [CANARY, *packages]]
    try:
        answers = _asked(f"{address}/v1/querybatch", {"queries": queries})["results"]
        numbers = [[str(flaw["id"]) for flaw in answer.get("vulns", ())] for answer in answers]
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise NotDone(f"{address} cannot be asked ({error})") from error
    if len(numbers) != len(queries) or not numbers[0]:
        raise NotDone(f"{address} knows no flaw of {' '.join(CANARY)}, which has some: that is not the list")
    found = [(package, number) for package, of in zip(packages, numbers[1:], strict=True) for number in of if number not in ACCEPTED]
    return [Flaw(*package, number, text) for package, number in found if (text := _summary(number, address)) is not None]


def _summary(number: str, address: str) -> str | None:
    """Describe a flaw; None of one that was withdrawn. One that cannot be looked up counts."""
    try:
        said = _asked(f"{address}/v1/vulns/{number}")
    except (OSError, ValueError):
        return "(its description cannot be read for the moment)"
    return None if said.get("withdrawn") else str(said.get("summary") or said.get("details", ""))[:200]


def _asked(address: str, body: Any = None) -> dict[str, Any]:
    data = json.dumps(body).encode() if body is not None else None
    request = urllib.request.Request(address, data, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
        return dict(json.loads(answer.read()))


def in_time(packages: list[tuple[str, str]], address: str) -> list[Flaw]:
    """Find `known_flaws` within PATIENCE_S. Raises NotDone."""
    outcome: list[list[Flaw] | BaseException] = []

    def ask() -> None:
        try:
            outcome.append(known_flaws(packages, address))
        except BaseException as error:  # raised again where it is waited for
            outcome.append(error)

    thread = Thread(target=ask, daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    if not outcome:
        raise NotDone(f"{address} did not answer within {PATIENCE_S:g} s")
    if isinstance(outcome[0], BaseException):
        raise outcome[0]
    return outcome[0]


def main(arguments: list[str]) -> int:
    """Ask, and say what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--required", action="store_true", help="fail where the list cannot be asked")
    parser.add_argument("--lock", type=Path, default=ROOT / "requirements.lock")
    parser.add_argument("--address", default=OSV, help="of the list")
    given = parser.parse_args(arguments)
    packages = pinned(given.lock)
    try:
        flaws = in_time(packages, given.address)
    except NotDone as reason:
        sys.stdout.write(f"Known flaws of the pinned packages: NOT CHECKED, {reason}." + "\n")
        return 2 if given.required else 0
    for flaw in flaws:
        sys.stdout.write(f"{flaw.package} {flaw.version}: {flaw.number} {flaw.summary}" + "\n")
    sys.stdout.write(f"Known flaws of the {len(packages)} pinned packages: {len(flaws) or 'none'} ({given.address})." + "\n")
    return 1 if flaws else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
