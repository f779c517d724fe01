"""Streams of a Percept: samples placed in time by their packets' ticks, and the device's own power and amplitude at 2 Hz.

A packet's tick is the time of its last sample, in ms with a resolution of 50 ms. A step of the ticks longer than the packet is loss. A step
of 2 in the sequence numbers is not, since they count parts of packets. Source: format notes, A′, after the loop that Medtronic published.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ml.formats.beta import FLAT_S, LARGEST_UV, flat_runs, living
from ml.formats.facts.counters import shift_by_turns, unwrap
from ml.formats.facts.sentinels import readings
from ml.formats.percept.enums import word
from ml.formats.percept.facts import AMPLITUDE, FACTS, POWER
from ml.formats.percept.report_json import SIDES, channel_names, entries, finite, inside, moment, packet_list, samples, side_of

Side = Literal["left", "right"]
TURN_MS = FACTS.counters["TicksInMs"].turn
MAX_SPAN_MS = 3 * 24 * 3600 * 1000.0
"""Longest span of the ticks of one run; a longer one is broken, since no run lasts three days."""

DEFAULT_RATE_HZ = 250.0
RATE_TOLERANCE = 0.15
"""A stated rate may differ by so much from what the ticks say, which count in steps of 50 ms."""

LEAST_PACKETS = 5
DEFAULT_LFP_RATE_HZ = 2.0


@dataclass(slots=True)
class TimeDomain:
    """Samples of one channel of one run.

    Attributes:
        channel: the device's name. side: of the brain. section: of the report.
        first_packet: time of the programmer at the first packet, resolution 1 s.
        rate_hz: samples per second. values: uV, [n], NaN where there is no number.
        begin_ms, end_ms: time before the first and of the last sample in ticks; from 0 where the file gives no ticks.
        ticked: whether the file gives ticks. Without them samples are taken to follow each other, and loss cannot be seen.
        pieces: (time of the first sample in ms, first index, end index) of every stretch between losses.
        lost: samples that the ticks say are missing. void: samples that hold no number, or one that no electrode gives.
        notes: what was adapted or is doubtful, in sentences.
    """

    channel: str
    side: Side | None
    section: str
    first_packet: datetime | None
    rate_hz: float
    values: NDArray[np.float64]
    begin_ms: float = 0.0
    end_ms: float = 0.0
    ticked: bool = False
    pieces: list[tuple[float, int, int]] = field(default_factory=list)
    lost: int = 0
    void: int = 0
    notes: list[str] = field(default_factory=list)

    def meet(self, begin_ms: float) -> None:
        """Move all ticks by the whole turns of their counter that bring them nearest to another channel's begin."""
        turns_ms = shift_by_turns(self.begin_ms, begin_ms, TURN_MS)
        self.begin_ms, self.end_ms = self.begin_ms + turns_ms, self.end_ms + turns_ms
        self.pieces = [(start_ms + turns_ms, first, end) for start_ms, first, end in self.pieces]

    def losses(self) -> list[str]:
        """List what is missing from the channel, in sentences."""
        out = []
        if self.lost:
            out.append(f"{100 * self.lost / (self.lost + self.values.size):.1f} % of the samples are missing ({self.lost})")
        if self.void:
            beyond = f"or one beyond {LARGEST_UV / 1000:g} mV, which no electrode gives"
            out.append(f"{self.void} samples hold no number, {beyond}: gaps")
        if flat := sum(end - begin for begin, end in flat_runs(self.values, self.rate_hz)):
            out.append(f"{flat} samples stand still for {FLAT_S:g} s or longer, as no electrode does: gaps")
        return out

    def stretches(self, origin_ms: float) -> list[tuple[float, float, NDArray[np.float64]]]:
        """List gap-free pieces (time of the first sample in s after `origin_ms`, rate, samples in uV); NaN samples cut them too."""
        out = []
        for start_ms, first, end in self.pieces:
            good = living(self.values[first:end], self.rate_hz)
            edges = np.flatnonzero(np.diff(np.concatenate(([False], good, [False])).astype(np.int8)))
            for begin, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                at_s = (start_ms - origin_ms) / 1000.0 + begin / self.rate_hz
                out.append((at_s, self.rate_hz, self.values[first + begin : first + stop]))
        return out


