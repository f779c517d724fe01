"""The PC's clock against the implant's ticks: its offset, its drift, and the moments when one of the two was set.

PacketGenTime is the PC's estimate of when a packet was made. It wanders by some 30 ms about a straight line over the ticks (format notes,
A.2), and jumps where the PC's clock is set. Line and jumps are fitted here by medians; what is left of each packet are the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STEP_MS = 500.0
"""A clock that is off by more than this from then on was set; less than that is what PacketGenTime wanders."""

SECONDS_STEP_MS = 1_500.0
"""The same for the implant's `timestamp`, which counts whole seconds."""

LARGEST_DRIFT = 3e-4
"""Over a long pause clocks may part by so much of it without having been set; in a short recording a larger drift is wander."""

SURE_DRIFT_MS = 600_000.0
"""Over more time than this any drift is believed."""

DRIFT_SPAN_MS = 30_000.0
"""Over less time than this the wander of PacketGenTime says nothing about drift."""

BIN_MS = 1_000.0
BINS_AROUND = 5
LEAST_PACKETS = 5
"""A step is judged by medians of up to so many seconds on either side, with at least so many packets on each."""


STEP_MARGIN_MS = 500.0
"""Records so close to a time that was shown twice may be of either."""

WANDER_MS = 100.0
"""PacketGenTime wanders by less than this about the PC's clock."""


@dataclass(frozen=True, slots=True)
class Levels:
    """A quantity that is constant between steps.

    Attributes:
        at_ms: device time of the steps, [k].
        bounds: places, in device order, where the pieces between steps begin, and the end, [k + 2].
    """

    at_ms: NDArray[np.float64]
    bounds: NDArray[np.int64]

    def pieces(self) -> list[slice]:
        """Slice the packets, in the device order, into those between steps."""
        return [slice(a, b) for a, b in zip(self.bounds[:-1].tolist(), self.bounds[1:].tolist(), strict=True)]


