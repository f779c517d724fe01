"""Copies of the same minutes. A recording is what a device and side had in a stretch of time, in whatever set of files it comes.

The fuller copy counts. A copy without anything new is not stored again. A fuller one replaces the stored one in its sessions, except in
locked visits. Where both differ, or each has what the other lacks, both are kept and a person decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.ingest import repository
from app.ingest.proposals import service as proposals
from app.study import repository as study
from app.study.sessions import conditions
from app.study.traces import unpack
from app.tables.recordings import Recording, Trace
from app.tables.sessions import SessionSegment, StudySession
from ml.formats import TraceLog
from ml.formats.beta import ERROR_STREAM

BETA = "beta"
NEURAL = (BETA, "band_power")
"""Streams that show whether two recordings have the same signal."""
FEWEST_ROWS = 5
"""Fewest rows of a channel in both recordings for which they are compared."""
EXACT_S = 0.001
EQUAL_SHARE = 0.8
"""Share of rows on the same grid that are equal where two copies hold the same signal; ends and gaps may be cut elsewhere."""
WITHIN_ERRORS = 0.25
"""Largest difference between rows with gaps of two copies, as a share of their standard error. The same samples are there, and what fills
the gaps is predicted from all that each copy has."""
TELLING = 0.5
"""Largest tolerance that separates two signals, as a share of the rows' standard deviation."""
LIKE = 0.5
"""Correlation of rows on shifted grids, of which each covers a part of two others, from which on the signal is the same."""
LOST = 0.02
"""Share of its rows (and at least one) that a channel of the fuller copy may have fewer: ends are cut elsewhere."""

Channel = tuple[str, str]


class Relation(StrEnum):
    """Relation of a new recording to a stored one of the same minutes."""

    NO_MORE = "no_more"
    FULLER = "fuller"
    EACH_ITS_OWN = "each_its_own"
    DIFFERS = "differs"


@dataclass(frozen=True)
class Rows:
    """A trace for comparison: ends of its rows in s of a common clock, values with NaN where invalid, both [n].

    `error` is the standard error of each value for what is missing of its row, [n]; None where none is known, as of whole rows.
    """

    end_s: NDArray[np.float64]
    values: NDArray[np.float64]
    dt_s: float
    unit: str
    error: NDArray[np.float64] | None = None

    @property
    def errors(self) -> NDArray[np.float64]:
        """Standard errors, 0 where none is known, [n]."""
        return np.zeros(self.values.size) if self.error is None else np.nan_to_num(self.error)

    @property
    def valid_end_s(self) -> NDArray[np.float64]:
        """Ends of the rows that have a value."""
        ends: NDArray[np.float64] = self.end_s[np.isfinite(self.values)]
        return ends


@dataclass
class Verdict:
    """Verdict on a new recording.

    Attributes:
        copy_of: a stored recording that holds all of it. fuller_than: stored ones that it takes the place of.
        `beside`: stored ones of the same minutes that differ, or have what it lacks.
        locked: stored ones that it is fuller than, and that stay, for sessions of a locked visit use them.
    """

    copy_of: Recording | None = None
    fuller_than: list[Recording] = field(default_factory=list)
    beside: list[Recording] = field(default_factory=list)
    locked: list[Recording] = field(default_factory=list)

    @property
    def alone(self) -> bool:
        """True where it is fuller than one stored recording, and no other has any of its minutes."""
        return len(self.fuller_than) == 1 and not self.beside and not self.locked


def of_logs(traces: Sequence[TraceLog]) -> dict[Channel, Rows]:
    """Convert traces as they were decoded, on their own clock."""
    return _with_errors({(t.stream, t.channel): Rows(t.t_end_s, _with_gaps(t), t.dt_s, t.unit) for t in traces})


def _with_gaps(trace: TraceLog) -> NDArray[np.float64]:
    values: NDArray[np.float64] = trace.values.astype(np.float64)
    values[~trace.valid] = np.nan
    return values


