"""Times of RC+S packets: one timeline for all streams of a recording. Source: the format notes, A.2 and A.9.

The timeline runs with the implant's ticks (`packets/ticks.py`). PacketGenTime gives its place on the PC's clock, the drift between both,
and where a clock was set (`packets/clock.py`). It moves no packet against another. Samples are equidistant as far as no signal is missing.

Differences from the public toolbox, which places every stretch without loss by its own PacketGenTimes, are in `docs/ingest/formats.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ml.formats.rcs.packets.clock import SECONDS_STEP_MS, PcClock, fit_clock, levels
from ml.formats.rcs.packets.headers import PacketHeaders
from ml.formats.rcs.packets.loss import Gaps, find_gaps
from ml.formats.rcs.packets.ticks import between_streams, device_ms
from ml.formats.rejection import Rejected

LATE_MS = 500.0
"""A packet is late when it arrives by so much more after it was measured than is usual in its stream."""

SAME_TICK = 0.1
"""Two packets of signal that lie closer together than this share of their length have one tick between them."""

MOST_MOVED = 8
ASTRAY_MS = 1_000.0
JOINS = 0.1
"""A packet joins the one before where the ticks between them are its length but for this share."""

OFF_LATTICE_MS = 20.0
"""Equidistant samples that stray further than this from the ticks begin a new stretch."""

Same = Callable[[int, int], bool]
"""Whether two packets of a stream, by their places in the file, hold the same samples."""


@dataclass(frozen=True, slots=True)
class PacketTimes:
    """Reconstructed times of one stream.

    Attributes:
        last_ms: time of each packet's last sample on the timeline, ms, [n]; NaN where rejected.
        chunk: number of the gap-free chunk, [n]; -1 where rejected.
        device_clock: True when no packet had a usable PacketGenTime and arrival times placed the recording.
        missing: packets lost between the first and the last one, pauses included.
        gaps: where signal is missing.
        received_ms: how much signal was received.
        rejected: how many packets were rejected, by reason.
        reordered: how many packets stood after a later one in the file.
        late: how many arrived late.
        moved: how many carried the tick of the packet after them.
        residual_ms: PacketGenTime (or the time of arrival where none is known) minus the fitted PC clock, [n]; NaN where unknown.
    """

    last_ms: NDArray[np.float64]
    chunk: NDArray[np.int64]
    device_clock: bool
    missing: int
    gaps: Gaps = field(default_factory=Gaps)
    received_ms: float = 0.0
    rejected: dict[Rejected, int] = field(default_factory=dict)
    reordered: int = 0
    late: int = 0
    moved: int = 0
    residual_ms: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return int(self.chunk.max(initial=-1)) + 1

    @property
    def loss(self) -> float:
        """Share of the signal that is missing between the first and the last sample, 0..1."""
        missing = float(self.gaps.missing_ms.sum())
        return missing / (self.received_ms + missing) if missing else 0.0


@dataclass(frozen=True, slots=True)
class RecordingTimes:
    """All streams of one recording on one timeline.

    Attributes:
        streams: by name. clock: the PC's clock.
        implant_steps: where the implant's own clock was set: timeline in ms and by how many ms.
    """

    streams: dict[str, PacketTimes]
    clock: PcClock
    implant_steps: list[tuple[float, float]]


def reconstruct(headers: PacketHeaders, same: Same | None = None) -> PacketTimes:
    """Place every packet of one stream alone in time; without `same`, equal headers count as equal samples."""
    return reconstruct_all({"": headers}, {} if same is None else {"": same}).streams[""]


def reconstruct_all(streams: Mapping[str, PacketHeaders], same: Mapping[str, Same], leading: Sequence[str] = ()) -> RecordingTimes:
    """Place every packet of every stream on one timeline.

    Args:
        streams: headers by name of stream.
        same: how to compare the samples of two packets, by name of stream.
        leading: streams by whose PacketGenTimes the clock is fitted where they have any, so that the others move nothing; else by all.
    """
    elapsed = {name: device_ms(headers) for name, headers in streams.items()}
    filled = {name: headers for name, headers in streams.items() if headers.size}
    if not filled:
        return RecordingTimes({name: _nothing(headers) for name, headers in streams.items()}, fit_clock(np.empty(0), np.empty(0)), [])
    lead = [name for name in leading if name in filled and np.any(np.isfinite(filled[name].made_ms))] or list(filled)
    main = max(lead, key=lambda name: filled[name].size)
    for name, headers in filled.items():
        if name != main:
            elapsed[name] = elapsed[name] + between_streams(filled[main], elapsed[main], headers, elapsed[name])
    device_clock = not any(np.any(np.isfinite(headers.made_ms)) for headers in filled.values())
    pc = {name: headers.arrived_ms if device_clock else headers.made_ms for name, headers in filled.items()}
    clock = fit_clock(np.concatenate([elapsed[name] for name in lead]), np.concatenate([pc[name] for name in lead]))
    every = np.concatenate([elapsed[name] for name in filled])
    order = np.argsort(every, kind="stable")
    seconds = np.concatenate([1000.0 * headers.seconds for headers in filled.values()])
    implant = levels(every[order], (seconds - every)[order], SECONDS_STEP_MS)
    level = np.empty(every.size)
    for piece in implant.pieces():
        level[order[piece]] = np.median((seconds - every)[order[piece]])
    ends = np.cumsum([headers.size for headers in filled.values()])
    off = dict(zip(filled, np.split(seconds - every - level, ends[:-1]), strict=True))
    out = {name: _nothing(headers) for name, headers in streams.items()}
    for name, headers in filled.items():
        residual = pc[name] - clock.pc_ms(elapsed[name])
        out[name] = _place(headers, elapsed[name], clock, residual, off[name], same.get(name), device_clock)
    steps = [float(np.median(level[order[p]])) for p in implant.pieces()]
    at = clock.timeline_ms(implant.at_ms).tolist()
    return RecordingTimes(out, clock, list(zip(at, np.diff(steps).tolist(), strict=True)))


def _nothing(headers: PacketHeaders) -> PacketTimes:
    return PacketTimes(np.full(headers.size, np.nan), np.full(headers.size, -1, dtype=np.int64), False, 0)


def _place(
    headers: PacketHeaders,
    elapsed: NDArray[np.float64],
    clock: PcClock,
    residual: NDArray[np.float64],
    implant_off: NDArray[np.float64],
    same: Same | None,
    device_clock: bool,
) -> PacketTimes:
    """Compute the times of one stream from its device times, [n] in file order."""
    rejected: dict[Rejected, int] = {}
    order = np.argsort(elapsed, kind="stable")
    reordered = int(np.sum(elapsed < np.maximum.accumulate(elapsed)))
    order = _drop(order, _repeats(headers, elapsed, order, same), Rejected.DUPLICATE, rejected)
    order = _drop(order, _astray(headers, elapsed, order, residual, implant_off), Rejected.UNPLACEABLE, rejected)
    kept = headers.take(order)
    at, moved = _untangle(elapsed[order], kept)
    order, at, kept = _sort(order, at, kept)
    gaps = find_gaps(at, kept, clock.shift_ms)
    last_ms, chunk = np.full(headers.size, np.nan), np.full(headers.size, -1, dtype=np.int64)
    last_ms[order], chunk[order] = _equidistant(clock.timeline_ms(at), kept, gaps)
    lag = headers.arrived_ms - clock.pc_ms(elapsed)
    late = int(np.sum(lag > np.nanmedian(lag) + LATE_MS)) if np.any(np.isfinite(lag)) else 0
    received = float(kept.length_ms.sum())
    missing = int(gaps.packets.sum())
    return PacketTimes(last_ms, chunk, device_clock, missing, gaps, received, rejected, reordered, late, moved, residual)


def _drop(order: NDArray[np.int64], hit: NDArray[np.bool_], reason: Rejected, rejected: dict[Rejected, int]) -> NDArray[np.int64]:
    if hit.any():
        rejected[reason] = int(hit.sum())
    return order[~hit]


def _sort(
    order: NDArray[np.int64], at: NDArray[np.float64], kept: PacketHeaders
) -> tuple[NDArray[np.int64], NDArray[np.float64], PacketHeaders]:
    again = np.argsort(at, kind="stable")
    return order[again], at[again], kept.take(again)


def _repeats(headers: PacketHeaders, elapsed: NDArray[np.float64], order: NDArray[np.int64], same: Same | None) -> NDArray[np.bool_]:
    """Mark packets, in device order, with the content of an earlier one of the same clock and number: headers alone prove nothing."""
    hit = np.zeros(order.size, dtype=bool)
    for i in np.flatnonzero(np.diff(elapsed[order]) == 0).tolist():
        here = int(order[i + 1])
        j = i
        while j >= 0 and elapsed[order[j]] == elapsed[here]:
            there = int(order[j])
            equal = headers.sequence[there] == headers.sequence[here] and headers.samples[there] == headers.samples[here]
            if not hit[j] and equal and (same is None or same(there, here)):
                hit[i + 1] = True
                break
            j -= 1
    return hit


def _astray(
    headers: PacketHeaders,
    elapsed: NDArray[np.float64],
    order: NDArray[np.int64],
    residual: NDArray[np.float64],
    implant_off: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Mark packets, in device order, whose ticks both clocks contradict and that join no neighbour: their place is unknown."""
    doubtful = (np.abs(implant_off[order]) > SECONDS_STEP_MS) & ~(np.abs(residual[order]) <= ASTRAY_MS)
    if not doubtful.any():
        return doubtful
    length = headers.length_ms[order]
    joins = np.abs(np.diff(elapsed[order]) - length[1:]) <= JOINS * length[1:]
    return np.asarray(doubtful & ~np.concatenate(([False], joins)) & ~np.concatenate((joins, [False])))