@dataclass(frozen=True, slots=True)
class PcClock:
    """The PC's clock as a function of device time, and its inverse on the recording's timeline.

    The timeline runs with the implant's ticks and shows the PC's time at the beginning of the recording. Of several pieces between steps of
    the PC's clock, the one with the most packets counts.

    Attributes:
        slope: gain of the PC's clock on the implant's, relative.
        drift: how fast the implant's clock runs against the PC's, relative; None where the recording is too short to estimate it.
        steps_at_ms: device times of the first packets after the PC's clock was set, [k].
        before_ms: device times of the last packets before it was, [k]; the step is anywhere between the two.
        offsets_ms: PC time minus device time at device time 0, [k + 1].
        shift_ms: timeline minus device time.
    """

    slope: float
    drift: float | None
    steps_at_ms: NDArray[np.float64]
    before_ms: NDArray[np.float64]
    offsets_ms: NDArray[np.float64]
    shift_ms: float

    def pc_ms(self, device_ms: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute what the PC's clock shows, [n]."""
        piece = np.searchsorted(self.steps_at_ms, device_ms, side="right")
        return np.asarray(device_ms * (1.0 + self.slope) + self.offsets_ms[piece])

    def timeline_ms(self, device_ms: NDArray[np.float64]) -> NDArray[np.float64]:
        """Place on the timeline, [n]."""
        return np.asarray(device_ms + self.shift_ms)

    def of_pc_ms(self, pc_ms: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute when on the timeline the PC's clock showed this, [n].

        A time that a step forwards skipped is that of the step; of a time that may have been shown twice the first counts.
        """
        ends = self.pc_ms(np.nextafter(self.steps_at_ms, -np.inf))
        piece = np.searchsorted(np.maximum.accumulate(ends), pc_ms, side="right")
        device = (pc_ms - self.offsets_ms[piece]) / (1.0 + self.slope)
        begins = np.concatenate(([-np.inf], self.before_ms))[piece]
        return self.timeline_ms(np.maximum(device, begins))

    def doubtful_ms(self, records_ms: Sequence[float]) -> list[tuple[float, float]]:
        """Find when on the timeline it is unknown which records were in force: the time of one may have been shown twice.

        After a step backwards the order of records is unknown, to the end. A step forwards among lost packets leaves their order. A
        record within them may then be earlier than the step or later.

        Args:
            records_ms: PC times of the records.

        Returns:
            Spans (begin, end) on the timeline, ms.
        """
        spans = []
        for i, by_ms in enumerate(self.steps_ms.tolist()):
            before_ms, at_ms = float(self.before_ms[i]), float(self.steps_at_ms[i])
            first_ms, last_ms = (ms * (1.0 + self.slope) + float(self.offsets_ms[i]) for ms in (before_ms, at_ms))
            margin_ms = STEP_MARGIN_MS if by_ms < 0 else WANDER_MS
            if any(first_ms + by_ms - margin_ms <= record <= last_ms + margin_ms for record in records_ms):
                begin_ms = before_ms + min(by_ms, 0.0) - margin_ms
                end_ms = np.inf if by_ms < 0 else at_ms + margin_ms
                spans.append((begin_ms + self.shift_ms, end_ms + self.shift_ms))
        return spans

    @property
    def steps_ms(self) -> NDArray[np.float64]:
        """Size of the change of the PC's clock at each step, [k]."""
        return np.diff(self.offsets_ms)


def levels(at_ms: NDArray[np.float64], value_ms: NDArray[np.float64], step_ms: float) -> Levels:
    """Find where a quantity, [n] in rising order of `at_ms` [n], steps by more than `step_ms` and stays there."""
    bins, centre = _bins(at_ms, value_ms)
    before, after = _medians_around(centre)
    pause = np.diff(at_ms[bins[:-1]], prepend=at_ms[0]) if at_ms.size else np.empty(0)
    jump = np.abs(after - before) - step_ms - LARGEST_DRIFT * pause
    cuts: list[int] = []
    run: list[int] = []
    for b in [*np.flatnonzero(jump > 0).tolist(), -1]:
        if run and b != run[-1] + 1:
            steepest = max(run, key=lambda i: abs(float(centre[i] - centre[i - 1])))
            cuts.append(_split(value_ms, bins, steepest, float(before[steepest]), float(after[steepest])))
            run = []
        run.append(b)
    bounds = [0]
    for cut in cuts:
        if cut - bounds[-1] >= LEAST_PACKETS and at_ms.size - cut >= LEAST_PACKETS:
            bounds.append(cut)
    return Levels(at_ms[bounds[1:]], np.array([*bounds, at_ms.size], dtype=np.int64))


def _bins(at_ms: NDArray[np.float64], value_ms: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the beginning of every second with packets, and the end, [m + 1]; the median of each, [m]."""
    if at_ms.size == 0:
        return np.zeros(1, dtype=np.int64), np.empty(0)
    second = np.floor(at_ms / BIN_MS)
    begins = np.flatnonzero(np.diff(second, prepend=second[0] - 1))
    ordered = value_ms[np.lexsort((value_ms, second))]
    bins = np.append(begins, at_ms.size)
    return bins, ordered[begins + (np.diff(bins) - 1) // 2]


def _medians_around(centre: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the median of the seconds before each and of those from it on, [m] each; the first has none before it and steps nowhere."""
    padded = np.concatenate((np.full(BINS_AROUND, np.nan), centre, np.full(BINS_AROUND, np.nan)))
    if centre.size == 0:
        return centre, centre
    windows = np.lib.stride_tricks.sliding_window_view(padded, BINS_AROUND)
    before, after = windows[: centre.size].copy(), windows[BINS_AROUND : BINS_AROUND + centre.size]
    before[0] = after[0]
    return np.nanmedian(before, axis=1), np.nanmedian(after, axis=1)


def _split(value_ms: NDArray[np.float64], bins: NDArray[np.int64], b: int, before: float, after: float) -> int:
    """Find the packet at which the value goes over from one level to the other, near the beginning of second b."""
    low, high = int(bins[max(0, b - 2)]), int(bins[min(bins.size - 1, b + 2)])
    near = value_ms[low:high]
    cost = np.concatenate(([0.0], np.cumsum(np.abs(near - before)))) + np.concatenate((np.cumsum(np.abs(near - after)[::-1])[::-1], [0.0]))
    return low + int(np.argmin(cost))


def fit_clock(device_ms: NDArray[np.float64], pc_ms: NDArray[np.float64]) -> PcClock:
    """Fit the PC's clock to packets whose PC time is known, both [n] in any order; PC and device time are the same where none is."""
    known = np.flatnonzero(np.isfinite(pc_ms))
    known = known[np.argsort(device_ms[known], kind="stable")]
    if known.size == 0:
        first = float(device_ms.min(initial=np.inf))
        return PcClock(0.0, None, np.empty(0), np.empty(0), np.zeros(1), -first if np.isfinite(first) else 0.0)
    at, ahead = device_ms[known], pc_ms[known] - device_ms[known]
    pieces = levels(at, ahead, STEP_MS).pieces()
    gain = _gain(at, ahead, pieces)
    slope = gain or 0.0
    pieces = _with_ends(ahead - slope * at, pieces)
    starts = [piece.start for piece in pieces[1:]]
    offsets = np.array([float(np.median(ahead[piece] - slope * at[piece])) for piece in pieces])
    longest = max(range(len(pieces)), key=lambda i: pieces[i].stop - pieces[i].start)
    shift = float(offsets[longest] + slope * device_ms.min())
    drift = None if gain is None else 1.0 / (1.0 + gain) - 1.0
    return PcClock(slope, drift, at[starts], at[[start - 1 for start in starts]], offsets, shift)


def _with_ends(level_ms: NDArray[np.float64], pieces: list[slice]) -> list[slice]:
    """Cut off the first or last few packets where each is on another level than its piece.

    They are too few for a piece, but agree with each other. The clock was set right after the first, or right before the last.
    """
    first, last = (float(np.median(level_ms[piece])) for piece in (pieces[0], pieces[-1]))
    begin, end = _agreeing(level_ms[:LEAST_PACKETS], first), _agreeing(level_ms[::-1][:LEAST_PACKETS], last)
    out = list(pieces)
    if 0 < begin < out[0].stop - LEAST_PACKETS:
        out[:1] = [slice(0, begin), slice(begin, out[0].stop)]
    if 0 < end < out[-1].stop - out[-1].start - LEAST_PACKETS:
        cut = out[-1].stop - end
        out[-1:] = [slice(out[-1].start, cut), slice(cut, out[-1].stop)]
    return out


def _agreeing(level_ms: NDArray[np.float64], usual_ms: float) -> int:
    """Count the first packets that are off the usual level by more than a step, and agree with the first."""
    off = (np.abs(level_ms - usual_ms) > STEP_MS) & (np.abs(level_ms - level_ms[0]) < WANDER_MS)
    return int(np.argmin(off)) if not off.all() else 0


def _gain(at_ms: NDArray[np.float64], ahead_ms: NDArray[np.float64], pieces: list[slice]) -> float | None:
    """Compute the median slope between seconds half a piece apart (the line of Theil and Sen on few pairs). None where no piece is long
    enough."""
    slopes: list[NDArray[np.float64]] = []
    for piece in pieces:
        at, ahead = at_ms[piece], ahead_ms[piece]
        if at.size < 2 or at[-1] - at[0] < DRIFT_SPAN_MS:
            continue
        bins, centre = _bins(at, ahead)
        middle, half = at[(bins[:-1] + bins[1:] - 1) // 2], (bins.size - 1) // 2
        apart, rise = middle[half:] - middle[:-half], centre[half:] - centre[:-half]
        far = apart > DRIFT_SPAN_MS / 2
        slopes.append(rise[far] / apart[far])
    pooled = np.concatenate(slopes) if slopes else np.empty(0)
    if not pooled.size:
        return None
    gain = float(np.median(pooled))
    return gain if at_ms[-1] - at_ms[0] > SURE_DRIFT_MS else min(max(gain, -LARGEST_DRIFT), LARGEST_DRIFT)
