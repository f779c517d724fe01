"""P_beta per step from samples of a local field potential, whichever device or table they come from. Source: Gao et al. 2023, section 3."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.options import DecodeOptions
from ml.formats.recording import SpectrumLog, TraceLog, TraceSource
from ml.signals import BandRows, Stretch, band_rows, spectrum

LARGEST_UV = 1e5
"""No electrode in a brain gives a tenth of a volt: a larger sample is damage, or in another unit."""

FLAT_S = 0.5
"""A living electrode never gives one value for so long: the input was open, at its rail, or filled in by a writer."""

ERROR_STREAM = "beta_error"
"""Standard error of each row of `beta` for what is missing of it; there where something is."""


def flat_runs(x: NDArray[np.float64], rate_hz: float) -> list[tuple[int, int]]:
    """Find the runs of one value that last `FLAT_S` or longer, as begin and end in samples.

    Args:
        x: samples that follow each other, [n]; NaN is no value. rate_hz: of them.
    """
    least = max(2, math.ceil(FLAT_S * rate_hz))
    # a run of that length has two equal samples half of it apart
    step = max(1, least // 2)
    if x.size < least or not np.any(x[:-step:step] == x[step::step]):
        return []
    edges = np.flatnonzero(np.diff(np.concatenate(([0], (x[1:] == x[:-1]).astype(np.int8), [0]))))
    return [(a, b + 1) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True) if b + 1 - a >= least]


def living(x: NDArray[np.float64], rate_hz: float) -> NDArray[np.bool_]:
    """Mark the samples that are numbers and within no flat run, [n]."""
    good = np.isfinite(x)
    for begin, end in flat_runs(x, rate_hz):
        good[begin:end] = False
    return good


def step_trace(
    names: tuple[str, str, str],
    source: TraceSource,
    values: NDArray[np.float64],
    covered: NDArray[np.float64],
    options: DecodeOptions,
    details: Mapping[str, Any],
    t_end_first_s: float | None = None,
) -> TraceLog:
    """Make a trace of (stream, channel, unit) on the grid of steps; rows with too little coverage, or without a number, are invalid and
    NaN.

    Args:
        names: stream, channel, unit.
        source: where the values come from.
        values: one per row, shape [rows].
        covered: share of each row that there are data for, 0..1, shape [rows].
        options: the period, and the share that a valid row needs.
        details: how the values were made.
        t_end_first_s: end of the first row; one period where not given.
    """
    valid = (covered >= options.min_valid_fraction - 1e-9) & np.isfinite(values)
    stored = np.where(valid, values, np.nan).astype(np.float32)
    first = options.period_s if t_end_first_s is None else t_end_first_s
    said = {**details, "min_valid_fraction": options.min_valid_fraction}
    return TraceLog(*names, source, options.period_s, first, stored, valid, said)


def time_domain_traces(
    stretches: Sequence[Stretch],
    channel: str,
    rows: int,
    options: DecodeOptions,
    details: Mapping[str, Any],
    t0_s: float = 0.0,
) -> list[TraceLog]:
    """Compute RMS amplitude and power of one channel's beta band. The stream `beta` is the measure that the options name; the other comes
    with it.

    Where rows are not whole, `beta_error` is the standard error of `beta`.

    Stretches sampled too slowly for the band are ignored; no trace where all are.

    Args:
        stretches: gap-free pieces in uV.
        channel: name of the channel.
        rows: number of rows, the first beginning at `t0_s`.
        options: band, period, measure, share that a valid row needs.
        details: what else is known of the channel.
        t0_s: where row 0 begins, s.
    """
    fits = [s for s in stretches if options.beta_high_hz < s[1] / 2]
    if not fits:
        return []
    found = band_rows(fits, rows, options.period_s, options.beta_low_hz, options.beta_high_hz, t0_s)
    said = {
        **details,
        "low_hz": options.beta_low_hz,
        "high_hz": options.beta_high_hz,
        "rates_hz": sorted({round(rate, 6) for _, rate, _ in fits}),
    }
    first = t0_s + options.period_s
    return [
        step_trace((stream, channel, unit), "time_domain", values, found.reached, options, {**said, "measure": measure}, first)
        for stream, unit, measure, values in beta_streams(found, options)
    ]


def beta_streams(found: BandRows, options: DecodeOptions) -> list[tuple[str, str, str, NDArray[np.float64]]]:
    """List (stream, unit, measure, values [rows]) of samples in uV: both measures, and the error of `beta` where a valid row is not
    whole."""
    valid = found.reached >= options.min_valid_fraction - 1e-9
    streams = [(stream, unit, str(measure), getattr(found, measure)) for stream, unit, measure in options.beta_streams]
    if np.any(found.rms_error[valid] > 0):
        errors = found.rms_error if options.beta_measure == "rms" else found.power_error
        streams.append((ERROR_STREAM, streams[0][1], f"standard error of {options.beta_measure}", errors))
    return streams


def channel_spectrum(stretches: Sequence[Stretch], channel: str) -> list[SpectrumLog]:
    """Estimate the channel's spectrum in uV2/Hz up to 100 Hz; empty where no stretch is long enough for one."""
    hz, density, seconds = spectrum(stretches)
    return [SpectrumLog(channel, "uV2/Hz", hz, density, round(seconds, 3))] if seconds else []
