"""Minutes of tremor as rows, and the minutes of one session out of the files of several watches and exports. No SQL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from app.platform.numbers import counted
from app.tables.outcomes import TremorSeries
from ml.qoc import SAME_TIME_S, TREMOR_CLASSES


@dataclass(frozen=True, eq=False)
class Minutes:
    """Minutes of tremor.

    Attributes:
        start_unix_s, duration_s: begin and length of each minute's measurement, s, shape [n].
        fractions: share per class in the order of `ml.qoc.TREMOR_CLASSES`, shape [n, 6]; NaN where the export does not split the tremor.
        any_tremor: share with slight or worse tremor, shape [n]; NaN where not known.
    """

    start_unix_s: NDArray[np.float64]
    duration_s: NDArray[np.float64]
    fractions: NDArray[np.float64]
    any_tremor: NDArray[np.float64]

    @property
    def stop_unix_s(self) -> NDArray[np.float64]:
        """End of each minute, shape [n]."""
        return self.start_unix_s + self.duration_s

    def at(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Minutes:
        """Select the chosen minutes."""
        return Minutes(self.start_unix_s[chosen], self.duration_s[chosen], self.fractions[chosen], self.any_tremor[chosen])

    def equal(self, i: int, other: Minutes, j: int) -> bool:
        """Compare two minutes, to the precision that is stored."""
        return bool(self.at(np.array([i])).equals(other.at(np.array([j])))[0])

    def equals(self, other: Minutes) -> NDArray[np.bool_]:
        """Compare each of these minutes with the other's, to the precision that is stored, shape [n]."""
        fractions = np.isclose(self.fractions, other.fractions, atol=1e-6, equal_nan=True).all(axis=1)
        return np.asarray(fractions & np.isclose(self.any_tremor, other.any_tremor, atol=1e-6, equal_nan=True))


@dataclass(frozen=True, eq=False)
class SessionMinutes:
    """The minutes that count for a session, in time order, none of them twice.

    Attributes:
        minutes: shape [n]; they may reach over the session's ends.
        upload_file_ids: the file of each, [n].
        notes: sentences on minutes that were given twice or contradict each other.
    """

    minutes: Minutes
    upload_file_ids: list[int]
    notes: list[str] = field(default_factory=list)


def pack(row: TremorSeries, minutes: Minutes) -> None:
    """Write minutes into a row."""
    row.n = minutes.start_unix_s.size
    row.start_unix_s_f64 = minutes.start_unix_s.astype("<f8").tobytes()
    row.duration_s_f64 = minutes.duration_s.astype("<f8").tobytes()
    row.fractions_f32 = minutes.fractions.astype("<f4").tobytes()
    row.any_tremor_f32 = minutes.any_tremor.astype("<f4").tobytes()
    row.first_start_at = datetime.fromtimestamp(float(minutes.start_unix_s.min()), UTC)
    row.last_end_at = datetime.fromtimestamp(float(minutes.stop_unix_s.max()), UTC)


def same_values(one: TremorSeries, other: TremorSeries) -> bool:
    """Check whether two rows contain the same minutes, to the last bit."""
    arrays = ("n", "start_unix_s_f64", "duration_s_f64", "fractions_f32", "any_tremor_f32")
    return all(getattr(one, name) == getattr(other, name) for name in arrays)


def unpack(row: TremorSeries) -> Minutes:
    """Unpack the minutes of a row."""
    return Minutes(
        np.frombuffer(row.start_unix_s_f64, "<f8").astype(np.float64),
        np.frombuffer(row.duration_s_f64, "<f8").astype(np.float64),
        np.frombuffer(row.fractions_f32, "<f4").astype(np.float64).reshape(-1, len(TREMOR_CLASSES)),
        np.frombuffer(row.any_tremor_f32, "<f4").astype(np.float64),
    )


