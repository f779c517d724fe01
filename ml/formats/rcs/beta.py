"""From RC+S time-domain packets to gap-free stretches, beta traces and spectra."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ml.formats.beta import LARGEST_UV, beta_streams, flat_runs
from ml.formats.rcs.packets.streams import TimeDomain
from ml.formats.rcs.packets.time import PacketTimes
from ml.formats.rcs.settings import Sensing, Settings
from ml.formats.rcs.traces import Grid
from ml.formats.recording import SampleLog, SpectrumLog, TraceLog
from ml.signals import BandRows, band_rows, gap_models, one_sample, spectrum

UV_PER_MV = 1000.0
ROWS_AT_ONCE = 300
"""Rows whose samples are filtered together, so that a recording of hours needs no multiple of itself in memory."""

SAMPLES_AT_ONCE = 1_000_000

MARGIN_CYCLES = 40.0
"""Signal that is filtered on either side of a block of rows, in cycles of the band's width. By then the filter has forgotten where it
began."""

Stretch = tuple[float, float, NDArray[np.float64]]
"""Time of the first sample in PC ms, rate in Hz, samples in mV."""


def time_domain_stretches(data: TimeDomain, times: PacketTimes, settings: Settings) -> dict[str, list[Stretch]]:
    """List gap-free stretches by channel and contact pair, e.g. `key 0 +2-0`, in the order of the file.

    Samples that are not strictly later than those before them are dropped, so overlapping packets count once; those that no electrode gives
    are gaps.
    """
    out: dict[str, list[Stretch]] = defaultdict(list)
    for key in range(4):
        used = np.flatnonzero((data.offsets[key] >= 0) & np.isfinite(times.last_ms))
        used = used[np.lexsort((times.last_ms[used], times.chunk[used]))]  # as measured, not as arrived
        names, number = _channels(key, times.last_ms[used], settings)
        for i, name in enumerate(names):
            out[name].extend(_join(_pieces(data, times, key, used[number == i])))
    return {name: stretches for name, stretches in sorted(out.items()) if stretches}


def _channels(key: int, t_ms: NDArray[np.float64], settings: Settings) -> tuple[list[str], NDArray[np.int64]]:
    """List the names that a key has in the course of the settings, and which of them is in force at each time, [n]."""
    states: list[Sensing] = settings.sensing.states or [Sensing()]
    of_state = [f"key {key} {state.contacts[key]}".strip() for state in states]
    names = list(dict.fromkeys(of_state))
    number = np.array([names.index(name) for name in of_state])
    state = np.searchsorted(settings.sensing.times_ms, t_ms, side="right") - 1
    return names, number[np.maximum(0, state)]


def _pieces(data: TimeDomain, times: PacketTimes, key: int, packets: NDArray[np.int64]) -> Iterator[Stretch]:
    """Yield runs of packets that follow each other within a chunk, cut where a sample is missing and where they overlap earlier ones."""
    if packets.size == 0:
        return
    count, rate, begin = data.headers.samples[packets], data.headers.rate_hz[packets], data.offsets[key][packets]
    after = (begin[1:] == begin[:-1] + count[:-1]) & (np.diff(times.chunk[packets]) == 0) & (np.diff(rate) == 0)
    heads = np.concatenate(([0], np.flatnonzero(~after) + 1, [packets.size]))
    latest_ms = -np.inf
    for first, end in zip(heads[:-1].tolist(), heads[1:].tolist(), strict=True):
        step_ms = 1000.0 / float(rate[first])
        start_ms = float(times.last_ms[packets[first]]) - (int(count[first]) - 1) * step_ms
        x = data.samples[key][int(begin[first]) : int(begin[end - 1] + count[end - 1])]
        skip = max(0, int(np.floor((latest_ms - start_ms) / step_ms + 0.01)) + 1) if latest_ms >= start_ms - 0.01 * step_ms else 0
        latest_ms = max(latest_ms, start_ms + (x.size - 1) * step_ms)
        for here, there in _true_runs(x[skip:], 1000.0 / step_ms):
            yield start_ms + (skip + here) * step_ms, 1000.0 / step_ms, x[skip + here : skip + there]


def impossible_samples(data: TimeDomain) -> int:
    """Count the samples of all channels that no electrode gives."""
    return sum(int(np.sum(np.abs(x) > LARGEST_UV / UV_PER_MV)) for x in data.samples)


def flat_samples(data: TimeDomain) -> int:
    """Count the samples of all channels in flat runs."""
    rates = data.headers.rate_hz[np.isfinite(data.headers.rate_hz)]
    rate = float(rates.max(initial=0.0))
    return sum(end - begin for x in data.samples for begin, end in flat_runs(x, rate)) if rate > 0 else 0


def _true_runs(x: NDArray[np.float64], rate_hz: float) -> Iterator[tuple[int, int]]:
    """Begin and end of every run of samples that an electrode can give."""
    begin = 0
    absurd = np.flatnonzero(~(np.abs(x) <= LARGEST_UV / UV_PER_MV)).tolist()
    for here, there in sorted([*((hole, hole + 1) for hole in absurd), *flat_runs(x, rate_hz)]):
        if here > begin:
            yield begin, here
        begin = max(begin, there)
    if x.size > begin:
        yield begin, x.size


def _join(pieces: Iterator[Stretch]) -> Iterator[Stretch]:
    """Join pieces that follow each other without a missing sample."""
    run: list[Stretch] = []
    due_ms = 0.0
    for piece in pieces:
        start_ms, rate_hz, x = piece
        if run and (rate_hz != run[0][1] or start_ms - due_ms > 500.0 / rate_hz):
            yield _concatenate(run)
            run = []
        run.append(piece)
        due_ms = start_ms + 1000.0 * x.size / rate_hz
    if run:
        yield _concatenate(run)


def _concatenate(pieces: list[Stretch]) -> Stretch:
    start_ms, rate_hz, x = pieces[0]
    return start_ms, rate_hz, x if len(pieces) == 1 else np.concatenate([piece[2] for piece in pieces])


def beta_traces(channels: dict[str, list[Stretch]], grid: Grid, notes: list[str]) -> list[TraceLog]:
    """Compute RMS amplitude (uV) and power (uV^2) of the beta band per channel and contact pair; the participant's measure is `beta`.

    Where rows are not whole, `beta_error` is the standard error of `beta`.
    """
    options = grid.options
    out: list[TraceLog] = []
    for channel, pieces in channels.items():
        fits = [piece for piece in pieces if options.beta_high_hz < piece[1] / 2]
        if len(fits) < len(pieces):
            notes.append(f"{channel}: sampled too slowly for a band up to {options.beta_high_hz:g} Hz; left out there")
        if not fits:
            continue
        rows = band_rows_in_blocks(fits, grid)
        details = {
            "low_hz": options.beta_low_hz,
            "high_hz": options.beta_high_hz,
            "rates_hz": sorted({rate for _, rate, _ in fits}),
            "contacts": channel[len("key 0 ") :],
        }
        for stream, unit, measure, values in beta_streams(rows, options):
            out.append(grid.trace((stream, channel, unit), "time_domain", values, rows.reached, {**details, "measure": measure}))
    return out


def time_domain_samples(channels: dict[str, list[Stretch]], grid: Grid) -> list[SampleLog]:
    """Collect the samples of each channel in uV, with the times of the recording's clock."""
    return [
        SampleLog.of(channel, "uV", [((start - grid.start_ms) / 1000.0, rate, UV_PER_MV * x) for start, rate, x in pieces])
        for channel, pieces in channels.items()
    ]


