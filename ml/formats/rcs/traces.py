"""RC+S streams brought onto the recording's common grid of steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.options import DecodeOptions
from ml.formats.rcs.amplitude import AmplitudeSteps
from ml.formats.rcs.outliers import power_spikes
from ml.formats.rcs.packets.streams import Accel, Fft, Power
from ml.formats.rcs.packets.time import PacketTimes
from ml.formats.rcs.settings import FFT_SIZE, Settings, get, integer
from ml.formats.recording import SpectrumLog, TraceLog, TraceSource
from ml.signals import row_means, row_of, step_means

POWER_BIT = 4
UV_PER_MV = 1000.0
MAX_HZ = 100.0
WINDOW_SAMPLES = {64: 62, 256: 250, 1024: 1000}
"""Samples the device puts into an FFT of each size; the rest is zeros."""

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
        """Convert times to seconds after the start."""
        return (t_ms - self.start_ms) / 1000.0

    def trace(
        self,
        names: tuple[str, str, str],
        source: TraceSource,
        values: NDArray[np.float64],
        covered: NDArray[np.float64],
        details: Mapping[str, Any],
    ) -> TraceLog:
        """Make a trace of (stream, channel, unit); rows with too little coverage, or without a number, are invalid and NaN."""
        valid = (covered >= self.options.min_valid_fraction - 1e-9) & np.isfinite(values)
        stored = np.where(valid, values, np.nan).astype(np.float32)
        period = self.options.period_s
        return TraceLog(*names, source, period, period, stored, valid, {**details, "min_valid_fraction": self.options.min_valid_fraction})


def power_traces(data: Power, times: PacketTimes, settings: Settings, grid: Grid, notes: list[str]) -> list[TraceLog]:
    """Make traces of on-device band power (`band_power`, device units) per band and band edges in force, without spikes.

    A spike in one band counts in all: the amplifier's transient is broad. A band of a single bin varies too much to show it. `details`
    counts the packets excluded as spikes and lists the rows they were in. Such a row is invalid when too little of it remains.
    """
    t_s = grid.seconds(times.last_ms)
    interval = 1.0 / data.headers.rate_hz
    settling = settling_packets(data, times, settings)
    if settling.any():
        notes.append(
            f"{int(settling.sum())} power packets right after sensing was switched on left out: their FFT window holds the switching step"
        )
    placed = np.isfinite(t_s)
    channels = _channels(data, times, settings, placed & ~settling)
    spikes = np.zeros(data.headers.size, dtype=bool)
    for _, _, values in channels.values():
        spikes |= _spikes(values, t_s, data)
    out: list[TraceLog] = []
    for name, (i, edges, values) in channels.items():
        hit = spikes & np.isfinite(values)
        rows = np.unique(row_of(t_s[hit], grid.options.period_s))
        if rows.size:
            notes.append(f"{name}: {int(hit.sum())} packets with power spikes in {rows.size} rows became gaps")
        left = np.where(spikes, np.nan, values)
        means, covered = row_means(np.where(placed, t_s, -1e9), left, interval, grid.rows, grid.options.period_s)
        details = {
            "band": i + 1,
            "channel_key": i // 2,
            "low_hz": edges[0],
            "high_hz": edges[1],
            "spike_packets": int(hit.sum()),
            "spike_rows": rows.tolist(),
        }
        out.append(grid.trace(("band_power", name, "device units"), "device_power", means, covered, details))
    return out


Edges = tuple[float | None, float | None]


def _channels(
    data: Power, times: PacketTimes, settings: Settings, usable: NDArray[np.bool_]
) -> dict[str, tuple[int, Edges, NDArray[np.float64]]]:
    """Collect, for every channel name that a band ever has, band index, edges in Hz and power in usable packets, [n] with NaN elsewhere."""
    out: dict[str, tuple[int, Edges, NDArray[np.float64]]] = {}
    for i in range(8):
        if np.any(np.isfinite(data.bands[:, i])):
            names, edges = _band_names(i, data, times, settings)
            for name in sorted(set(names)):
                chosen = usable & np.array([n == name for n in names])
                out[name] = (i, edges.get(name, (None, None)), np.where(chosen, data.bands[:, i], np.nan))
    return out


def _spikes(values: NDArray[np.float64], t_s: NDArray[np.float64], data: Power) -> NDArray[np.bool_]:
    """Mark spikes of one band, [n]; each FFT interval and size on its own."""
    out = np.zeros(values.size, dtype=bool)
    windows = window_s(data)
    for rate, window in sorted(set(zip(data.headers.rate_hz.tolist(), windows.tolist(), strict=True))):
        same = np.flatnonzero((data.headers.rate_hz == rate) & (windows == window) & np.isfinite(values))
        same = same[np.argsort(t_s[same], kind="stable")]
        out[same] = power_spikes(values[same], 1.0 / rate, window)
    return out


def window_s(data: Power | Fft) -> NDArray[np.float64]:
    """Compute the length of each packet's FFT window, s, [n]; 0 where size or rate are unknown."""
    sizes = np.array([FFT_SIZE.get(code, 0) for code in data.fft_size.tolist()], dtype=np.float64)
    return np.where(np.isfinite(data.td_rate_hz), sizes / np.nan_to_num(data.td_rate_hz, nan=1.0), 0.0)


