"""Packets of an RC+S session as arrays. Source: format notes, A.2 to A.4, A.7.

Each reader takes packets in batches and keeps numbers only; a packet with a field of the wrong kind is ignored and counted.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.facts.sentinels import reading, readings
from ml.formats.rcs.packets.facts import FACTS
from ml.formats.rcs.packets.headers import ROLLOVER, TICKS_PER_S, PacketHeaders
from ml.formats.rcs.packets.scan import ARRAYS, Batch, join
from ml.formats.rcs.settings import RATE_HZ, get, integer, number

ACCEL_RATE_HZ = {0: 65.104, 1: 32.552, 2: 16.276, 3: 8.138, 4: 4.069}
AXES = ("XSamples", "YSamples", "ZSamples")
FIELDS = FACTS.fields
Interval = Callable[[float], float | None]
"""A function from a packet's PC time in ms (NaN when unknown) to the FFT interval in force, s. None where the settings lack it."""

DEFAULT_INTERVAL_S = 0.1


@dataclass(frozen=True, slots=True)
class TimeDomain:
    """Time-domain packets.

    Attributes:
        headers: of the packets, [n].
        samples: per key 0..3 the samples of all packets one after another, mV; NaN where no finite number stood.
        offsets: per key where each packet's samples begin in `samples`, [n]; -1 where the packet has none of that key.
        unusable: ignored packets.
    """

    headers: PacketHeaders
    samples: tuple[NDArray[np.float64], ...]
    offsets: tuple[NDArray[np.int64], ...]
    unusable: int

    def same(self, i: int, j: int) -> bool:
        """Compare the samples of two packets."""
        return all(_same(x, at, self.headers.samples, i, j) for x, at in zip(self.samples, self.offsets, strict=True))


@dataclass(frozen=True, slots=True)
class Power:
    """Power packets: band power in device units [n, 8], NaN where the band is not valid or over range."""

    headers: PacketHeaders
    bands: NDArray[np.float64]
    fft_size: NDArray[np.int64]
    td_rate_hz: NDArray[np.float64]
    unusable: int
    over_range: int

    def same(self, i: int, j: int) -> bool:
        """Compare the powers of two packets."""
        return bool(np.array_equal(self.bands[i], self.bands[j], equal_nan=True))


@dataclass(frozen=True, slots=True)
class Accel:
    """Accelerometer packets: acceleration of all samples one after another, centiG [m, 3]; where each packet's begin, [n]."""

    headers: PacketHeaders
    samples: NDArray[np.float64]
    offsets: NDArray[np.int64]
    unusable: int

    def same(self, i: int, j: int) -> bool:
        """Compare the samples of two packets."""
        return _same(self.samples, self.offsets, self.headers.samples, i, j)


@dataclass(frozen=True, slots=True)
class Fft:
    """On-device spectra: amplitude per bin in mV, [n, bins], NaN beyond a packet's own bins; channel key, FFT size, sampling rate [n]."""

    headers: PacketHeaders
    amplitude_mv: NDArray[np.float64]
    channel: NDArray[np.int64]
    fft_size: NDArray[np.int64]
    td_rate_hz: NDArray[np.float64]
    unusable: int

    def same(self, i: int, j: int) -> bool:
        """Compare the channels and spectra of two packets."""
        return self.channel[i] == self.channel[j] and bool(np.array_equal(self.amplitude_mv[i], self.amplitude_mv[j], equal_nan=True))


@dataclass(frozen=True, slots=True)
class TimeSync:
    """Clock exchanges: measured latency in ms, [n]; NaN where none was measured."""

    headers: PacketHeaders
    latency_ms: NDArray[np.float64]
    unusable: int

    def same(self, i: int, j: int) -> bool:
        """Compare the latencies of two packets."""
        return bool(np.array_equal(self.latency_ms[i], self.latency_ms[j], equal_nan=True))


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

    def same(self, i: int, j: int) -> bool:
        """Compare the amplitudes, states and detectors of two updates."""
        columns = (self.amplitude_ma, self.ld0_output, self.ld0_inputs)
        return self.state[i] == self.state[j] and all(np.array_equal(x[i], x[j], equal_nan=True) for x in columns)


