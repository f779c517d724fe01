"""When each RC+S packet was measured. Source: the format notes, A.2 and A.9, and where this differs from the public toolbox.

A packet carries a device clock (1 s `timestamp`, 100 us `systemTick` rolling over every 6.5536 s) and the host's estimate of its
generation in the PC clock (`PacketGenTime`, about +-50 ms). Packets are cut into chunks without loss; inside a chunk samples are
equidistant, and the chunk as a whole is placed by the median of its PacketGenTimes.

Differences from the toolbox, on purpose:
- packets whose PacketGenTime is 0 or negative are kept; they only have no say in where their chunk lies;
- a chunk, or a whole recording, without any PacketGenTime is placed by the device clock;
- the deviation of the device clock from PacketGenTime is judged against its median, so one bad first packet rejects nothing else;
- a chunk is placed at the median of (PacketGenTime - elapsed), the first packet included;
- packets that arrived out of order are put in the order of the device's clock first.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

TICKS_PER_S = 10_000
ROLLOVER = 65_536
ROLLOVER_S = ROLLOVER / TICKS_PER_S
DAY_S = 86_400
CLOCK_DEVIATION_MS = 2_000
BACK_STEP_MS = 500
UNSEEN_GAP_S = 6.5
"""Beyond this the 8-bit sequence number says nothing about how many packets are missing, or whether the stream was on."""


class Rejected(StrEnum):
    """Why a packet was left out."""

    DAY_OFF = "day_off"
    CLOCKS_DISAGREE = "clocks_disagree"
    DUPLICATE = "duplicate"
    STEPS_BACK = "steps_back"


@dataclass(frozen=True, slots=True)
class PacketHeaders:
    """Header fields of one stream in file order, all shape [n]."""

    seconds: NDArray[np.int64]
    tick: NDArray[np.int64]
    gen_ms: NDArray[np.float64]
    rx_ms: NDArray[np.float64]
    sequence: NDArray[np.int64]
    samples: NDArray[np.int64]
    rate_hz: NDArray[np.float64]

    @property
    def size(self) -> int:
        """Number of packets n."""
        return int(self.seconds.size)

    def take(self, index: NDArray[np.int64]) -> PacketHeaders:
        """Some of the packets."""
        return PacketHeaders(*(getattr(self, name)[index] for name in PacketHeaders.__slots__))


@dataclass(frozen=True, slots=True)
class PacketTimes:
    """Reconstructed times.

    Attributes:
        last_ms: time of each packet's last sample, ms in the PC clock (or device-placed), [n]; NaN where rejected.
        chunk: number of the gap-free chunk, [n]; -1 where rejected.
        device_clock: True when no packet had a usable PacketGenTime and arrival times placed the recording.
        missing: packets lost within the stream, by sequence number.
        rejected: how many packets were rejected, by reason.
        reordered: how many packets stood after a later one in the file.
    """

    last_ms: NDArray[np.float64]
    chunk: NDArray[np.int64]
    device_clock: bool
    missing: int
    rejected: dict[Rejected, int] = field(default_factory=dict)
    reordered: int = 0

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return int(self.chunk.max(initial=-1)) + 1

    @property
    def loss(self) -> float:
        """Share of packets that did not arrive, 0..1."""
        kept = int(np.sum(self.chunk >= 0))
        return self.missing / (kept + self.missing) if kept else 0.0


def reconstruct(headers: PacketHeaders) -> PacketTimes:
    """Place every packet of one stream in time."""
    rejected: dict[Rejected, int] = {}
    gen = np.where(headers.gen_ms > 0, headers.gen_ms, np.nan)
    keep = _acceptable(headers, gen, rejected)
    last_ms = np.full(headers.size, np.nan)
    chunk = np.full(headers.size, -1, dtype=np.int64)
    index = np.flatnonzero(keep)
    if index.size == 0:
        return PacketTimes(last_ms, chunk, False, 0, rejected)
    index, reordered = _in_device_order(headers, index, rejected)
    kept = headers.take(index)
    device_ms = _device_ms(kept)
    number = np.concatenate(([0], np.cumsum(_breaks(kept))))
    anchor, device_clock = _anchors(kept, gen[index], number, device_ms)
    last_ms[index] = anchor[number] + _elapsed_ms(kept, number)
    chunk[index] = number
    return PacketTimes(last_ms, chunk, device_clock, _missing(kept, device_ms), rejected, reordered)


def _in_device_order(headers: PacketHeaders, index: NDArray[np.int64], rejected: dict[Rejected, int]) -> tuple[NDArray[np.int64], int]:
    """The packets in the order of the device's clock without repetitions, and how many of them were late."""
    device_ms = _device_ms(headers.take(index))
    reordered = int(np.sum(device_ms < np.maximum.accumulate(device_ms)))
    if reordered == 0:
        return index, 0
    order = index[np.argsort(device_ms, kind="stable")]
    twin = np.concatenate(([False], _same_packet(headers.take(order))))
    if twin.any():
        rejected[Rejected.DUPLICATE] = rejected.get(Rejected.DUPLICATE, 0) + int(twin.sum())
    return order[~twin], reordered


