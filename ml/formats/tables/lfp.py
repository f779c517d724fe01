"""Tables of raw LFP: `t_s`, `lfp` in a stated unit, and an amplitude where there is one. The session starts at `t_s` 0.

The sampling rate is what the times say. Missing rows are gaps, which are never bridged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ml.formats.beta import FLAT_S, LARGEST_UV, channel_spectrum, flat_runs, living, step_trace, time_domain_traces
from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, FileReport, RecordingLog, SampleLog, TraceLog, UndecodableFile, fingerprint
from ml.formats.tables.amplitudes import checked_amplitude, compare_amplitudes
from ml.formats.tables.cells.fills import without_fills
from ml.formats.tables.cells.numbers import known_unit
from ml.formats.tables.columns import LFP_SCALE, TIME_SCALE, Columns, check_reach
from ml.signals import BRIDGE_S, Stretch, row_means, step_means

GAP = 1.5
"""Two rows further apart than this many samples have a gap between them."""

SPARSE = 0.5
"""An amplitude in fewer rows than this share comes at its own, slower rate, as in tables that join streams of one device."""

LONGEST_HOLD = 3.0
"""After so many of its usual intervals without a new value the amplitude is unknown, as in the device's own log."""

ROUND_RATE = 0.002
"""A rate this close to a whole number of Hz is that number: times are written with few decimals."""

MAX_JITTER = 0.5
"""Samples may be this share of their distance away from an even clock; more is no evenly sampled signal."""

DOUBLE = 2.5
LEAST_DOUBLES = 12
EVENLY = 0.5
"""Steps of two grains repeat evenly where their distances vary by less than this share; lost samples vary by about their mean."""

COARSE_SPREAD = 1.25
"""An even clock rounded to grains strays by one of them, and a little more for the last digit."""

NO_CLOCK = 10.0
"""Times that stray this many steps from an even clock are uneven, or lack samples. They are not coarse."""

RATE_ROWS = 128
RATE_CHANGE = 0.02
"""So many samples cannot differ by more from the mean rate, for rounded times move their ends by half a sample at most."""

MIN_ROWS = 8
LARGEST_RATE_HZ = 100_000.0
MOST_SAMPLES = 64_000_000
"""No amplifier is faster, and no table is laid out over more samples with short gaps filled: memory follows no number in a file."""


def decode_lfp(columns: Columns, options: DecodeOptions, report: FileReport) -> DecodedFile:
    """Decode a recording from the columns of raw LFP.

    Raises:
        UndecodableFile: no unit, times that do not increase or are not even, a rate too low for the band, impossible values.
    """
    t_s = _times(columns)
    unit = columns.units["lfp"] or known_unit(options.table_lfp_unit or "")
    if unit not in LFP_SCALE:
        hint = "Write the unit into the header, lfp [uV], or state it with the upload."
        raise columns.error("the lfp column states no unit", "lfp", hint)
    lfp = without_fills("lfp", columns.values["lfp"], columns.lines, report) * LFP_SCALE[unit]
    if (absurd := np.flatnonzero(np.abs(lfp) > LARGEST_UV)).size:
        what = f"{lfp[absurd[0]]:g} uV, more than any electrode in a brain gives"
        raise columns.error(what, "lfp", "Check the unit of the lfp column.", int(absurd[0]))
    if lost := int(np.sum(np.isnan(columns.values["lfp"]))):
        report.flagged.append(f"{lost} rows without a number in lfp: gaps")
    rate, cuts = _rate(t_s, columns, report)
    if options.beta_high_hz >= rate / 2:
        what = f"sampled at {rate:g} Hz, too slowly for a band up to {options.beta_high_hz:g} Hz"
        raise columns.error(what, "t_s", "Upload the signal as it was recorded, or state a lower band in the participant's settings.")
    period = options.period_s
    # a sample at 0 belongs to the first step, unless there are samples before it
    first = 1 if t_s[0] > -0.5 / rate else int(np.ceil(t_s[0] / period - 1e-9))
    t0_s, rows = (first - 1) * period, int(np.ceil(t_s[-1] / period - 1e-9)) - first + 1
    stretches = _stretches(t_s, lfp, rate, cuts)
    if flat := sum(end - begin for begin, end in flat_runs(lfp, rate)):
        report.flagged.append(f"{flat} rows of lfp stand still for {FLAT_S:g} s or longer, as no electrode does: gaps")
    details = {"column": columns.label("lfp"), "unit_from": "header" if columns.units["lfp"] else "options"}
    traces = time_domain_traces(stretches, "lfp", rows, options, details, t0_s)
    traces += _amplitude(columns, t_s, rate, rows, t0_s, options, report)
    if len(traces) == 2:
        report.flagged.append("no amplitude in the table: no policy can learn from this session until one is known")
    seconds = sum(x.size for _, _, x in stretches) / rate
    report.understood.append(
        f"raw LFP in {unit} at {rate:g} Hz: {t_s.size} samples, {seconds:.1f} s of signal, {rows} steps of {period:g} s"
    )
    recording = RecordingLog(
        kind="table",
        device_key=None,
        hemisphere=None,
        clock="table",
        started_at=None,
        duration_s=float((first + rows - 1) * period) if rows else 0.0,
        traces=tuple(traces),
        events=(),
        limits={},
        settings={"period_s": period, "rate_hz": rate},
        quality={f"{t.stream}.{t.channel}": {"valid_fraction": round(float(t.valid.mean()), 6)} for t in traces},
        fingerprint=fingerprint("lfp table", [t_s, lfp, *(t.values for t in traces if t.stream == "amplitude")]),
        spectra=tuple(channel_spectrum(stretches, "lfp")),
        samples=(SampleLog.of("lfp", "uV", stretches),) if options.keep_samples else (),
    )
    return DecodedFile((recording,), (report,))


