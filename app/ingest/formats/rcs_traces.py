"""RC+S streams brought onto the recording's common grid of steps."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.ingest.formats.log import TraceLog, TraceSource
from app.ingest.formats.options import DecodeOptions
from app.ingest.formats.rcs_amplitude import AmplitudeSteps
from app.ingest.formats.rcs_settings import FFT_SIZE, Settings
from app.ingest.formats.rcs_streams import Power, TimeDomain
from app.ingest.formats.rcs_time import PacketTimes
from ml.signals import band_rows, row_means, step_means

POWER_BIT = 4
UV_PER_MV = 1000.0
SETTLE_S = 1.0
"""Five time constants of the 0.85 Hz high-pass: until then what the amplifier shows after switching on is its own step, not the brain."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Rows of `options.period_s` from `start_ms` (PC clock) on; data end at `end_s`."""

    start_ms: float
    end_s: float
    rows: int
    options: DecodeOptions

    def seconds(self, t_ms: NDArray[np.float64]) -> NDArray[np.float64]:
        """Times after the start, s."""
        return (t_ms - self.start_ms) / 1000.0

    def trace(
        self,
        names: tuple[str, str, str],
        source: TraceSource,
        values: NDArray[np.float64],
        covered: NDArray[np.float64],
        details: Mapping[str, Any],
    ) -> TraceLog:
        """A trace of (stream, channel, unit); rows covered too little, or without a number, are invalid and NaN."""
        valid = (covered >= self.options.min_valid_fraction - 1e-9) & np.isfinite(values)
        stored = np.where(valid, values, np.nan).astype(np.float32)
        period = self.options.period_s
        return TraceLog(*names, source, period, period, stored, valid, {**details, "min_valid_fraction": self.options.min_valid_fraction})


def beta_traces(data: TimeDomain, times: PacketTimes, settings: Settings, grid: Grid, notes: list[str]) -> list[TraceLog]:
    """RMS amplitude (`beta`, uV) and power (`beta_power`, uV^2) of the beta band per channel and contact pair."""
    options = grid.options
    out: list[TraceLog] = []
    for channel, pieces in sorted(time_domain_stretches(data, times, settings).items()):
        fits = [(grid.seconds(np.array([start]))[0], rate, x * UV_PER_MV) for start, rate, x in pieces if options.beta_high_hz < rate / 2]
        if len(fits) < len(pieces):
            notes.append(f"{channel}: sampled too slowly for a band up to {options.beta_high_hz:g} Hz; left out there")
        if not fits:
            continue
        rows = band_rows(fits, grid.rows, options.period_s, options.beta_low_hz, options.beta_high_hz)
        details = {
            "low_hz": options.beta_low_hz,
            "high_hz": options.beta_high_hz,
            "rates_hz": sorted({rate for _, rate, _ in fits}),
            "contacts": channel.partition(" ")[2],
        }
        out.append(grid.trace(("beta", channel, "uV"), "time_domain", rows.rms, rows.covered, {**details, "measure": "rms"}))
        out.append(grid.trace(("beta_power", channel, "uV2"), "time_domain", rows.power, rows.covered, {**details, "measure": "power"}))
    return out


def time_domain_stretches(
    data: TimeDomain, times: PacketTimes, settings: Settings
) -> dict[str, list[tuple[float, float, NDArray[np.float64]]]]:
    """Gap-free stretches (time of the first sample in PC ms, rate in Hz, samples in mV) by channel, e.g. `key 0 +2-0`.

    Samples that are not strictly later than those before them are dropped, so overlapping packets count once.
    """
    out: dict[str, list[tuple[float, float, NDArray[np.float64]]]] = defaultdict(list)
    for key in range(4):
        used = np.flatnonzero((data.offsets[key] >= 0) & np.isfinite(times.last_ms))
        if used.size == 0:
            continue
        names = _channel_names(key, times.last_ms[used], settings)
        for name in dict.fromkeys(names):
            chosen = used[[n == name for n in names]]
            out[name].extend(_stretches(data, times, key, chosen))
    return dict(out)


def _channel_names(key: int, t_ms: NDArray[np.float64], settings: Settings) -> list[str]:
    states = (settings.sensing.at(float(t)) for t in t_ms)
    return [f"key {key} {state.contacts[key]}".strip() if state is not None else f"key {key}" for state in states]