def settling_packets(data: Power, times: PacketTimes, settings: Settings) -> NDArray[np.bool_]:
    """Mark packets whose FFT window reaches back to the amplifier's step after power sensing was switched on, [n]."""
    out = np.zeros(data.headers.size, dtype=bool)
    on_before: bool | None = None
    for time_ms, state in zip(settings.sensing.times_ms, settings.sensing.states, strict=True):
        on = None if state.sense_bits is None else bool(state.sense_bits & POWER_BIT)
        if on and on_before is False:
            window_ms = 1000.0 * (SETTLE_S + window_s(data))
            out |= (times.last_ms >= time_ms) & (times.last_ms < time_ms + window_ms)
        on_before = on
    return out


def _band_names(index: int, data: Power, times: PacketTimes, settings: Settings) -> tuple[list[str], dict[str, tuple[float, float]]]:
    """Name each packet's band under the settings in force then, and list the edges of each name in Hz."""
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
    """Make traces of delivered amplitude (`amplitude`, mA) per program that stimulates at any time of the recording, time-weighted per
    step."""
    t_s = grid.seconds(steps.t_ms)
    out = []
    for p in steps.programs:
        means, covered = step_means(t_s, steps.amplitude_ma[:, p], grid.end_s, grid.rows, grid.options.period_s)
        details = {"program": p, "origin": "AdaptiveLog" if steps.from_adaptive else "StimLog", "assumed_program": steps.assumed_program}
        out.append(grid.trace(("amplitude", f"program {p}", "mA"), "device_log", means, covered, details))
    return out


def accel_traces(data: Accel, times: PacketTimes, grid: Grid) -> list[TraceLog]:
    """Compute root mean square acceleration per row (`acceleration`, centiG), over the three axes, each freed of its mean in the row.

    The mean is gravity (about 100 centiG along the vertical) and the sensor's offset.
    """
    used = np.flatnonzero(np.isfinite(times.last_ms))
    count, step_s = data.headers.samples[used], 1.0 / data.headers.rate_hz[used]
    within = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    t_s = np.repeat(grid.seconds(times.last_ms[used]), count) - (np.repeat(count, count) - 1 - within) * np.repeat(step_s, count)
    x = data.samples[np.repeat(data.offsets[used], count) + within]
    weight = np.repeat(step_s, count)
    whole = np.all(np.isfinite(x), axis=1)
    square = np.zeros(grid.rows)
    covered = np.zeros(grid.rows)
    for axis in range(3):
        values = np.where(whole, x[:, axis], np.nan)
        mean, covered = row_means(t_s, values, weight, grid.rows, grid.options.period_s)
        row = np.clip(row_of(t_s, grid.options.period_s), 0, max(0, grid.rows - 1))
        square += row_means(t_s, (values - mean[row]) ** 2, weight, grid.rows, grid.options.period_s)[0]
    details = {"measure": "rms of three axes without their mean", "rates_hz": sorted(set(data.headers.rate_hz[used].tolist()))}
    return [grid.trace(("acceleration", "implant", "centiG"), "device_log", np.sqrt(square), covered, details)]


def fft_results(data: Fft, times: PacketTimes, settings: Settings, grid: Grid) -> tuple[list[TraceLog], list[SpectrumLog]]:
    """Make a trace of the on-device amplitude within the beta band (`band_amplitude`, uV rms), and a mean spectrum per channel.

    The device streams the amplitude F of a sine in each bin: F = 4 |FFT| / N with a Hann window over n of N samples (notes, A.11). So the
    one-sided density is F^2 N^2 / (3 n rate), and the rms within the band is the root of its integral.
    """
    traces, spectra = [], []
    placed = np.isfinite(times.last_ms)
    offset = integer(get(settings.merged, "SensingConfig", "fftConfig", "streamOffsetBins")) or 0
    kinds = set(zip(data.channel.tolist(), data.fft_size.tolist(), data.td_rate_hz.tolist(), strict=True))
    for key, code, rate in sorted(kind for kind in kinds if kind[1] in FFT_SIZE and np.isfinite(kind[2])):
        size = FFT_SIZE[code]
        chosen = np.flatnonzero(placed & (data.channel == key) & (data.fft_size == code) & (data.td_rate_hz == rate))
        hz = (offset + np.arange(data.amplitude_mv.shape[1])) * rate / size
        density = (UV_PER_MV * data.amplitude_mv[chosen]) ** 2 * size**2 / (3.0 * WINDOW_SAMPLES[size] * rate)
        density[:, hz == 0] /= 2.0
        channel = f"key {key} on-device FFT {size} at {rate:g} Hz"
        band = (hz >= grid.options.beta_low_hz) & (hz <= grid.options.beta_high_hz)
        seconds = 1.0 / data.headers.rate_hz[chosen]
        if chosen.size and band.any():
            power = density[:, band].sum(axis=1) * rate / size
            means, covered = row_means(grid.seconds(times.last_ms[chosen]), power, seconds, grid.rows, grid.options.period_s)
            details = {"low_hz": float(hz[band][0]), "high_hz": float(hz[band][-1]), "channel_key": key, "fft_size": size, "rate_hz": rate}
            traces.append(grid.trace(("band_amplitude", channel, "uV"), "device_power", np.sqrt(means), covered, details))
        shown = (hz <= MAX_HZ) & np.any(np.isfinite(density), axis=0)
        if chosen.size and shown.any():
            spectra.append(SpectrumLog(channel, "uV2/Hz", hz[shown], np.nanmean(density[:, shown], axis=0), round(float(seconds.sum()), 3)))
    return traces, spectra