class _Table:
    """Scalars of usable packets, batch by batch."""

    def __init__(self) -> None:
        self._columns: dict[str, list[NDArray[np.float64]]] = {}
        self.unusable = 0

    def take(self, batch: Batch, fits: NDArray[np.bool_], **more: NDArray[np.float64]) -> NDArray[np.int64]:
        """Keep the packets that fit and have a whole header; their rows in the batch."""
        for name in ("seconds", "systemTick", "dataTypeSequence"):
            value = batch.column(name)
            fits = fits & (np.abs(value) < 2.0**48) & (value == np.floor(value))
        rows = np.flatnonzero(fits)
        self.unusable += batch.size - rows.size
        scalars = {name: batch.column(name) for name in _KEPT}
        for name, column in (scalars | more).items():
            self._columns.setdefault(name, []).append(column[rows])
        return rows

    def column(self, name: str) -> NDArray[np.float64]:
        """Return one of the collected columns, [n]."""
        pieces = self._columns.get(name)
        return np.concatenate(pieces) if pieces else np.empty(0)

    def codes(self, name: str) -> NDArray[np.int64]:
        """Return a column of codes, [n]; -1 where it has no whole number."""
        return _codes(self.column(name))

    def headers(self, samples: NDArray[np.float64] | None = None, rate_hz: NDArray[np.float64] | None = None) -> PacketHeaders:
        """Return the collected headers, [n]; one sample a packet where `samples` are not given."""
        seconds, tick, sequence = (self.column(name).astype(np.int64) for name in ("seconds", "systemTick", "dataTypeSequence"))
        many = np.ones(seconds.size) if samples is None else samples
        rate = self.column("rate") if rate_hz is None else rate_hz
        gen, rx = self.column("PacketGenTime"), self.column("PacketRxUnixTime")
        return PacketHeaders(seconds, tick, gen, rx, sequence, many.astype(np.int64), rate)

    def pc_ms(self) -> NDArray[np.float64]:
        """Compute the PC time of every packet, ms: when it was generated, else when it arrived; NaN when neither is known."""
        gen, rx = self.column("PacketGenTime"), self.column("PacketRxUnixTime")
        return np.where(gen > 0, gen, np.where(rx > 0, rx, np.nan))

    def rate_of(self, interval_at: Interval) -> NDArray[np.float64]:
        """Compute packets per second under the FFT interval in force at each packet, [n]."""
        values = [interval_at(t) for t in self.pc_ms().tolist()]
        return _rate(np.array([np.nan if value is None else value for value in values], dtype=np.float64), self.column("systemTick"))


_KEPT = ("seconds", "systemTick", "dataTypeSequence", "PacketGenTime", "PacketRxUnixTime", "SampleRate", "FftSize", "Channel")


def _same(x: NDArray[np.float64], offsets: NDArray[np.int64], count: NDArray[np.int64], i: int, j: int) -> bool:
    """Compare samples of x of packets i and j; both may have none."""
    if offsets[i] < 0 or offsets[j] < 0:
        return bool(offsets[i] == offsets[j])
    return bool(np.array_equal(x[offsets[i] : offsets[i] + count[i]], x[offsets[j] : offsets[j] + count[j]], equal_nan=True))