def _same_packet(headers: PacketHeaders) -> NDArray[np.bool_]:
    """Where a packet repeats the one before, [n - 1]."""
    return np.asarray((np.diff(headers.sequence) == 0) & (np.diff(headers.tick) == 0))


def _acceptable(headers: PacketHeaders, gen: NDArray[np.float64], rejected: dict[Rejected, int]) -> NDArray[np.bool_]:
    """Which packets to use, [n]; counts the others by reason."""
    keep = np.ones(headers.size, dtype=bool)

    def drop(mask: NDArray[np.bool_], reason: Rejected) -> None:
        if count := int(np.sum(keep & mask)):
            rejected[reason] = count
            keep[mask] = False

    if headers.size == 0:
        return keep
    drop(np.abs(headers.seconds - np.median(headers.seconds)) > DAY_S, Rejected.DAY_OFF)
    deviation = gen - 1000.0 * headers.seconds
    if np.any(usable := keep & np.isfinite(deviation)):
        far = np.abs(deviation - np.median(deviation[usable])) > CLOCK_DEVIATION_MS
        drop(np.isfinite(deviation) & far, Rejected.CLOCKS_DISAGREE)
    drop(np.concatenate(([False], _same_packet(headers))), Rejected.DUPLICATE)
    drop(_after_back_step(gen), Rejected.STEPS_BACK)
    return keep