def band_rows_in_blocks(stretches: list[Stretch], grid: Grid) -> BandRows:
    """Compute `ml.signals.band_rows` of samples in uV, a block of rows at a time.

    Amplitudes equal those of the whole, for one model of the whole fills the gaps; the standard errors rest on the block's own
    autocorrelation.
    """
    options = grid.options
    found = gap_models([(start / 1000.0, rate, x) for start, rate, x in stretches])
    models = {rate: model and model.scaled(UV_PER_MV) for rate, model in found.items()}
    margin_s = MARGIN_CYCLES / (options.beta_high_hz - options.beta_low_hz) + 1.0
    begin_s = np.array([(start - grid.start_ms) / 1000.0 for start, _, _ in stretches])
    end_s = begin_s + np.array([x.size / rate for _, rate, x in stretches])
    n, sample = grid.rows, one_sample((rate for _, rate, _ in stretches), options.period_s)
    out = BandRows(np.empty(n), np.empty(n), np.empty(n), np.empty(n), sample)
    for first in range(0, grid.rows, ROWS_AT_ONCE):
        end = min(first + ROWS_AT_ONCE, grid.rows)
        low_s, high_s = first * options.period_s - margin_s, end * options.period_s + margin_s
        block = []
        for i in np.flatnonzero((end_s > low_s) & (begin_s < high_s)).tolist():
            _, rate, x = stretches[i]
            a = max(0, int((low_s - begin_s[i]) * rate))
            b = min(x.size, int((high_s - begin_s[i]) * rate) + 1)
            block.append((float(begin_s[i]) + a / rate, rate, x[a:b] * UV_PER_MV))
        # one row more in front, so that a sample on the border belongs to the row before and to no other
        ahead = min(first, 1)
        t0_s = (first - ahead) * options.period_s
        rows = band_rows(block, end - first + ahead, options.period_s, options.beta_low_hz, options.beta_high_hz, t0_s, models)
        for name in ("rms", "power", "covered", "rms_error"):
            getattr(out, name)[first:end] = getattr(rows, name)[ahead:]
    return out


def time_domain_spectra(channels: dict[str, list[Stretch]]) -> list[SpectrumLog]:
    """Estimate the Welch spectrum up to 100 Hz in bins of 1 Hz per channel, without gaps; channels without a whole second of signal have
    none."""
    out = []
    for channel, pieces in channels.items():
        hz, density, seconds = spectrum(pieces)
        if hz.size:
            out.append(SpectrumLog(channel, "uV2/Hz", hz, density * UV_PER_MV**2, round(seconds, 3)))
    return out


def flat_share(samples: NDArray[np.float64]) -> float:
    """Compute the share of samples equal to the one before: near 0 for a living channel, near 1 for one at its rail."""
    if samples.size < 2:
        return 0.0
    blocks = (samples[i : i + SAMPLES_AT_ONCE + 1] for i in range(0, samples.size - 1, SAMPLES_AT_ONCE))
    return sum(int(np.sum(block[1:] == block[:-1])) for block in blocks) / (samples.size - 1)
