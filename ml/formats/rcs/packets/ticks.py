"""The implant's ticks made continuous: how much time passed between packets, whatever happened to the clocks meanwhile.

A tick counts 100 us and the counter restarts every 6.5536 s. So two packets are a known time apart but for whole turns. Four witnesses show
how many turns: the implant's `timestamp`, PacketGenTime, the time of arrival, and the 8-bit counter of packets. Where the implant's and the
PC's clock agree, their number counts. Where they differ, one of them was set or one packet's field is wrong. Then the number of turns with
which most agree counts. So a step of either clock moves no packet.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ml.formats.rcs.packets.headers import ROLLOVER, ROLLOVER_MS, TICKS_PER_S, PacketHeaders

SECOND_MS: Final = 1_100.0
"""`timestamp` counts whole seconds: two of them differ from the ticks between them by less than this."""

MADE_MS: Final = 500.0
ARRIVED_MS: Final = 1_500.0
"""How far PacketGenTime and the time of arrival may lie from the ticks and still agree."""

LATE_PACKETS: Final = 64
"""A packet that arrives after a later one is at most so many packets late."""


def device_ms(headers: PacketHeaders) -> NDArray[np.float64]:
    """Compute the time of every packet after the first one of the file, ms of the implant's ticks, [n]; negative steps are late packets."""
    if headers.size == 0:
        return np.empty(0)
    ticks = (np.diff(headers.tick) % ROLLOVER) * (1000.0 / TICKS_PER_S)
    implant, made, arrived = 1000.0 * np.diff(headers.seconds), np.diff(headers.made_ms), np.diff(headers.arrived_ms)
    turns = np.rint((implant - ticks) / ROLLOVER_MS)
    pc_turns = np.rint((np.where(np.isfinite(made), made, arrived) - ticks) / ROLLOVER_MS)
    doubtful = np.abs(implant - ticks - ROLLOVER_MS * turns) > SECOND_MS
    doubtful |= np.isfinite(pc_turns) & (pc_turns != turns)
    at = np.flatnonzero(doubtful)
    if at.size:
        candidates = [turns[at], *(np.rint((step[at] - ticks[at]) / ROLLOVER_MS) for step in (made, arrived)), 0 * at, 0 * at - 1]
        steps = np.stack([ticks[at] + ROLLOVER_MS * np.nan_to_num(turn, nan=0.0) for turn in candidates])
        counted = np.diff(headers.sequence)[at] % 256
        usual = float(np.median(ticks))
        score = (
            2.0 * _counter_agrees(steps, counted, usual)
            + 2.0 * (np.abs(implant[at] - steps) <= SECOND_MS)
            + 1.0 * (np.abs(made[at] - steps) <= MADE_MS)
            + 1.0 * (np.abs(arrived[at] - steps) <= ARRIVED_MS)
        )
        # of equally likely ones the shorter: no packet is long late, and clocks jump further than streams pause
        score -= 0.5 * (steps < -ROLLOVER_MS) + 1e-3 * np.abs(steps) / np.abs(steps).max()
        ticks[at] = steps[np.argmax(score, axis=0), np.arange(at.size)]
        turns[at] = 0.0
    return np.concatenate(([0.0], np.cumsum(ticks + ROLLOVER_MS * turns)))


def _counter_agrees(steps_ms: NDArray[np.float64], counted: NDArray[np.int64], usual_ms: float) -> NDArray[np.bool_]:
    """Decide whether steps, [candidates, m], are what so many packets last: lost ones may have been four times as long as usual, or a
    quarter."""
    ahead = (steps_ms >= 0.25 * counted * usual_ms - 150.0) & (steps_ms <= 4.0 * counted * usual_ms + 500.0)
    late = 256 - counted
    behind = (steps_ms <= 150.0 - 0.25 * late * usual_ms) & (steps_ms >= -4.0 * late * usual_ms - 500.0)
    return np.asarray(ahead | (behind & (late <= LATE_PACKETS)))


def between_streams(one: PacketHeaders, one_ms: NDArray[np.float64], other: PacketHeaders, other_ms: NDArray[np.float64]) -> float:
    """Compute what to add to the other stream's device times so that both streams count from the same moment, ms.

    Every packet of the other stream is compared with the one of the first that was made nearest to it. Ticks give their distance but for
    whole turns, which the clock that both share gives. The median over all packets counts, so that a step of it has no effect.
    """
    for name in ("made_ms", "arrived_ms", "seconds"):
        a, b = (np.asarray(getattr(x, name), dtype=np.float64) * (1000.0 if name == "seconds" else 1.0) for x in (one, other))
        known_a, known_b = np.flatnonzero(np.isfinite(a)), np.flatnonzero(np.isfinite(b))
        if known_a.size and known_b.size:
            break
    order = known_a[np.argsort(a[known_a], kind="stable")]
    after = np.clip(np.searchsorted(a[order], b[known_b]), 0, order.size - 1)
    before = np.maximum(after - 1, 0)
    near = order[np.where(np.abs(a[order[before]] - b[known_b]) < np.abs(a[order[after]] - b[known_b]), before, after)]
    ticks = (other.tick[known_b] - one.tick[near]) % ROLLOVER * (1000.0 / TICKS_PER_S)
    apart = ticks + ROLLOVER_MS * np.rint((b[known_b] - a[near] - ticks) / ROLLOVER_MS)
    offsets = one_ms[near] + apart - other_ms[known_b]
    return float(offsets[np.argsort(offsets, kind="stable")[offsets.size // 2]])