def of_stored(traces: Sequence[Trace], ahead_s: float) -> dict[Channel, Rows]:
    """Convert stored traces to the clock of a recording that begins `ahead_s` after them."""
    return _with_errors(
        {
            (t.stream, t.channel): Rows(t.first_end_s - ahead_s + t.dt_s * np.arange(t.n, dtype=np.float64), unpack(t), t.dt_s, t.unit)
            for t in traces
        }
    )


def _with_errors(found: Mapping[Channel, Rows]) -> dict[Channel, Rows]:
    """Join the standard errors of beta to beta's rows, and return the other traces."""
    errors = {channel: rows.values for (stream, channel), rows in found.items() if stream == ERROR_STREAM}
    return {
        key: replace(rows, error=errors[key[1]]) if key[0] == BETA and key[1] in errors else rows
        for key, rows in found.items()
        if key[0] != ERROR_STREAM
    }


def relation(new: Mapping[Channel, Rows], old: Mapping[Channel, Rows]) -> Relation:
    """Determine the relation of one recording to another one of the same minutes, both on one clock."""
    shared = [key for key in new.keys() & old.keys() if key[0] in NEURAL]
    alike = [found for key in shared if (found := _alike(new[key], old[key])) is not None]
    if not all(alike):
        return Relation.DIFFERS
    if alike or not any(key[0] in NEURAL for key in (*old, *new)):
        if _holds(old, new):
            return Relation.NO_MORE
        return Relation.FULLER if _holds(new, old) else Relation.EACH_ITS_OWN
    if not any(key[0] in NEURAL for key in old) and _holds(new, old):
        return Relation.FULLER
    return Relation.EACH_ITS_OWN


def _alike(a: Rows, b: Rows) -> bool | None:
    """Decide whether two traces of a channel have the same signal; None where they share too few rows."""
    if a.unit != b.unit or abs(a.dt_s - b.dt_s) > EXACT_S or not a.end_s.size or not b.end_s.size:
        return None
    off = (a.end_s[0] - b.end_s[0]) / b.dt_s
    if abs(off - round(off)) * b.dt_s <= EXACT_S:
        rows = np.arange(a.end_s.size) + round(off)
        inside = (rows >= 0) & (rows < b.end_s.size)
        x, y = a.values[inside], b.values[rows[inside]]
        both = np.isfinite(x) & np.isfinite(y)
        return _equal(x[both], y[both], np.maximum(a.errors[inside], b.errors[rows[inside]])[both])
    place = np.searchsorted(b.end_s, a.end_s)
    inside = (place > 0) & (place < b.end_s.size)
    x, right = a.values[inside], place[inside]
    weight = (a.end_s[inside] - b.end_s[right - 1]) / b.dt_s
    y = (1 - weight) * b.values[right - 1] + weight * b.values[right]
    both = np.isfinite(x) & np.isfinite(y)
    if both.sum() < FEWEST_ROWS or np.ptp(x[both]) == 0 or np.ptp(y[both]) == 0:
        return None
    return float(np.corrcoef(x[both], y[both])[0, 1]) >= LIKE


def _equal(x: NDArray[np.float64], y: NDArray[np.float64], error: NDArray[np.float64]) -> bool | None:
    """Decide whether rows on one grid are those of one signal; None where they do not show it.

    Whole rows, for which nothing was predicted, are compared. Where they are too few, all rows are, to within a part of their standard
    errors.

    Args:
        x, y: values, [n].
        error: the larger standard error of either, 0 in whole rows, [n].
    """
    whole = error == 0
    tolerance = 1e-3 * np.abs(y)
    if whole.sum() >= FEWEST_ROWS:
        x, y, tolerance = x[whole], y[whole], tolerance[whole]
    else:
        tolerance = tolerance + WITHIN_ERRORS * error
        if x.size < FEWEST_ROWS or np.median(tolerance) > TELLING * np.std(y):
            return None
    return float(np.mean(np.abs(x - y) <= tolerance)) >= EQUAL_SHARE


def _holds(fuller: Mapping[Channel, Rows], less: Mapping[Channel, Rows]) -> bool:
    """Decide whether one recording has every channel of another, and a valid row in the place of each of its valid rows."""
    return all(key in fuller and _lacks(fuller[key], rows) <= max(1.0, LOST * rows.valid_end_s.size) for key, rows in less.items())


