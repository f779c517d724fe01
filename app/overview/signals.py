"""The samples of a session on the screen: extremes at the resolution of the page, and the spectrogram, for any stretch of time."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.overview.samples import files_of, reading_limits, unread
from app.platform import files
from app.platform.errors import Conflict, Invalid, NotFound
from app.platform.jobs.children.limited import ChildEnded, run_limited
from app.settings import get_settings, private_folder
from app.study import blinding
from app.tables.sessions import StudySession
from ml.formats import DECODE_VERSION
from ml.sample_views import FIRST, Level, Spectrogram, fewer_columns, level_for

# A session's samples for the screen: made once by a child, kept in the data folder's cache, read a window at a time.

BUILD = "app.overview.samples_compute:build"
"""What the child runs."""
VERSION = 1
"""Raised when the child writes something else for the same samples."""
KEPT = 50
"""Sessions in the cache; the least recently seen ones go first, but none that was seen within `KEPT_S`."""
KEPT_S = 3600.0
MOST_COLUMNS = 400
HEADER = "channels.json"


@dataclass(frozen=True)
class SignalChannel:
    """One channel of a recording within a session.

    Attributes:
        number: its place in the session. recording: its number. hemisphere: `left`, `right` or None. channel, unit: as stored.
        rates_hz: rates that occur. samples: how many. begin_s, end_s: of the first and the last sample, from the session's start.
    """

    number: int
    recording: int
    hemisphere: str | None
    channel: str
    unit: str
    rates_hz: tuple[float, ...]
    samples: int
    begin_s: float
    end_s: float


@dataclass(frozen=True, eq=False)
class SignalWindow:
    """A channel between two times.

    Attributes:
        begin_s, end_s: of the window. resolution_s: width of a bin; 0 where every sample is given.
        t_s: middle of each bin, or time of each sample, [n]. low, high: extremes of a bin, NaN where it has no sample; equal for samples.
        power: the spectrogram of the window.
    """

    channel: SignalChannel
    begin_s: float
    end_s: float
    resolution_s: float
    t_s: NDArray[np.float64]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    power: Spectrogram


@dataclass(frozen=True)
class Signals:
    """Channels of a session, and the folder that holds their arrays."""

    folder: Path
    channels: tuple[SignalChannel, ...]
    headers: tuple[dict[str, Any], ...]

    def window(self, number: int, begin_s: float | None, end_s: float | None, points: int) -> SignalWindow:
        """Return a channel between two times, drawn in at least `points` bins, or sample by sample where there are not more than that many.

        Raises:
            NotFound: the session has no such channel. Invalid: the window is empty or outside the recording.
        """
        if not 0 <= number < len(self.channels):
            raise NotFound(f"The session has {len(self.channels)} channels of samples; there is no number {number}.", "Count from 0.")
        channel, header = self.channels[number], self.headers[number]
        begin = channel.begin_s if begin_s is None else max(begin_s, channel.begin_s)
        end = channel.end_s if end_s is None else min(end_s, channel.end_s)
        if not begin < end:
            raise Invalid(
                f"There are no samples between {begin_s:g} s and {end_s:g} s." if begin_s is not None and end_s is not None
                else "The window holds no samples.",
                f"The samples of {channel.channel} run from {channel.begin_s:.1f} s to {channel.end_s:.1f} s of the session.",
            )  # fmt: skip
        nothing = np.empty(0, np.float32)
        levels = [Level(channel.begin_s, w, nothing, nothing) for w in header["widths_s"]]
        level = level_for(levels, begin, end, points)
        t_s, low, high = self._samples(number, begin, end) if level is None else self._bins(number, levels[level], level, begin, end)
        density = np.load(self.folder / f"{number}-density.npy", mmap_mode="r")
        stored = Spectrogram(channel.begin_s, header["column_s"], np.array(header["hz"]), density)
        power = fewer_columns(stored, begin, end, MOST_COLUMNS)
        return SignalWindow(channel, begin, end, 0.0 if level is None else levels[level].width_s, t_s, low, high, power)

    def _samples(self, number: int, begin: float, end: float) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
        """Return every sample; missing samples become an empty one, so that no line bridges them."""
        t_s = np.load(self.folder / f"{number}-t.npy", mmap_mode="r")
        values = np.load(self.folder / f"{number}-v.npy", mmap_mode="r")
        inside = np.flatnonzero((t_s >= begin) & (t_s <= end))
        t, v = np.asarray(t_s[inside], np.float64), np.asarray(values[inside], np.float32)
        order = np.argsort(t, kind="stable")
        t, v = t[order], v[order]
        gaps = np.flatnonzero(np.diff(t) > 1.5 / min(self.channels[number].rates_hz)) + 1
        t, v = np.insert(t, gaps, t[gaps - 1] + 1e-6), np.insert(v, gaps, np.nan)
        return t, v, v

    def _bins(
        self, number: int, level: Level, k: int, begin: float, end: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
        stored = np.load(self.folder / f"{number}-{k}.npy", mmap_mode="r")
        first = max(0, int(np.floor((begin - level.first_s) / level.width_s)))
        last = min(stored.shape[1], int(np.ceil((end - level.first_s) / level.width_s)))
        t_s = level.first_s + level.width_s * (np.arange(first, last) + 0.5)
        return t_s, np.asarray(stored[0, first:last]), np.asarray(stored[1, first:last])


def signals_of(db: Session, session: StudySession, caller: Caller) -> Signals:
    """Return the channels of a session; the first call reads its files.

    Raises:
        Forbidden: the caller may not know yet what ran. Conflict: a stored file is missing, or no recording of the session has
            samples. Invalid: reading takes more memory or time than a file may.
    """
    blinding.require_known(session.visit, caller)
    wanted = files_of(db, session)
    folder = _folder(session, wanted)
    if not (folder / HEADER).exists():
        _build(session, wanted, folder)
    os.utime(folder)
    headers = tuple(json.loads((folder / HEADER).read_text())["channels"])
    if not headers:
        raise Conflict(
            f"The recordings of session {session.id} have no samples.",
            "Tables of steps and powers that the device computed have traces alone.",
        )
    channels = tuple(
        SignalChannel(
            number, h["recording"], h["hemisphere"], h["channel"], h["unit"], tuple(h["rates_hz"]), h["samples"], h["begin_s"], h["end_s"]
        )
        for number, h in enumerate(headers)
    )
    return Signals(folder, channels, headers)


def _folder(session: StudySession, wanted: Sequence[dict[str, Any]]) -> Path:
    """Name the folder by all that determines its content: the files, what of them is the session's, and the programs that read them."""
    pins = json.dumps([session.id, wanted, DECODE_VERSION, VERSION, FIRST], sort_keys=True)
    return _cache() / hashlib.sha256(pins.encode()).hexdigest()


def _cache() -> Path:
    return private_folder(private_folder(get_settings().data_dir / "cache") / "signals")


def _build(session: StudySession, wanted: Sequence[dict[str, Any]], folder: Path) -> None:
    with files.draft_folder() as draft:
        target = private_folder(draft / "signals")
        try:
            run_limited(BUILD, {"files": wanted, "target": str(target)}, reading_limits(), who=f"samples of {session.visit.participant_id}")
        except ChildEnded as ended:
            raise unread(session, ended) from None
        _forget_old()
        try:
            target.rename(folder)
        except OSError as error:
            # two requests at once write the same; the second keeps the first one's
            if not (folder / HEADER).exists():
                raise Conflict("The samples could not be kept.", "Ask the administrator whether the data folder is full.") from error


def _forget_old() -> None:
    """Keep the cache to `KEPT` sessions."""
    seen = sorted(((f.stat().st_mtime, f) for f in _cache().iterdir()), reverse=True)
    for when, folder in seen[KEPT - 1 :]:
        if when < time.time() - KEPT_S:
            shutil.rmtree(folder)