def _after_back_step(gen: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Packets after PacketGenTime fell by more than 500 ms: the next two, and up to the sixth while still earlier than before."""
    hit = np.zeros(gen.size, dtype=bool)
    for i in np.flatnonzero(np.diff(gen) < -BACK_STEP_MS).tolist():
        hit[i + 1 : i + 3] = True
        for j in range(i + 3, min(i + 7, gen.size)):
            if not gen[j] < gen[i]:
                break
            hit[j] = True
    return hit


def _breaks(kept: PacketHeaders) -> NDArray[np.bool_]:
    """True where a new chunk starts after packet i, [n - 1]."""
    seconds = np.diff(kept.seconds)
    sequence = np.diff(kept.sequence)
    ticks = np.diff(kept.tick) % ROLLOVER
    expected = kept.samples[1:] / kept.rate_hz[1:] * TICKS_PER_S
    return np.asarray(
        (np.diff(kept.rate_hz) != 0)
        | ~np.isin(seconds, (0, 1))
        | ~np.isin(sequence, (1, -255))
        | (np.abs(expected - ticks) > np.maximum(0.5 * expected, 1000))
    )


def _device_ms(kept: PacketHeaders) -> NDArray[np.float64]:
    """The device's own clock made continuous, ms after the first packet, [n]: ticks, with the rollovers that `timestamp` shows.

    A step is the one of its ticks that lies nearest to the step of `timestamp`, which is right to a second: forwards or backwards.
    """
    ticks = (np.diff(kept.tick) % ROLLOVER) / TICKS_PER_S
    turns = np.rint((np.diff(kept.seconds) - ticks) / ROLLOVER_S)
    return np.concatenate(([0.0], np.cumsum(1000.0 * (ticks + ROLLOVER_S * turns))))


DRIFT_SPAN_S = 30.0
"""Over less time than this the PC's jitter of some 20 ms says nothing about drift."""


def device_clock_drift(headers: PacketHeaders) -> float | None:
    """How fast the device's clock runs against the PC's: relative, 0 when both agree; None when the stream is too short to tell.

    The median of the slopes between packets half the stream apart (the robust line of Theil and Sen on few pairs), PacketGenTime against
    the device's ticks, of packets in rising order of the device's clock.
    """
    kept = np.flatnonzero(headers.gen_ms > 0)
    kept = kept[np.abs(headers.seconds[kept] - np.median(headers.seconds[kept])) <= DAY_S] if kept.size else kept
    if kept.size < 4:
        return None
    chosen = headers.take(kept)
    device_ms, half = _device_ms(chosen), kept.size // 2
    device, pc = device_ms[half:] - device_ms[:-half], chosen.gen_ms[half:] - chosen.gen_ms[:-half]
    long = device > 500.0 * DRIFT_SPAN_S
    if device_ms[-1] < 1000.0 * DRIFT_SPAN_S or not long.any():
        return None
    return float(np.median(device[long] / np.where(pc[long] == 0, np.nan, pc[long]))) - 1.0


def _elapsed_ms(kept: PacketHeaders, number: NDArray[np.int64]) -> NDArray[np.float64]:
    """Time of each packet's last sample after that of its chunk's first packet, ms, [n]."""
    length = 1000.0 * kept.samples / kept.rate_hz
    total = np.cumsum(length)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    return np.asarray(total - total[first][number])


def _anchors(
    kept: PacketHeaders, gen: NDArray[np.float64], number: NDArray[np.int64], device_ms: NDArray[np.float64]
) -> tuple[NDArray[np.float64], bool]:
    """Time of the last sample of each chunk's first packet, snapped to the sampling grid of the first chunk, [chunks]."""
    elapsed = _elapsed_ms(kept, number)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    ends = np.append(first[1:], number.size)
    device_clock = not np.any(np.isfinite(gen))
    clock = kept.rx_ms if device_clock else gen
    offset = np.full(first.size, np.nan)
    for c, (start, end) in enumerate(zip(first, ends, strict=True)):
        votes = clock[start:end] - elapsed[start:end]
        if np.any(known := np.isfinite(votes)):
            offset[c] = np.median(votes[known])
    if device_clock:
        offset = device_ms[first] + (np.nanmedian(clock - device_ms) if np.any(np.isfinite(clock)) else 0.0)
    else:
        _place_by_device_clock(offset, device_ms[first])
    grid = 1000.0 / float(kept.rate_hz.max())
    return offset[0] + grid * np.floor((offset - offset[0]) / grid + 0.5), device_clock


def _place_by_device_clock(offset: NDArray[np.float64], device_ms: NDArray[np.float64]) -> None:
    """Fill in chunks without any PacketGenTime from the nearest chunk that has one, in place."""
    known = np.flatnonzero(np.isfinite(offset))
    for c in np.flatnonzero(~np.isfinite(offset)):
        near = known[np.argmin(np.abs(device_ms[known] - device_ms[c]))]
        offset[c] = offset[near] + device_ms[c] - device_ms[near]


def _missing(kept: PacketHeaders, device_ms: NDArray[np.float64]) -> int:
    """Packets lost in gaps short enough for the sequence number to count them.

    The counter starts anew at times; where it says something else than the clock, the clock counts.
    """
    gap_s = np.diff(device_ms) / 1000.0
    by_clock = np.maximum(0, np.rint(gap_s * kept.rate_hz[1:] / np.maximum(kept.samples[1:], 1)) - 1)
    by_number = (np.diff(kept.sequence) - 1) % 256
    agree = np.abs(by_number - by_clock) <= np.maximum(2, 0.5 * by_clock)
    return int(np.sum(np.where(agree, by_number, by_clock)[gap_s < UNSEEN_GAP_S]))