@dataclass(slots=True)
class DevicePower:
    """The device's own band power and the delivered amplitude of one run, one value per 0.5 s.

    Attributes:
        channels: names of the sensed channels. first_packet: as in `TimeDomain`.
        ticks_ms: end of each value's interval, [n], strictly increasing. interval_ms: time that one value covers.
        power: device units by side, [n]; NaN where there is none. amplitude_ma: delivered current by side, [n].
        snapshot: the therapy that was set.
        notes: what was adapted, in sentences. void: values that are no readings, in sentences.
    """

    channels: list[str]
    first_packet: datetime | None
    ticks_ms: NDArray[np.float64]
    interval_ms: float
    power: dict[Side, NDArray[np.float64]]
    amplitude_ma: dict[Side, NDArray[np.float64]]
    snapshot: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    void: list[str] = field(default_factory=list)

    def shift(self, turns_ms: float) -> None:
        """Move all ticks by whole turns of their counter, ms."""
        self.ticks_ms = self.ticks_ms + turns_ms

    def channel_of(self, side: Side) -> str | None:
        """Find the sensed channel of a side."""
        return next((name for name in self.channels if side_of(name) == side), None)


def time_domains(section: str, value: Any) -> list[TimeDomain]:
    """Read all channels of a time-domain section that have samples, placed in time."""
    out = []
    for number, entry in enumerate(entries(value), start=1):
        values = samples(entry.get("TimeDomainData", entry.get("TimeDomainDatainMicroVolts")))
        if values.size == 0:
            continue
        values[np.abs(values) > LARGEST_UV] = np.nan
        names = channel_names(entry.get("Channel"))
        rate = finite(entry.get("SampleRateInHz"))
        data = TimeDomain(
            channel=names[0] if names else f"channel {number}",
            side=(side_of(names[0]) if names else None) or side_of(word(entry.get("Hemisphere"))),
            section=section,
            first_packet=moment(entry.get("FirstPacketDateTime")),
            rate_hz=rate if rate is not None and 1 <= rate <= 10_000 else DEFAULT_RATE_HZ,
            values=values,
            void=int(np.sum(np.isnan(values))),
        )
        if data.rate_hz != rate:
            data.notes.append(f"no sampling rate given, {DEFAULT_RATE_HZ:g} Hz assumed")
        ticks, sizes = packet_list(entry.get("TicksInMses", entry.get("TicksInMs"))), packet_list(entry.get("GlobalPacketSizes"))
        _check_rate(data, sizes, ticks)
        place(data, sizes, ticks, entry.get("GlobalSequences"))
        out.append(data)
    return out


def _check_rate(data: TimeDomain, sizes: NDArray[np.float64], ticks_ms: NDArray[np.float64]) -> None:
    """Take the rate from sizes and ticks of the packets where it contradicts the stated one; losses make single packets seem slow."""
    n = min(sizes.size, ticks_ms.size)
    if n < LEAST_PACKETS or not _usable(ticks_ms[:n]) or not np.all(np.isfinite(sizes[:n])):
        return
    at, first = np.unique(unwrap(ticks_ms[:n], TURN_MS), return_index=True)
    count = np.add.reduceat(sizes[:n], first)
    by_ticks = float(np.median(1000.0 * count[1:] / np.diff(at))) if at.size >= LEAST_PACKETS and np.all(np.diff(first) > 0) else 0.0
    if 1 <= by_ticks <= 10_000 and abs(by_ticks / data.rate_hz - 1.0) > RATE_TOLERANCE:
        data.notes.append(f"{data.rate_hz:g} Hz is stated, the packets' ticks say {round(by_ticks)} Hz: the ticks count")
        data.rate_hz = float(round(by_ticks))