def _untangle(at: NDArray[np.float64], kept: PacketHeaders) -> tuple[NDArray[np.float64], int]:
    """Correct device times, [n] in rising order, where packets carry the tick of the packet after them; also return how many those are.

    Now and then the recording program writes a packet under the header of the next one. Two packets then share a tick, and a gap of one
    packet's length comes before them. Signal cannot overlap, so the earlier one of the file belongs before the other.
    """
    length = kept.length_ms
    signal = kept.samples > 1
    shared = np.diff(at) <= np.where(signal[1:], SAME_TICK * length[1:], 0.0)
    moved = 0
    for i in np.flatnonzero(shared)[::-1].tolist():
        trial: dict[int, float] = {}
        j, due = i, float(at[i + 1] - length[i + 1])
        while j >= 0 and len(trial) < MOST_MOVED and at[j] > due + (0.5 * length[j + 1] if trial else 0.0):
            trial[j] = due
            due -= float(length[j])
            j -= 1
        if len(trial) < MOST_MOVED:
            for place, time in trial.items():
                at[place] = time
            moved += len(trial)
    return at, moved


def _equidistant(at_ms: NDArray[np.float64], kept: PacketHeaders, gaps: Gaps) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Compute the time of each packet's last sample and its chunk, both [n] in device order.

    Packets of one value are at their ticks. Samples of a chunk are equidistant, on the sampling grid of the first chunk. The chunk is
    placed at the median of its packets' ticks.
    """
    number = np.zeros(at_ms.size, dtype=np.int64)
    number[gaps.after + 1] = 1
    number = np.cumsum(number)
    if at_ms.size == 0 or kept.samples.max() <= 1:
        return at_ms, number
    total = np.cumsum(kept.length_ms)
    number, level = _level_chunks(at_ms - total, number)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    start = (level + total)[first]
    grid = 1000.0 / float(kept.rate_hz.max())
    start = start[0] + grid * np.floor((start - start[0]) / grid + 0.5)
    return start[number] + total - total[first][number], number


def _level_chunks(ahead_ms: NDArray[np.float64], number: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Cut chunks where ticks and samples part by more than `OFF_LATTICE_MS`; also compute the median of each chunk, both [n]."""
    level = np.empty(ahead_ms.size)
    cuts = np.zeros(ahead_ms.size, dtype=np.int64)
    todo = np.split(np.arange(ahead_ms.size), np.flatnonzero(np.diff(number)) + 1)
    while todo:
        piece = todo.pop()
        level[piece] = np.median(ahead_ms[piece])
        if piece.size > 1 and np.abs(ahead_ms[piece] - level[piece]).max() > OFF_LATTICE_MS:
            half = piece.size // 2
            cuts[piece[half]] = 1
            todo += [piece[:half], piece[half:]]
    return number + np.cumsum(cuts), level
