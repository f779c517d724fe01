"""Rows of a study's sheet and sessions of its files: which belong together, by the file they name, else by participant and time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta

from ml.formats.studies.parts import name_part
from ml.formats.studies.sheet import SheetRow

EARLY_S = 300.0
"""A session's noted start may be this much before its recording began: people write down minutes, and streams take a while to start."""
GRID_S = 5.0
"""A session that was cut out of a recording begins at a step of it, at most this far after its noted start."""

CLEARLY_S = 60.0
"""Two sessions that begin after a noted start are distinguished where one begins this much sooner."""


@dataclass(frozen=True)
class Candidate:
    """A session that the files hold.

    Attributes:
        key: number of the session, or of the find in a dry run. file, sha256: where it came from.
        started_at: UTC; None where unknown. clock_known: whether it can be compared with a time at all. uncertainty_s: of its clock.
    """

    key: int
    participant: str
    file: str
    sha256: str
    started_at: datetime | None
    duration_s: float
    hemisphere: str | None = None
    clock_known: bool = True
    uncertainty_s: float = 0.0

    def distance_s(self, start: datetime) -> float | None:
        """Compute how far the candidate's own start is from a noted one, s; None where the noted one cannot lie in it."""
        if self.started_at is None or not self.clock_known:
            return None
        after_s = (start - self.started_at).total_seconds()
        slack_s = EARLY_S + self.uncertainty_s
        return abs(after_s) if -slack_s <= after_s < self.duration_s + self.uncertainty_s else None


@dataclass
class Matches:
    """Result of matching.

    Attributes:
        pairs: rows of each candidate, by their start; several share one recording.
        rows: rows without a candidate, and why. candidates: without a row.
    """

    pairs: list[tuple[Candidate, list[SheetRow]]] = field(default_factory=list)
    rows: list[tuple[SheetRow, str]] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)


def match(rows: Sequence[SheetRow], candidates: Sequence[Candidate]) -> Matches:
    """Match rows to candidates. A row that fits two candidates, or none, is listed and never guessed.

    A row that names a file or its SHA-256 belongs to that alone. Else the noted start must lie in the candidate's time; else its day must
    have one row and one candidate of the participant.
    """
    out = Matches()
    found: dict[int, list[SheetRow]] = defaultdict(list)
    own = defaultdict(list)
    for candidate in candidates:
        own[candidate.participant.casefold()].append(candidate)
    for row in rows:
        mine = [c for c in own[row.participant.casefold()] if row.hemisphere is None or c.hemisphere in (None, row.hemisphere)]
        chosen, why = _choose(row, mine, rows)
        if chosen is None:
            out.rows.append((row, why))
        else:
            found[chosen.key].append(row)
    for candidate in candidates:
        together = found.get(candidate.key, [])
        if not together:
            out.candidates.append(candidate)
        elif len(together) > 1 and any(r.start is None for r in together):
            lines = ", ".join(str(r.line) for r in together)
            out.rows += [(r, f"lines {lines} are of one session, {candidate.file}, and do not all state their start") for r in together]
            out.candidates.append(candidate)
        else:
            out.pairs.append((candidate, sorted(together, key=lambda r: (r.start is None, r.start))))
    return out


def _choose(row: SheetRow, mine: Sequence[Candidate], rows: Sequence[SheetRow]) -> tuple[Candidate | None, str]:
    """Find the candidate of a row; None, and why."""
    if not mine:
        return None, f"no file of participant {row.participant} holds a session"
    if row.sha256 or row.file:
        named = [c for c in mine if (c.sha256 == row.sha256 if row.sha256 else _is_named(row.file or "", c.file))]
        if not named and not row.sha256:
            named = [c for c in mine if _is_named(row.file or "", c.file.rsplit("/", 1)[0])]  # a file of several parts
        if row.session is not None and len(named) > 1:
            named = [c for c in named if _is_named(name_part(row.session), c.file)]
        if row.start is not None and len(named) > 1:
            named = _nearest(row.start, named) or named
        if len(named) == 1:
            return named[0], ""
        what = row.file or f"SHA-256 {(row.sha256 or '')[:12]}"
        return None, f"{len(named)} sessions are in {what}" if named else f"no session is in {what}"
    if row.start is not None:
        near = _nearest(row.start, mine)
        if len(near) == 1:
            return near[0], ""
        return None, f"{len(near)} sessions hold {row.start:%Y-%m-%d %H:%M} UTC" if near else _none_at(row.start, mine)
    if row.day is not None:
        there = [c for c in mine if c.clock_known and c.started_at is not None and c.started_at.date() == row.day]
        alike = [r for r in rows if r.participant == row.participant and r.day == row.day and r.start is None and not r.file]
        if len(there) == 1 == len(alike):
            return there[0], ""
        return None, f"{len(there)} sessions and {len(alike)} rows without a start are of {row.day}: state the starts"
    return None, "the row states neither a file nor a start nor a date"


def _nearest(start: datetime, candidates: Sequence[Candidate]) -> list[Candidate]:
    """List the candidates that may be meant by a moment: those whose own time has it, else the one that begins clearly next."""
    near = sorted((d, c.key, c) for c in candidates if (d := c.distance_s(start)) is not None)
    inside = [c for _, _, c in near if c.started_at is not None and (c.started_at - start).total_seconds() <= GRID_S]
    if inside or not near:
        return inside
    return [c for d, _, c in near if d < near[0][0] + CLEARLY_S]


def _none_at(start: datetime, mine: Sequence[Candidate]) -> str:
    dated = [c for c in mine if c.started_at is not None and c.clock_known]
    if not dated:
        return f"none of {len(mine)} sessions states a start on a known clock: name the file"
    nearest = min(dated, key=lambda c: abs((c.started_at or start) - start))
    apart = abs((nearest.started_at or start) - start)
    return f"no session holds {start:%Y-%m-%d %H:%M} UTC; the nearest, {nearest.file}, is {apart / timedelta(minutes=1):.0f} min away"


def _is_named(name: str, file: str) -> bool:
    """Decide whether a sheet's name of a file is that of a path, whole or from one of its folders on."""
    one, other = (text.replace("\\", "/").casefold().strip("/") for text in (name, file))
    return other == one or other.endswith(f"/{one}") or other.rsplit("/", 1)[-1].rsplit(".", 1)[0] == one