def place(data: TimeDomain, sizes: NDArray[np.float64], ticks_ms: NDArray[np.float64], sequences: Any = None) -> None:
    """Place the samples in time by the sizes and ticks of their packets; fills in `begin_ms`, `end_ms`, `pieces`, `lost` and `notes`."""
    sizes = _true_sizes(data, sizes)
    n = min(sizes.size, ticks_ms.size)
    if n == 0 or not _usable(ticks_ms[:n]):
        if n:
            data.notes.append("the packets' ticks make no sense: samples are taken to follow each other")
        _in_one_piece(data)
        return
    ticks_ms = unwrap(ticks_ms[:n], TURN_MS)
    if ticks_ms[-1] - ticks_ms[0] > MAX_SPAN_MS or ticks_ms.max() - ticks_ms.min() > MAX_SPAN_MS:
        data.notes.append("the packets' ticks span days: samples are taken to follow each other")
        _in_one_piece(data)
        return
    # packets that the list does not name come last; they follow the last one that it names
    counts = sizes[:n].astype(np.int64)
    first = np.concatenate(([0], np.cumsum(counts)[:-1]))
    keep = _not_repeated(ticks_ms, packet_list(sequences), data)
    listed = int(counts.sum())
    first, counts, ticks_ms = _one_per_tick(first[keep], counts[keep], ticks_ms[keep])
    _pieces(data, first, counts, ticks_ms, listed)