def _rate(interval_s: NDArray[np.float64], tick: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute packets per second, [n]; where the settings lack the interval, from the median step of the device's clock."""
    steps = np.diff(tick) % ROLLOVER / TICKS_PER_S
    usual = float(np.median(steps)) if steps.size else 0.0
    return np.asarray(1.0 / np.where(np.isfinite(interval_s), interval_s, usual if usual > 0 else DEFAULT_INTERVAL_S))


def _codes(column: NDArray[np.float64]) -> NDArray[np.int64]:
    usable = (np.abs(column) < 2.0**31) & (column == np.floor(column))
    return np.where(usable, column, -1.0).astype(np.int64)


def _rates(codes: NDArray[np.int64], known: dict[int, float]) -> NDArray[np.float64]:
    """Rate in Hz by code, NaN for codes without one."""
    rate = np.full(codes.size, np.nan)
    for code, hz in known.items():
        rate[codes == code] = hz
    return rate


def read_time_domain(batches: Iterable[Batch]) -> TimeDomain:
    """Collect `TimeDomainData` packets: usable are those with a known rate and channels of one length."""
    table = _Table()
    samples = tuple(array("d") for _ in range(4))
    offsets: tuple[list[NDArray[np.int64]], ...] = ([], [], [], [])
    for batch in batches:
        lengths = batch.lengths[:, :4]
        longest = lengths.max(axis=1, initial=0)
        even = np.all((lengths <= 0) | (lengths == longest[:, None]), axis=1)
        rate = _rates(_codes(batch.column("SampleRate")), RATE_HZ)
        rows = table.take(batch, even & (longest > 0) & np.isfinite(rate), rate=rate, samples=longest.astype(np.float64))
        for key in range(4):
            size = np.maximum(lengths[rows, key], 0)
            offsets[key].append(np.where(size > 0, len(samples[key]) + np.cumsum(size) - size, -1))
            samples[key].frombytes(join(batch, ARRAYS[key], rows).tobytes())
    arrays = tuple(np.frombuffer(column, dtype=np.float64) if column else np.empty(0) for column in samples)
    starts = tuple(np.concatenate(column) if column else np.empty(0, dtype=np.int64) for column in offsets)
    return TimeDomain(table.headers(table.column("samples")), arrays, starts, table.unusable)


def read_power(batches: Iterable[Batch], interval_at: Interval) -> Power:
    """Collect `PowerDomainData` packets."""
    table = _Table()
    bands = [np.empty((0, 8))]
    over_range = 0
    for batch in batches:
        rows = table.take(batch, batch.lengths[:, ARRAYS.index("Bands")] == 8)
        values = join(batch, "Bands", rows).reshape(-1, 8)
        mask = _codes(batch.column("ValidDataMask")[rows])
        over = batch.column("IsPowerChannelOverrange")[rows] == 1.0
        over_range += int(over.sum())
        valid = np.where(mask < 0, 255, mask)[:, None] >> np.arange(8) & 1 == 1
        bands.append(np.where(valid & ~over[:, None], readings(values, FIELDS["Bands"])[0], np.nan))
    headers = table.headers(rate_hz=table.rate_of(interval_at))
    rates = _rates(table.codes("SampleRate"), RATE_HZ)
    return Power(headers, np.concatenate(bands), table.codes("FftSize"), rates, table.unusable, over_range)


def read_accel(batches: Iterable[Batch]) -> Accel:
    """Collect `AccelData` packets: usable are those with a known rate and three axes of one length."""
    table = _Table()
    slots = [ARRAYS.index(axis) for axis in AXES]
    pieces = [np.empty((0, 3))]
    for batch in batches:
        lengths = batch.lengths[:, slots]
        rate = _rates(_codes(batch.column("SampleRate")), ACCEL_RATE_HZ)
        fits = (lengths[:, 0] > 0) & np.all(lengths == lengths[:, :1], axis=1) & np.isfinite(rate)
        rows = table.take(batch, fits, rate=rate, samples=lengths[:, 0].astype(np.float64))
        pieces.append(readings(np.stack([join(batch, axis, rows) for axis in AXES], axis=1), FIELDS["XSamples, YSamples, ZSamples"])[0])
    headers = table.headers(table.column("samples"))
    return Accel(headers, np.concatenate(pieces), np.cumsum(headers.samples) - headers.samples, table.unusable)


def read_fft(batches: Iterable[Batch], interval_at: Interval) -> Fft:
    """Collect `FftData` packets."""
    table = _Table()
    pieces: list[NDArray[np.float64]] = []
    slot = ARRAYS.index("FftOutput")
    for batch in batches:
        bins = batch.lengths[:, slot]
        rows = table.take(batch, (bins > 0) & (bins <= MAX_BINS))
        out = np.full((rows.size, MAX_BINS), np.nan)
        out[np.arange(MAX_BINS) < bins[rows, None]] = readings(join(batch, "FftOutput", rows), FIELDS["FftOutput"])[0]
        pieces.append(out[:, : int(bins[rows].max(initial=0))])
    width = max((piece.shape[1] for piece in pieces), default=0)
    whole = [np.pad(piece, ((0, 0), (0, width - piece.shape[1])), constant_values=np.nan) for piece in pieces]
    amplitude = np.concatenate(whole) if whole else np.empty((0, 0))
    headers = table.headers(rate_hz=table.rate_of(interval_at))
    rates = _rates(table.codes("SampleRate"), RATE_HZ)
    return Fft(headers, amplitude, table.codes("Channel"), table.codes("FftSize"), rates, table.unusable)


MAX_BINS = 512
"""Half of the largest FFT the device makes."""


def read_time_sync(batches: Iterable[Batch]) -> TimeSync:
    """Collect `TimeSyncData` packets, about one a second."""
    table = _Table()
    for batch in batches:
        table.take(batch, np.ones(batch.size, dtype=bool), latency=batch.column("LatencyMilliseconds"))
    one_a_second = np.ones(table.column("seconds").size)
    return TimeSync(table.headers(rate_hz=one_a_second), table.column("latency"), table.unusable)


def read_adaptive(records: Iterable[Any], interval_at: Interval) -> Adaptive:
    """Collect `AdaptiveUpdate` records: usable are those with a whole header and four delivered amplitudes."""
    rows = list(_adaptive_rows(records, interval_at))
    table = np.array([row for row in rows if row is not None], dtype=np.float64).reshape(-1, 17)
    header = table[:, :6]
    whole = header[:, :3].astype(np.int64)
    rate = _rate(header[:, 5], header[:, 1])
    headers = PacketHeaders(whole[:, 0], whole[:, 1], header[:, 3], header[:, 4], whole[:, 2], np.ones(len(table), dtype=np.int64), rate)
    return Adaptive(
        headers,
        table[:, 6:10],
        table[:, 10].astype(np.int64),
        table[:, 11],
        table[:, 12:16],
        table[:, 16].astype(np.int64),
        len(rows) - len(table),
    )


def _adaptive_rows(records: Iterable[Any], interval_at: Interval) -> Iterator[array[float] | None]:
    """Yield for each record 3 numbers of the header, 2 times, interval, 4 amplitudes, state, output, 4 inputs, status bits; None when
    unusable."""
    for record in records:
        update = get(record, "AdaptiveUpdate")
        delivered = get(update, "CurrentProgramAmplitudesInMilliamps")
        found = [
            integer(get(update, "Header", *path), bits=48) for path in (("timestamp", "seconds"), ("systemTick",), ("dataTypeSequence",))
        ]
        if not isinstance(delivered, list) or len(delivered) != 4 or None in found:
            yield None
            continue
        gen, rx = (_float(get(update, name)) for name in ("PacketGenTime", "PacketRxUnixTime"))
        interval = interval_at(gen if gen > 0 else rx if rx > 0 else float("nan"))
        output = get(update, "Ld0Status", "output")
        features = get(update, "Ld0Status", "featureInputs")
        inputs = [*(features if isinstance(features, list) else []), *[None] * 4][:4]
        state, bits = (integer(get(update, name), bits=31) for name in ("CurrentAdaptiveState", "SensingStatus"))
        yield array(
            "d",
            (
                *(float(value or 0) for value in found),
                *(gen, rx, _float(interval)),
                *map(_float, delivered),
                -1.0 if state is None else float(state),
                *(_float(reading(number(value), FIELDS["output, featureInputs"])) for value in (output, *inputs)),
                float(max(0, bits or 0)),
            ),
        )


def _float(value: Any) -> float:
    found = number(value)
    return float("nan") if found is None else found
