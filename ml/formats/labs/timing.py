"""Gap-free stretches of a stream by the time stamps of its samples.

A library that spreads a gap over all stamps moves every sample (`docs/ingest/recordings.md`). Here a gap of 1.5 sample periods or more ends
a stretch, and one rate is fitted to all stretches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

GAP = 1.5
"""Samples further apart than so many periods have a gap between them."""
BACK_S = 0.5
"""Stamps that step back by more are of a clock that was set; less is jitter."""
WINDOW_S = 2.0
"""Where stamps jitter by more than a sample, a gap shows in the mean of so much time before and after it."""
LEAST_SHIFT = 0.75
SURE = 6.0
"""A hidden gap is a shift of at least 0.75 periods and 6 standard errors."""
PASSES = 60


@dataclass(frozen=True, slots=True)
class Piece:
    """Samples `begin` up to `end` of a stream, without a gap; `start_s` is the time of the first."""

    begin: int
    end: int
    start_s: float


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of a regular stream.

    Attributes:
        rate_hz: fitted to all pieces. pieces: in order of time, not overlapping.
        jitter_s: largest distance of a stamp from its piece's line.
        gaps, lost: number of gaps, and of samples that they lack.
        unseen_s: gaps shorter than this cannot be seen for jitter; 0 where stamps are even.
        backward: times by which the clock stepped back, s. dropped: samples whose times were there before.
    """

    rate_hz: float
    pieces: tuple[Piece, ...]
    jitter_s: float
    gaps: int
    lost: int
    unseen_s: float
    backward: tuple[float, ...]
    dropped: int

    @property
    def span_s(self) -> tuple[float, float]:
        """Time of the first sample, and the end of the last one's period."""
        last = self.pieces[-1]
        return self.pieces[0].start_s, last.start_s + (last.end - last.begin) / self.rate_hz

    def sentences(self, name: str) -> list[str]:
        """Describe what is missing, for the report."""
        said = []
        if self.gaps:
            share = 100 * self.lost / max(1, self.lost + sum(p.end - p.begin for p in self.pieces))
            said.append(f"{name}: {self.gaps} gap{'s' if self.gaps > 1 else ''}, {self.lost} samples ({share:.1f} %) are missing")
        if self.unseen_s:
            said.append(
                f"{name}: its times jitter by up to {1000 * self.jitter_s:.3g} ms, so losses under {1000 * self.unseen_s:.3g} ms are unseen"
            )
        for step in self.backward:
            said.append(f"{name}: its clock steps back by {step:.3g} s")
        if self.dropped:
            said.append(f"{name}: {self.dropped} samples have times that were there before and were excluded")
        return said


def even(count: int, rate_hz: float, start_s: float = 0.0) -> Timing:
    """Make the times of a stream without gaps."""
    return Timing(rate_hz, (Piece(0, count, start_s),) if count else (), 0.0, 0, 0, 0.0, (), 0)


def of_pieces(pieces: list[Piece], rate_hz: float) -> Timing:
    """Make the times of a stream whose gap-free pieces are known. Pieces that begin before an earlier one ended are excluded."""
    kept: list[Piece] = []
    backward: list[float] = []
    dropped = gaps = lost = 0
    for piece in pieces:
        if not kept:
            kept.append(piece)
            continue
        last = kept[-1]
        end = last.start_s + (last.end - last.begin) / rate_hz
        ahead = (piece.start_s - end) * rate_hz
        if ahead < -0.5:
            skip = min(piece.end - piece.begin, int(np.ceil(-ahead)))
            backward.append(-ahead / rate_hz)
            dropped += skip
            piece = Piece(piece.begin + skip, piece.end, piece.start_s + skip / rate_hz)
            if piece.begin == piece.end:
                continue
        elif ahead < GAP - 1:
            kept[-1] = Piece(last.begin, piece.end, last.start_s)
            continue
        else:
            gaps += 1
            lost += round(ahead)
        kept.append(piece)
    return Timing(rate_hz, tuple(kept), 0.0, gaps, lost, 0.0, tuple(backward), dropped)