def _times(columns: Columns) -> NDArray[np.float64]:
    """Read times in s, checked to be there and to increase."""
    t_s = columns.values["t_s"] * TIME_SCALE[columns.units["t_s"]]
    if t_s.size < MIN_ROWS:
        raise UndecodableFile(f"{t_s.size} rows are no signal", "after line 1", "Add one row per sample.")
    if (empty := np.flatnonzero(np.isnan(t_s))).size:
        raise columns.error("a row has no time", "t_s", "Give every row its t_s.", int(empty[0]))
    if (back := np.flatnonzero(np.diff(t_s) <= 0)).size:
        i = int(back[0]) + 1
        what = f"times must increase: {t_s[i]:g} s comes after {t_s[i - 1]:g} s"
        raise columns.error(what, "t_s", "Sort the rows; write the times with enough decimals to distinguish samples.", i)
    check_reach(t_s, columns)
    if t_s[-1] <= 0:
        raise columns.error("no row with t_s > 0", "t_s", "The session starts at 0; rows before it are its lead.")
    return t_s


def _rate(t_s: NDArray[np.float64], columns: Columns, report: FileReport) -> tuple[float, NDArray[np.int64]]:
    """Compute samples per second, and the rows before which a gap ends. Reports gaps and jitter; raises where the times are not even."""
    steps = np.diff(t_s)
    usual = float(np.median(steps))
    inside = steps <= GAP * usual
    # the median suffers from rounded times, the mean does not
    usual = float(steps[inside].mean())
    inside = steps <= GAP * usual
    if (even := _coarse_clock(t_s, usual, columns)) is not None:
        usual, inside = even
        report.flagged.append(f"the times are coarse: the rate is that of all {t_s.size} samples between the first and the last time")
    rate = 1.0 / usual
    if abs(rate - round(rate)) <= ROUND_RATE * rate and round(rate) > 0:
        rate = float(round(rate))
    bridged = float(steps[steps <= BRIDGE_S].sum()) * rate
    if rate > LARGEST_RATE_HZ or bridged > MOST_SAMPLES:
        what = f"the times say {rate:.3g} samples a second" + (f" and {bridged:.3g} samples in all" if rate <= LARGEST_RATE_HZ else "")
        raise columns.error(what, "t_s", "Give the times in seconds, one row per sample.")
    uneven = np.abs(steps - usual) > MAX_JITTER * usual
    off = inside & uneven & (even is None)
    if off.sum() > 0.01 * steps.size:
        i = int(np.flatnonzero(off)[0]) + 1
        what = f"times are not evenly spaced: {steps[i - 1]:g} s here, {usual:g} s on average"
        raise columns.error(what, "t_s", "Write the times with enough decimals, one row per sample.", i)
    _refuse_two_rates(t_s, usual, inside, columns)
    cuts = np.flatnonzero(~inside) + 1
    missing = int(np.rint(steps[~inside] * rate - 1).sum())
    if cuts.size:
        share = 100 * missing / (missing + t_s.size)
        report.flagged.append(f"{cuts.size} gap{'s' if cuts.size > 1 else ''} in the times: {missing} samples ({share:.1f} %) are missing")
    jitter = float(np.max(np.abs(steps[inside] - usual), initial=0.0))
    if even is None and jitter > 0.1 * usual:
        report.flagged.append(f"the times jitter by up to {1000 * jitter:.3g} ms around an even clock of {rate:g} Hz")
    return rate, cuts


def _refuse_two_rates(t_s: NDArray[np.float64], usual: float, inside: NDArray[np.bool_], columns: Columns) -> None:
    """Raise UndecodableFile where a stretch of `RATE_ROWS` samples without a gap has another rate than the whole."""
    cut = np.concatenate(([0], np.cumsum(~inside)))
    first = np.arange(0, t_s.size - RATE_ROWS, RATE_ROWS)
    first = first[cut[first] == cut[first + RATE_ROWS]]
    every = (t_s[first + RATE_ROWS] - t_s[first]) / RATE_ROWS
    other = np.flatnonzero(np.abs(every - usual) > RATE_CHANGE * usual)
    if other.size:
        i = int(other[0])
        what = f"the sampling rate changes: {1 / every[i]:.4g} Hz here, {1 / usual:.4g} Hz on average"
        raise columns.error(what, "t_s", "Upload each part with one rate as a table of its own.", int(first[i]))