def _one_per_tick(
    first: NDArray[np.int64], counts: NDArray[np.int64], ticks_ms: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Join packets that follow each other under one tick: the tick is that of its last sample, and no signal is missing within."""
    starts = np.flatnonzero(np.concatenate(([True], (np.diff(ticks_ms) != 0) | (first[1:] != first[:-1] + counts[:-1]))))
    return first[starts], np.add.reduceat(counts, starts), ticks_ms[starts]


def _true_sizes(data: TimeDomain, sizes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return packet sizes that add up to the present samples, or none."""
    if sizes.size == 0:
        return sizes
    if not np.all((sizes >= 0) & (sizes < 1e7) & (sizes == np.floor(sizes))):
        data.notes.append("the list of packet sizes makes no sense: samples are taken to follow each other")
        return np.empty(0)
    listed, there = int(sizes.sum()), data.values.size
    if listed < there:
        data.notes.append(f"{there - listed} samples of the end are not in the list of packets: taken to follow the last packet")
    elif listed > there:
        data.notes.append(f"the list of packets names {listed} samples, {there} are there: the last packets are cut")
        # what is left of a cut packet follows the last whole one
        sizes = sizes[np.cumsum(sizes) <= there]
    return sizes


def _usable(ticks_ms: NDArray[np.float64]) -> bool:
    return bool(np.all(np.isfinite(ticks_ms)) and np.all(np.abs(ticks_ms) < 1e12))


def _not_repeated(ticks_ms: NDArray[np.float64], sequences: NDArray[np.float64], data: TimeDomain) -> NDArray[np.bool_]:
    """Mark packets that do not repeat the one before: same tick and same sequence number."""
    keep = np.ones(ticks_ms.size, dtype=bool)
    if sequences.size == ticks_ms.size:
        keep[1:] = (np.diff(ticks_ms) != 0) | (np.diff(sequences) != 0)
    if twice := int(np.sum(~keep)):
        data.notes.append(f"{twice} packet{'s' if twice > 1 else ''} came twice: left out once")
    return keep


def _in_one_piece(data: TimeDomain) -> None:
    step = 1000.0 / data.rate_hz
    data.pieces = [(step, 0, data.values.size)]
    data.end_ms = data.values.size * step


def _pieces(data: TimeDomain, first: NDArray[np.int64], counts: NDArray[np.int64], ticks_ms: NDArray[np.float64], listed: int) -> None:
    """Cut at losses; every piece ends at the tick of its last packet, and none begins before the one before has ended."""
    step = 1000.0 / data.rate_hz
    rise = np.diff(ticks_ms)
    back = int(np.sum(rise < 0))
    cut = np.flatnonzero((rise > (1 + counts[1:]) * step) | (rise < 0) | (first[1:] != first[:-1] + counts[:-1])) + 1
    bounds = [0, *cut.tolist(), counts.size]
    at_ms = -np.inf
    late = 0
    unlisted = data.values.size - listed
    for begin, end in pairwise(bounds):
        named = int(counts[begin:end].sum())
        total = named + (unlisted if end == counts.size else 0)
        last_ms = ticks_ms[end - 1] + (total - named) * step
        begin_ms = last_ms - total * step
        if begin_ms < at_ms - 0.5 * step:
            late += 1
            begin_ms = at_ms
        elif np.isfinite(at_ms):
            data.lost += round((begin_ms - at_ms) / step)
        else:
            data.begin_ms = begin_ms
        data.pieces.append((begin_ms + step, int(first[begin]), int(first[begin]) + total))
        at_ms = begin_ms + total * step
    data.end_ms, data.ticked = at_ms, True
    if back:
        data.notes.append(f"the packets' ticks go back {back} time{'s' if back > 1 else ''}: samples there are placed by their order")
    elif late:
        data.notes.append(f"{late} stretch{'es' if late > 1 else ''} of samples begin before the one before has ended: moved behind it")


def device_powers(value: Any) -> list[DevicePower]:
    """Read all runs of the device's own power that have values."""
    out = []
    for entry in entries(value):
        rows = entries(entry.get("LfpData"))
        ticks = samples([row.get("TicksInMs") for row in rows])
        if ticks.size == 0 or not _usable(ticks):
            continue
        ticks = unwrap(ticks, TURN_MS)
        forward = np.concatenate(([True], ticks[1:] > np.maximum.accumulate(ticks)[:-1])) & (ticks - ticks[0] < MAX_SPAN_MS)
        interval_ms, note = _interval_ms(finite(entry.get("SampleRateInHz")), ticks[forward])
        channels = channel_names(entry.get("Channel"))
        snapshot = entry.get("TherapySnapshot")
        data = DevicePower(
            channels=channels,
            first_packet=moment(entry.get("FirstPacketDateTime")),
            ticks_ms=ticks[forward],
            interval_ms=interval_ms,
            power={},
            amplitude_ma={},
            snapshot=snapshot if isinstance(snapshot, dict) else {},
        )
        for side in SIDES:
            for what, field_of, kept in (("LFP", POWER, data.power), ("mA", AMPLITUDE, data.amplitude_ma)):
                values, void = readings(samples([inside(row, side.capitalize(), what) for row in rows]), field_of)
                kept[side] = values[forward]
                if void:
                    data.void.append(f"{side}: {void} values of {what} are the device's sign for no reading, or impossible: gaps")
        if note:
            data.notes.append(note)
        if dropped := int(np.sum(~forward)):
            data.void.append(f"{dropped} power values that do not come later than those before them: left out")
        if not channels:
            data.channels = [f"POWER_{side.upper()}" for side in SIDES if np.nanmax(data.power[side], initial=0.0) > 0]
        out.append(data)
    return out


def _interval_ms(rate_hz: float | None, ticks_ms: NDArray[np.float64]) -> tuple[float, str | None]:
    """Compute the time that one value of the power covers, ms. Add a sentence where the stated rate is not that of the ticks, which count
    then."""
    stated = 1000.0 / (rate_hz if rate_hz is not None and 0.01 <= rate_hz <= 1000 else DEFAULT_LFP_RATE_HZ)
    if ticks_ms.size < LEAST_PACKETS:
        return stated, None
    by_ticks = float(np.median(np.diff(ticks_ms)))
    if abs(by_ticks / stated - 1.0) <= RATE_TOLERANCE or not 1.0 <= by_ticks <= 100_000.0:
        return stated, None
    return by_ticks, f"a power value every {stated:g} ms is stated, the ticks say every {by_ticks:g} ms: the ticks count"
