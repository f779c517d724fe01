"""Packets of an RC+S session as arrays. Source: format notes, A.2 to A.4, A.7.

Each reader takes packets one at a time and keeps numbers only; a packet with a field of the wrong kind is left out and counted.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.ingest.formats.rcs_settings import RATE_HZ, get, integer, number
from app.ingest.formats.rcs_time import PacketHeaders

HEADER_FIELDS = (("timestamp", "seconds"), ("systemTick",), ("dataTypeSequence",))


@dataclass(slots=True)
class HeaderRows:
    """Header fields collected packet by packet."""

    ints: tuple[array[int], ...] = field(default_factory=lambda: tuple(array("q") for _ in range(4)))
    floats: tuple[array[float], ...] = field(default_factory=lambda: tuple(array("d") for _ in range(3)))
    unusable: int = 0

    def add(self, packet: Any, samples: int, rate_hz: float) -> bool:
        """Take a packet's header; False (and counted) when it lacks a field."""
        found = [integer(get(packet, "Header", *path), bits=48) for path in HEADER_FIELDS]
        if any(value is None for value in found):
            self.unusable += 1
            return False
        for column, value in zip(self.ints, (*found, samples), strict=True):
            column.append(value or 0)
        times = (number(get(packet, "PacketGenTime")), number(get(packet, "PacketRxUnixTime")), rate_hz)
        for floats, time in zip(self.floats, times, strict=True):
            floats.append(float("nan") if time is None else time)
        return True

    def headers(self) -> PacketHeaders:
        """The collected fields as arrays [n]."""
        seconds, tick, sequence, samples = (np.array(column, dtype=np.int64) for column in self.ints)
        gen, rx, rate = (np.array(column, dtype=np.float64) for column in self.floats)
        return PacketHeaders(seconds, tick, gen, rx, sequence, samples, rate)


@dataclass(frozen=True, slots=True)
class TimeDomain:
    """Time-domain packets.

    Attributes:
        headers: of the packets, [n].
        samples: per key 0..3 the samples of all packets one after another, mV; NaN where no finite number stood.
        offsets: per key where each packet's samples begin in `samples`, [n]; -1 where the packet has none of that key.
        unusable: packets left out.
    """

    headers: PacketHeaders
    samples: tuple[NDArray[np.float64], ...]
    offsets: tuple[NDArray[np.int64], ...]
    unusable: int


@dataclass(frozen=True, slots=True)
class Power:
    """Power packets: band power in device units [n, 8], NaN where the band is not valid or over range."""

    headers: PacketHeaders
    bands: NDArray[np.float64]
    fft_size: NDArray[np.int64]
    td_rate_hz: NDArray[np.float64]
    unusable: int
    over_range: int


@dataclass(frozen=True, slots=True)
class Adaptive:
    """Adaptive log: delivered amplitude in mA [n, 4], state, detector output and inputs, sensing status bits [n]."""

    headers: PacketHeaders
    amplitude_ma: NDArray[np.float64]
    state: NDArray[np.int64]
    ld0_output: NDArray[np.float64]
    ld0_inputs: NDArray[np.float64]
    status_bits: NDArray[np.int64]
    unusable: int


def read_time_domain(packets: Iterable[Any]) -> TimeDomain:
    """Collect `TimeDomainData` packets."""
    rows = HeaderRows()
    samples = tuple(array("d") for _ in range(4))
    offsets = tuple(array("q") for _ in range(4))
    for packet in packets:
        rate = RATE_HZ.get(_code(packet, "SampleRate"))
        channels = _channels(packet)
        if rate is None or not channels:
            rows.unusable += 1
        elif rows.add(packet, len(next(iter(channels.values()))), rate):
            for key in range(4):
                offsets[key].append(len(samples[key]) if key in channels else -1)
                samples[key].extend(channels.get(key, ()))
    arrays = tuple(np.frombuffer(column, dtype=np.float64) if column else np.empty(0) for column in samples)
    for column in arrays:
        column[~np.isfinite(column)] = np.nan
    return TimeDomain(rows.headers(), arrays, tuple(np.array(column, dtype=np.int64) for column in offsets), rows.unusable)


