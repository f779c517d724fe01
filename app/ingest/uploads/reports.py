"""Storage of the reports of uploaded files."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from typing import Any

from app.ingest import wording
from app.tables.uploads import PREVIEW, UploadFile
from ml.formats import FileReport, Problem, Redaction

BEGUN = "begun"
"""Member of a file's report: how often reading it was begun, while it is being read."""
ASIDE = "aside_sha256"
"""Member of a file's report: hash of its bytes without identity, where these are what the quarantine holds, and not the original."""


def store_reports(
    row: UploadFile, reports: Sequence[FileReport], known: Sequence[int] = (), unreadable: Sequence[str] | None = None
) -> None:
    """Store a file's reports, which of its recordings came before in other files, and which members could not be read (None: as stored)."""
    found = unreadable_members(row) if unreadable is None else list(unreadable)
    for report in reports:
        count_equal_lines(report)
    row.report = {"reports": [asdict(r) for r in reports], "known_recordings": list(known), "unreadable": found, **lasting(row)}


def lasting(row: UploadFile) -> dict[str, Any]:
    """Select the members of a file's report that stay when it is written again: `ASIDE` and `PREVIEW`, where it has them."""
    return {name: row.report[name] for name in (ASIDE, PREVIEW) if name in (row.report or {})}


def count_equal_lines(report: FileReport) -> None:
    """Make one line, with a count, of equal lines in each of a report's lists."""
    for lines in (report.understood, report.repaired, report.ignored, report.flagged, report.removed):
        lines[:] = [line if n == 1 else f"{line} ({n}×)" for line, n in Counter(lines).items()]


def alike_together(reports: Sequence[FileReport]) -> list[FileReport]:
    """Join reports that say the same of different files, named by how many there are and the first of them."""
    alike: dict[str, list[FileReport]] = defaultdict(list)
    for report in reports:
        alike[repr(replace(report, name=""))].append(report)
    return [same[0] if len(same) == 1 else replace(same[0], name=f"{same[0].name} and {len(same) - 1} more") for same in alike.values()]


def stored_reports(row: UploadFile) -> list[FileReport]:
    """Read the stored reports of a file."""
    # a copy: sentences appended to the stored lists themselves would not be seen as a change, and not be written
    stored = deepcopy(row.report.get("reports", []))
    return [FileReport(**{**r, "problem": r["problem"] and Problem(**r["problem"])}) for r in stored]


def unreadable_members(row: UploadFile) -> list[str]:
    """List members of a stored file that could not be read, and why."""
    found: list[str] = (row.report or {}).get("unreadable", [])
    return found


def known_recordings(row: UploadFile) -> list[int]:
    """List recordings of a file that another file had brought before."""
    found: list[int] = row.report.get("known_recordings", [])
    return found


def add_redaction(report: FileReport, redaction: Redaction, notes: Sequence[str]) -> None:
    """Add to a report what cleaning the file found, and what was made of it."""
    for ours, found in (
        (report.removed, redaction.removed),
        (report.repaired, redaction.repaired),
        (report.flagged, redaction.flagged),
        (report.ignored, redaction.ignored),
    ):
        ours.extend(sentence for sentence in found if sentence not in ours)
    report.flagged.extend(wording.unreadable(redaction.unreadable))
    report.understood.extend(notes)