def within(series: Sequence[TremorSeries], start_unix_s: float, stop_unix_s: float, names: Mapping[int, str]) -> SessionMinutes:
    """Collect the minutes of a stretch of time from all files; `names` has the name that a person gave each file, by its number.

    Of minutes in two files, the newer file's count (a later export holds what the watch computed meanwhile). Minutes of one file
    that claim the same time and say different things are all excluded: which one is right cannot be known.
    """
    kept: list[tuple[float, int, Minutes, int]] = []
    notes: list[str] = []
    for row in sorted(series, key=lambda r: r.upload_file_id, reverse=True):
        minutes = unpack(row)
        near = np.flatnonzero((minutes.stop_unix_s > start_unix_s) & (minutes.start_unix_s < stop_unix_s))
        minutes = minutes.at(near[np.argsort(minutes.start_unix_s[near], kind="stable")])
        single, contested = _told_once(minutes)
        if contested:
            notes.append(
                f"{counted(contested, 'minute')} of {names[row.upload_file_id]} left out: the same time is told twice, in different ways. "
                "A spreadsheet may have rounded their times"
            )
        differing: dict[int, int] = {}
        for i in single:
            rival = next((k for k in kept if _overlap_s(minutes, i, k[2], k[3]) > SAME_TIME_S), None)
            if rival is None:
                continue
            if not minutes.equal(i, rival[2], rival[3]):
                differing[rival[1]] = differing.get(rival[1], 0) + 1
        free = [i for i in single if all(_overlap_s(minutes, i, k[2], k[3]) <= SAME_TIME_S for k in kept)]
        kept += [(float(minutes.start_unix_s[i]), row.upload_file_id, minutes, i) for i in free]
        notes += [
            f"{counted(count, 'minute')} of {names[row.upload_file_id]} told otherwise by the newer {names[newer]}, which counts"
            for newer, count in differing.items()
        ]
    kept.sort(key=lambda k: k[0])
    return SessionMinutes(_joined([m.at(np.array([i])) for _, _, m, i in kept]), [file for _, file, _, _ in kept], notes)


def compare(minutes: Minutes, others: Sequence[TremorSeries]) -> tuple[int, int]:
    """Count the minutes of a file that begin with a minute of other files and agree, and those that differ."""
    same = different = 0
    begins, unseen = np.rint(minutes.start_unix_s), np.ones(minutes.start_unix_s.size, dtype=np.bool_)
    for row in reversed(others):  # one at a time, for each may be a year; of several files the last one counts
        other = unpack(row)
        known = np.rint(other.start_unix_s)
        at = np.searchsorted(known, begins, side="right") - 1
        found = np.flatnonzero(unseen & (at >= 0))
        found = found[known[at[found]] == begins[found]]
        equal = minutes.at(found).equals(other.at(at[found]))
        same, different = same + int(equal.sum()), different + int((~equal).sum())
        unseen[found] = False
    return same, different


def _told_once(minutes: Minutes) -> tuple[list[int], int]:
    """Find minutes of one file (in time order) that overlap no other, and count those that contradict another one."""
    single: list[int] = []
    contested: set[int] = set()
    for i in range(minutes.start_unix_s.size):
        rivals = [j for j in range(i) if _overlap_s(minutes, i, minutes, j) > SAME_TIME_S]
        if rivals and all(minutes.equal(i, minutes, j) and abs(minutes.start_unix_s[i] - minutes.start_unix_s[j]) < 0.5 for j in rivals):
            continue
        single.append(i)
        contested.update([i, *rivals] if rivals else [])
    return [i for i in single if i not in contested], len(contested)


def _overlap_s(a: Minutes, i: int, b: Minutes, j: int) -> float:
    return float(min(a.stop_unix_s[i], b.stop_unix_s[j]) - max(a.start_unix_s[i], b.start_unix_s[j]))


def _joined(parts: Sequence[Minutes]) -> Minutes:
    if not parts:
        return Minutes(np.empty(0), np.empty(0), np.empty((0, len(TREMOR_CLASSES))), np.empty(0))
    return Minutes(
        np.concatenate([p.start_unix_s for p in parts]),
        np.concatenate([p.duration_s for p in parts]),
        np.concatenate([p.fractions for p in parts]),
        np.concatenate([p.any_tremor for p in parts]),
    )
