"""Loss of a stream: the missing signal, and the number of missing packets.

Loss is missing signal: the share of the time between the first and the last sample that no packet covers. Where the settings show that
sensing was off, nothing is missing. Numbers of packets are reported too. They are lower, since the packet after a lost one is cut short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ml.formats.rcs.packets.headers import PacketHeaders

GAP = 0.5
"""Share of a packet's length; signal is missing where a packet is further than that beyond the samples before it."""

AGREE = 0.8
"""Largest relative difference from the clock at which the 8-bit counter of packets counts; it restarts at times."""

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Gaps:
    """Gaps of a stream's signal, [g] each.

    Attributes:
        after: the packet, in device order, after which it is missing.
        begin_ms, end_ms: on the timeline. missing_ms: how much signal is missing between them.
        packets: how many packets were lost.
    """

    after: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    begin_ms: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    end_ms: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    missing_ms: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    packets: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))


@dataclass(frozen=True, slots=True)
class Loss:
    """Amount that a stream lost.

    Attributes:
        packets: lost ones, by their counter where it can be believed.
        missing_s: signal that is missing. paused_s: time within the stream in which sensing was switched off.
        share: of the signal, 0..1.
    """

    packets: int
    missing_s: float
    paused_s: float
    share: float


def find_gaps(at_ms: NDArray[np.float64], kept: PacketHeaders, shift_ms: float) -> Gaps:
    """Find gaps of packets in device order, with their device times [n]; `shift_ms` is the timeline minus device time.

    A change of the rate begins a new stretch too, with nothing missing where the ticks say so.
    """
    if at_ms.size < 2:
        return Gaps()
    length = kept.length_ms
    usual = float(np.median(length))
    excess = np.diff(at_ms) - length[1:]
    by_clock = np.maximum(0.0, np.rint(excess / usual))
    counted = (np.diff(kept.sequence) - 1) % 256
    counted = np.maximum(0.0, counted + 256.0 * np.rint((by_clock - counted) / 256.0))
    packets = np.where(np.abs(counted - by_clock) <= np.maximum(3.0, AGREE * by_clock), counted, by_clock)
    signal = kept.samples[1:] > 1
    # a packet of one value may come early or late by more than a packet's length; signal cannot
    missing = np.where(signal, np.where(excess > GAP * length[1:], excess, 0.0), packets * length[1:])
    cut = (missing > 0) | (signal & (excess < -GAP * length[1:])) | (np.diff(kept.rate_hz) != 0)
    after = np.flatnonzero(cut)
    lost = np.where(signal & (missing > 0), np.maximum(packets, 1.0), np.where(signal, 0.0, packets))
    begin = at_ms[after] + shift_ms
    return Gaps(after, begin, begin + np.maximum(0.0, excess[after]), missing[after], lost[after].astype(np.int64))


def loss_of(gaps: Gaps, received_ms: float, off: Sequence[Interval]) -> Loss:
    """Compute what is missing without the times in which sensing was off; `off` are intervals of the timeline in ms."""
    span = gaps.end_ms - gaps.begin_ms
    paused = np.zeros(gaps.after.size)
    for begin, end in off:
        paused += np.maximum(0.0, np.minimum(gaps.end_ms, end) - np.maximum(gaps.begin_ms, begin))
    share = np.divide(paused, span, out=np.zeros_like(paused), where=span > 0)
    left = 1.0 - np.minimum(share, 1.0)
    missing = float(np.sum(gaps.missing_ms * left))
    lost = round(float(np.sum(gaps.packets * left)))
    whole = received_ms + missing
    return Loss(lost, missing / 1000.0, float(paused.sum()) / 1000.0, missing / whole if whole > 0 else 0.0)