def of_stamps(t_s: Floats, nominal_hz: float) -> Timing:
    """Find the gap-free pieces of a stream.

    Args:
        t_s: stamp of each sample, s, [n], in the order of the file.
        nominal_hz: rate that the stream states.

    Raises:
        ValueError: fewer than two samples, or stamps that are no numbers.
    """
    if t_s.size < 2 or not np.all(np.isfinite(t_s)):
        raise ValueError("a regular stream needs two samples with times")
    steps = np.diff(t_s)
    cuts = np.flatnonzero(steps < -BACK_S) + 1
    period = _period(t_s, nominal_hz, np.split(np.arange(t_s.size), cuts))
    spread = np.abs(steps - period)
    jitters = spread[(spread > 1e-3 * period) & (spread < 0.5 * WINDOW_S)]
    usual = float(np.quantile(jitters, 0.98)) if jitters.size > 50 else 0.0
    precise = usual < 0.5 * period
    # what is far beyond the jitter is a gap at that very place
    cuts = np.union1d(cuts, np.flatnonzero(steps - period > max(3 * usual, period)) + 1)
    parts = np.split(np.arange(t_s.size), cuts)
    unseen = 0.0
    edges = [0]
    for part in parts:
        begin, end = int(part[0]), int(part[-1]) + 1
        own = t_s[begin:end]
        if precise:
            moves = np.diff(own)
            found = (np.flatnonzero((moves > GAP * period) | (moves < -0.5 * period)) + 1).tolist()
        else:
            found, blind = _find_hidden(own, period)
            unseen = max(unseen, blind)
        edges += [*(begin + i for i in found), end]
    spans = [(a, b) for a, b in pairwise(edges) if b > a]
    step = _slope(t_s, spans) or period
    rate = 1.0 / step
    pieces = []
    jitter = 0.0
    for a, b in spans:
        own = t_s[a:b] - step * np.arange(b - a)
        start = float(own.mean())
        jitter = max(jitter, float(np.max(np.abs(own - start))))
        pieces.append(Piece(a, b, start))
    joined = of_pieces(pieces, rate)
    return Timing(rate, joined.pieces, jitter, joined.gaps, joined.lost, unseen, joined.backward, joined.dropped)


def only(timing: Timing, good: NDArray[np.bool_]) -> Timing:
    """Take lost samples out of a stream; `good` [n] marks those that are there."""
    pieces = []
    for p in timing.pieces:
        edges = np.flatnonzero(np.diff(np.concatenate(([0], good[p.begin : p.end].astype(np.int8), [0]))))
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            pieces.append(Piece(p.begin + begin, p.begin + end, p.start_s + begin / timing.rate_hz))
    cut = of_pieces(pieces, timing.rate_hz)
    return replace(timing, pieces=cut.pieces, gaps=cut.gaps, lost=cut.lost)


def _period(t_s: Floats, nominal_hz: float, parts: list[NDArray[np.int64]]) -> float:
    """Estimate the sampling period: the median over blocks, in most of which nothing is lost."""
    found = []
    for part in parts:
        own = t_s[part[0] : part[-1] + 1]
        block = min(own.size - 1, max(10, min(500, own.size // 20)))
        if block > 0:
            found.append((own[block:] - own[:-block])[:: max(1, block // 4)] / block)
    blocks = np.concatenate(found) if found else np.empty(0)
    estimate = float(np.median(blocks)) if blocks.size else 0.0
    return estimate if estimate > 0 else 1.0 / nominal_hz


def _slope(t_s: Floats, spans: list[tuple[int, int]]) -> float:
    """Fit one period to all pieces by least squares, each with its own start; 0 where no piece has two samples."""
    above = below = 0.0
    for a, b in spans:
        i = np.arange(b - a) - (b - a - 1) / 2.0
        above += float(i @ (t_s[a:b] - t_s[a]))
        below += float(i @ i)
    return above / below if below else 0.0


def _find_hidden(t_s: Floats, period: float) -> tuple[list[int], float]:
    """Find gaps among stamps that jitter by more than half a sample.

    Jitter comes and goes, and a loss stays: it shifts all later stamps against an even clock. So the means of the stamps' residuals before
    and after each sample are compared. The largest shift is taken out before the next is searched.

    Returns:
        Indices of the first sample after each gap, and the shortest gap that can be seen, s.
    """
    n = t_s.size
    window = max(5, min(round(WINDOW_S / period), n // 4))
    residual = t_s - period * np.arange(n)
    steps = np.diff(t_s)
    at = np.arange(1, n)
    width = np.minimum(window, np.minimum(at, n - at))
    usable = width >= min(5, window)
    found: list[int] = []
    error = 0.0
    for _ in range(PASSES):
        total = np.concatenate(([0.0], np.cumsum(residual - residual[0])))
        shift = (total[at + width] - total[at]) / width - (total[at] - total[at - width]) / width
        drift = float(np.median(shift[width == window])) / window if np.any(width == window) else 0.0
        shift -= drift * width
        error = 1.4826 * float(np.median(np.abs(shift[usable])))
        needed = np.maximum(LEAST_SHIFT * period, SURE * error * np.sqrt(window / width))
        above = np.flatnonzero(usable & (shift >= needed) & (steps > 1.25 * period))
        if not above.size:
            break
        accepted = []
        while above.size:
            best = int(above[np.argmax(shift[above])])
            near = above[(np.abs(above - best) <= window // 2) & (shift[above] >= 0.9 * shift[best])]
            best = int(near[np.argmax(steps[near])])
            accepted.append(best)
            above = above[np.abs(above - best) > 2 * window]
        for i in sorted(accepted):
            residual[i + 1 :] -= shift[i]
            found.append(i + 1)
    return sorted(set(found)), max(LEAST_SHIFT * period, SURE * error)