def _lacks(fuller: Rows, less: Rows) -> int:
    """Count the valid rows of a trace that have no valid row of another within one row of their own."""
    wanted, there = less.valid_end_s, fuller.valid_end_s
    if not there.size:
        return wanted.size
    right = np.clip(np.searchsorted(there, wanted), 1, max(1, there.size - 1))
    off = np.minimum(np.abs(wanted - there[right - 1]), np.abs(wanted - there[np.minimum(right, there.size - 1)]))
    return int(np.sum(off > max(fuller.dt_s, less.dt_s) + EXACT_S))


def judge(db: Session, like: Recording, traces: Sequence[TraceLog]) -> Verdict:
    """Compare a decoded recording with the stored ones of its device, side and minutes.

    Args:
        like: its row, which need not be stored yet: device, side, start and length. traces: as decoded.
    """
    found = Verdict()
    if like.started_at is None or not traces or not _of_a_session(like):
        return found
    mine = of_logs(traces)
    for old in repository.recordings_of_minutes(db, like):
        if not _of_a_session(old):
            continue
        assert old.started_at is not None
        ahead = (like.started_at - old.started_at).total_seconds()
        is_to = relation(mine, of_stored(study.traces_of_recording(db, old.id), ahead))
        if is_to is Relation.NO_MORE:
            return Verdict(copy_of=old)
        if is_to is not Relation.FULLER:
            found.beside.append(old)
        elif any(s.visit.locked for s in sessions_of(db, old)):
            found.locked.append(old)
        else:
            found.fuller_than.append(old)
    return found


def _of_a_session(recording: Recording) -> bool:
    """Decide whether a recording may be part of a session: surveys and a device's history share their minutes with others by nature."""
    return recording.details.get("run", 0) is not None


def sessions_of(db: Session, recording: Recording) -> list[StudySession]:
    """List the sessions with a part of a recording."""
    return [db.get_one(StudySession, number) for number in sorted(study.session_ids_of_recording(db, recording.id))]


def supersede(db: Session, old: Recording, new: Recording, alone: bool, by: str) -> list[int]:
    """Let the sessions of a recording use its fuller copy; which ones.

    Args:
        alone: the copy has no minutes of other stored recordings: a session of the whole recording is one of the whole copy then. Else
            each session keeps its minutes.
    """
    assert old.started_at is not None
    assert new.started_at is not None
    moved = []
    for session in sessions_of(db, old):
        _move(db, session, old, new, alone)
        moved.append(session.id)
        if session.status == "confirmed":
            conditions.renew(db, session, by, f"a fuller copy of recording {old.id} came: recording {new.id}")
        else:
            proposals.renew(db, session)
    old.superseded_by_id = new.id
    db.flush()
    return moved


def _move(db: Session, session: StudySession, old: Recording, new: Recording, alone: bool) -> None:
    assert old.started_at is not None
    assert new.started_at is not None
    period = session.visit.participant.current_settings.period_s
    ahead = (new.started_at - old.started_at).total_seconds()
    mine = [s for s in session.segments if s.recording_id == old.id]
    parts = []
    for segment in mine:
        whole = alone and segment.start_s <= period and segment.stop_s >= old.duration_s - period
        start = 0.0 if whole else min(max(0.0, round((segment.start_s - ahead) / period) * period), max(0.0, new.duration_s - 1e-3))
        stop = new.duration_s if whole else min(max(segment.stop_s - ahead, start + 1e-3), new.duration_s)
        parts.append((segment.is_control, start, stop))
        session.segments.remove(segment)
    db.flush()  # the parts that go are gone before the ones that come claim the same minutes
    for is_control, start, stop in parts:
        session.segments.append(SessionSegment(recording=new, start_s=start, stop_s=stop, is_control=is_control))
        if is_control:
            session.started_at, session.duration_s = new.started_at + timedelta(seconds=start), stop - start
    db.flush()
