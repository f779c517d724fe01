"""Open fists of a hand from a channel of its opening, as a camera's hand tracking gives it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.signal import find_peaks

from ml.formats.labs.content import Content, Floats
from ml.formats.recording import FileReport
from ml.formats.tables.grasps import GraspLog
from ml.qoc import PLAUSIBLE_INTERVAL_S

LEAST_FISTS = 5
PROMINENCE = 0.3
"""Least prominence of an open fist, as a share of the opening's range, 5th to 95th percentile."""


def open_fists(content: Content, report: FileReport) -> Iterator[GraspLog]:
    """Find open fists in the opening of each hand: the one run of at least five, between pauses of 3 s or more."""
    for channel in content.channels:
        if channel.name.kind != "opening" or not channel.timing.pieces:
            continue
        x = channel.read()
        runs: list[Floats] = []
        for piece in channel.timing.pieces:
            values = x[piece.begin : piece.end]
            if not np.all(np.isfinite(values)) or values.size < 3:
                continue
            low, high = np.percentile(values, (5, 95))
            apart = max(1, round(PLAUSIBLE_INTERVAL_S[0] * channel.timing.rate_hz))
            peaks, _ = find_peaks(values, prominence=PROMINENCE * (high - low), distance=apart)
            times = piece.start_s + peaks / channel.timing.rate_hz
            parts = np.split(times, np.flatnonzero(np.diff(times) > PLAUSIBLE_INTERVAL_S[1]) + 1)
            runs += [part for part in parts if part.size >= LEAST_FISTS]
        if len(runs) != 1:
            report.flagged.append(f"{channel.shown}: {len(runs)} runs of open fists, so that no grasp frequency was derived; one is needed")
            continue
        (times,) = runs
        shown = times - times[0]
        report.understood.append(f"{channel.shown}: {times.size} open fists")
        yield GraspLog(channel.name.side, shown, np.diff(shown) < PLAUSIBLE_INTERVAL_S[0])