def _channels(packet: Any) -> dict[int, array[float]]:
    """Samples by channel key; empty when the channels have different lengths or none at all."""
    found: dict[int, array[float]] = {}
    listed = get(packet, "ChannelSamples")
    for channel in listed if isinstance(listed, list) else ():
        key, values = integer(get(channel, "Key")), get(channel, "Value")
        if key in range(4) and key not in found and isinstance(values, list) and values and key is not None:
            try:
                found[key] = array("d", values)
            except (TypeError, OverflowError):
                found[key] = array("d", [float("nan") if (v := number(item)) is None else v for item in values])
    return found if len({len(values) for values in found.values()}) == 1 else {}


def _code(packet: Any, name: str) -> int:
    code = integer(get(packet, name))
    return -1 if code is None else code


def read_power(packets: Iterable[Any], interval_at: Any) -> Power:
    """Collect `PowerDomainData` packets.

    Args:
        packets: the packets.
        interval_at: function of a packet's PC time in ms (NaN when unknown) to the FFT interval in force, s.
    """
    rows = HeaderRows()
    bands, sizes, rates = array("d"), array("q"), array("d")
    over_range = 0
    for packet in packets:
        values = get(packet, "Bands")
        if not isinstance(values, list) or len(values) != 8:
            rows.unusable += 1
            continue
        if not rows.add(packet, 1, 1.0 / interval_at(_pc_ms(packet))):
            continue
        over = get(packet, "IsPowerChannelOverrange") is True
        over_range += over
        mask = _mask(packet)
        for i, item in enumerate(values):
            value = number(item)
            bands.append(float("nan") if value is None or over or not mask >> i & 1 else value)
        sizes.append(_code(packet, "FftSize"))
        rates.append(RATE_HZ.get(_code(packet, "SampleRate"), float("nan")))
    table = np.array(bands, dtype=np.float64).reshape(-1, 8)
    return Power(rows.headers(), table, np.array(sizes, dtype=np.int64), np.array(rates, dtype=np.float64), rows.unusable, over_range)


def _mask(packet: Any) -> int:
    mask = integer(get(packet, "ValidDataMask"))
    return 255 if mask is None or mask < 0 else mask


def _pc_ms(packet: Any) -> float:
    """PC time of a packet, ms: when it was generated, else when it arrived; NaN when neither is told."""
    gen = number(get(packet, "PacketGenTime"))
    if gen is not None and gen > 0:
        return gen
    rx = number(get(packet, "PacketRxUnixTime"))
    return rx if rx is not None and rx > 0 else float("nan")


def read_adaptive(records: Iterable[Any], interval_at: Any) -> Adaptive:
    """Collect `AdaptiveUpdate` records; `interval_at` as in `read_power`."""
    rows = HeaderRows()
    amplitudes, outputs, inputs = array("d"), array("d"), array("d")
    states, bits = array("q"), array("q")
    for record in records:
        update = get(record, "AdaptiveUpdate")
        delivered = get(update, "CurrentProgramAmplitudesInMilliamps")
        if not isinstance(delivered, list) or len(delivered) != 4:
            rows.unusable += 1
            continue
        if not rows.add(update, 1, 1.0 / interval_at(_pc_ms(update))):
            continue
        amplitudes.extend(_floats(delivered, 4))
        states.append(_code(update, "CurrentAdaptiveState"))
        outputs.extend(_floats([get(update, "Ld0Status", "output")], 1))
        features = get(update, "Ld0Status", "featureInputs")
        inputs.extend(_floats(features if isinstance(features, list) else [], 4))
        bits.append(max(0, _code(update, "SensingStatus")))
    return Adaptive(
        rows.headers(),
        np.array(amplitudes, dtype=np.float64).reshape(-1, 4),
        np.array(states, dtype=np.int64),
        np.array(outputs, dtype=np.float64),
        np.array(inputs, dtype=np.float64).reshape(-1, 4),
        np.array(bits, dtype=np.int64),
        rows.unusable,
    )


def _floats(values: list[Any], count: int) -> list[float]:
    """Exactly `count` numbers, NaN where there is none."""
    padded = [*values[:count], *([None] * (count - len(values)))]
    return [float("nan") if (v := number(item)) is None else v for item in padded]