def _stretches(
    data: TimeDomain, times: PacketTimes, key: int, packets: NDArray[np.int64]
) -> Iterator[tuple[float, float, NDArray[np.float64]]]:
    """Pieces of one key's samples; arrays of the recording's length are dropped as soon as they are used, a long one has many samples."""
    count = data.headers.samples[packets]
    step = 1000.0 / data.headers.rate_hz[packets]
    before = np.cumsum(count) - count
    t_ms = np.arange(int(count.sum()), dtype=np.float64)
    t_ms -= np.repeat(before, count)
    x = data.samples[key][np.repeat(data.offsets[key][packets], count) + t_ms.astype(np.int64)]
    width = np.repeat(step, count)
    t_ms *= width
    t_ms += np.repeat(times.last_ms[packets] - (count - 1) * step, count)
    keep = np.isfinite(x)
    keep[1:] &= t_ms[1:] > np.maximum.accumulate(t_ms)[:-1] + 0.01 * width[1:]
    if not keep.all():
        t_ms, x, width = t_ms[keep], x[keep], width[keep]
    cuts = (np.flatnonzero((np.diff(t_ms) > 1.5 * width[1:]) | (np.diff(width) != 0)) + 1).tolist()
    bounds = [0, *cuts, t_ms.size]
    heads = [(float(t_ms[i]), 1000.0 / float(width[i])) for i in bounds[:-1] if i < t_ms.size]
    del t_ms, width, keep
    for (start_ms, rate_hz), first, end in zip(heads, bounds, bounds[1:], strict=False):
        yield start_ms, rate_hz, x[first:end]


def flat_share(samples: NDArray[np.float64]) -> float:
    """Share of samples equal to the one before: near 0 for a living channel, near 1 for one at its rail."""
    return float(np.mean(np.diff(samples) == 0)) if samples.size > 1 else 0.0


def power_traces(data: Power, times: PacketTimes, settings: Settings, grid: Grid, notes: list[str]) -> list[TraceLog]:
    """On-device band power (`band_power`, device units) per band and band edges in force."""
    t_s = grid.seconds(times.last_ms)
    interval = 1.0 / data.headers.rate_hz
    settling = settling_packets(data, times, settings)
    if settling.any():
        notes.append(
            f"{int(settling.sum())} power packets right after sensing was switched on left out: their FFT window holds the switching step"
        )
    out: list[TraceLog] = []
    placed = np.isfinite(t_s)
    for i in range(8):
        if not np.any(np.isfinite(data.bands[:, i])):
            continue
        names, edges = _band_names(i, data, times, settings)
        for name in sorted(set(names) - {""}):
            chosen = placed & np.array([n == name for n in names])
            values = np.where(chosen & ~settling, data.bands[:, i], np.nan)
            means, covered = row_means(np.where(placed, t_s, -1e9), values, interval, grid.rows, grid.options.period_s)
            low, high = edges.get(name, (None, None))
            details = {"band": i + 1, "channel_key": i // 2, "low_hz": low, "high_hz": high}
            out.append(grid.trace(("band_power", name, "device units"), "device_power", means, covered, details))
    return out


def settling_packets(data: Power, times: PacketTimes, settings: Settings) -> NDArray[np.bool_]:
    """Packets whose FFT window reaches back to the amplifier's step after power sensing was switched on, [n]."""
    out = np.zeros(data.headers.size, dtype=bool)
    on_before: bool | None = None
    for time_ms, state in zip(settings.sensing.times_ms, settings.sensing.states, strict=True):
        on = None if state.sense_bits is None else bool(state.sense_bits & POWER_BIT)
        if on and on_before is False:
            rates = data.td_rate_hz
            sizes = np.array([FFT_SIZE.get(int(code), 0) for code in data.fft_size], dtype=np.float64)
            window_ms = 1000.0 * (SETTLE_S + np.where(np.isfinite(rates), sizes / rates, 0.0))
            out |= (times.last_ms >= time_ms) & (times.last_ms < time_ms + window_ms)
        on_before = on
    return out


def _band_names(index: int, data: Power, times: PacketTimes, settings: Settings) -> tuple[list[str], dict[str, tuple[float, float]]]:
    """Channel name of each packet's band under the settings in force then, and the edges of each name in Hz."""
    names: list[str] = []
    edges: dict[str, tuple[float, float]] = {}
    for t in times.last_ms:
        state = settings.sensing.at(float(t)) if np.isfinite(t) else None
        band = state.bands[index] if state is not None else None
        names.append(band.name if band is not None else f"band {index + 1}")
        if band is not None:
            edges[band.name] = (round(band.low_hz, 3), round(band.high_hz, 3))
    return names, edges


def amplitude_traces(steps: AmplitudeSteps, grid: Grid) -> list[TraceLog]:
    """Delivered amplitude (`amplitude`, mA) per program that stimulates at any time of the recording, time-weighted per step."""
    t_s = grid.seconds(steps.t_ms)
    out = []
    for p in steps.programs:
        means, covered = step_means(t_s, steps.amplitude_ma[:, p], grid.end_s, grid.rows, grid.options.period_s)
        details = {"program": p, "origin": "AdaptiveLog" if steps.from_adaptive else "StimLog", "assumed_program": steps.assumed_program}
        out.append(grid.trace(("amplitude", f"program {p}", "mA"), "device_log", means, covered, details))
    return out