def _coarse_clock(t_s: NDArray[np.float64], usual: float, columns: Columns) -> tuple[float, NDArray[np.bool_]] | None:
    """Find the sampling interval in s where times are no finer than it, and the steps without a gap, [n - 1]; None for finer times.

    Times in single precision step by one grain or by two, in turns that repeat. Lost samples come at random. So where steps of two grains
    repeat evenly, none is missing: the interval is (last - first) / (n - 1).

    Raises:
        UndecodableFile: the even clock behind the grains does not fit all times, or gives no whole rate.
    """
    steps = np.diff(t_s)
    double = np.flatnonzero((steps > GAP * usual) & (steps < DOUBLE * usual))
    between = np.diff(double)
    if double.size < LEAST_DOUBLES or double.size < ROUND_RATE * steps.size or between.std() > EVENLY * between.mean():
        return None
    inside = steps < DOUBLE * usual
    edges = np.concatenate(([0], np.flatnonzero(~inside) + 1, [t_s.size]))
    counts = np.diff(edges) - 1
    interval = float((t_s[edges[1:] - 1] - t_s[edges[:-1]]).sum() / counts.sum())
    pairs = zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    spread = max(float(np.ptp(t_s[a:b] - interval * np.arange(b - a))) for a, b in pairs)
    rate = 1.0 / interval
    if spread > NO_CLOCK * usual:
        return None
    if spread > COARSE_SPREAD * usual or abs(rate - round(rate)) > ROUND_RATE * rate:
        what = f"the times are too coarse: they step by {1000 * usual:.3g} ms, which does not tell the rate nor whether a sample is missing"
        hint = "Write the times with more digits, such as seconds from the session's start with six decimals, not in single precision."
        raise columns.error(what, "t_s", hint, int(double[0]) + 1)
    return interval, inside


def _stretches(t_s: NDArray[np.float64], lfp: NDArray[np.float64], rate: float, cuts: NDArray[np.int64]) -> list[Stretch]:
    """List gap-free pieces; rows without a number are gaps too."""
    good = living(lfp, rate)
    edges = np.concatenate(([0], cuts, np.flatnonzero(np.diff(good.astype(np.int8))) + 1, [lfp.size]))
    edges = np.unique(edges)
    pairs = zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    return [(float(t_s[begin]), rate, lfp[begin:end]) for begin, end in pairs if good[begin]]


def _amplitude(
    columns: Columns, t_s: NDArray[np.float64], rate: float, rows: int, t0_s: float, options: DecodeOptions, report: FileReport
) -> list[TraceLog]:  # fmt: skip
    """Average the amplitude column per step."""
    given = {role: checked_amplitude(role, columns, report) for role in columns.values if role.startswith("amplitude")}
    if len(given) == 2:
        compare_amplitudes(given["amplitude_ma"], given.pop("amplitude_fraction"), report)
    out = []
    for role, values in given.items():
        known = np.flatnonzero(np.isfinite(values))
        if 1 < known.size < SPARSE * values.size:
            means, covered = _sparse_means(t_s[known] - t0_s, values[known], rows, options.period_s)
            report.flagged[:] = [text for text in report.flagged if not text.endswith(f"without a number in {role}: kept as gaps")]
            every, longest = f"once in {round(values.size / known.size)} rows", f"{LONGEST_HOLD:g} intervals at most"
            report.understood.append(f"{role} is given {every}: each value counts until the next, {longest}")
        else:
            means, covered = row_means(np.maximum(t_s - t0_s, 0.0), values, np.full(t_s.size, 1.0 / rate), rows, options.period_s)
        unit = "mA" if role == "amplitude_ma" else "fraction"
        details = {"column": columns.label(role)}
        out.append(step_trace(("amplitude", role, unit), "table", means, covered, options, details, t0_s + options.period_s))
    return out


def _sparse_means(t_s: NDArray[np.float64], values: NDArray[np.float64], rows: int, period_s: float) -> tuple[NDArray[np.float64], ...]:
    """Average per step values that each count from their time to the next one's; also compute the known share of each step.

    Args:
        t_s: of the values, from the first step's begin on, [n], n > 1. values: mA or fractions, [n], none missing.
    """
    steps = np.diff(t_s, append=np.inf)
    usual = float(np.median(steps[:-1]))
    silent = np.flatnonzero(steps > LONGEST_HOLD * usual)
    times = np.concatenate((t_s, t_s[silent] + usual))
    levels = np.concatenate((values, np.full(silent.size, np.nan)))
    order = np.argsort(times, kind="stable")
    return step_means(times[order], levels[order], float(times.max()), rows, period_s)
