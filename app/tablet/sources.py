"""Sources of beta amplitudes for `betaloop control`: recordings, synthetic participants, standard input."""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterable
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.platform.errors import Invalid, NotFound
from app.tablet.simulated import Brain, brain_of
from ml.deploy.manifest import BundleManifest
from ml.deploy.runtime.envelope import BetaSample, Signal
from ml.deploy.runtime.protocol import number
from ml.deploy.streaming import StreamingBeta, split_by_period
from ml.formats import DecodeOptions, RecordingLog, TraceLog, UndecodableFile, decode, sniff
from ml.formats.tables.cells.delimited import read_delimited
from ml.formats.tables.cells.numbers import column_name, unit_name
from ml.signals import Stretch, band_rows

LFP_UNITS = {"uV": 1.0, "mV": 1000.0, "V": 1e6}


class Row(NamedTuple):
    """Arrival by the time of a decision: the time, the beta amplitude (None: nothing), microseconds that computing it took."""

    now_s: float
    sample: BetaSample | None
    signal_us: float = 0.0


Rows = Generator[Row, float, None]
"""Yields rows; is sent the amplitude (mA) that was decided on the last one."""


@dataclass
class Source:
    """One stream of beta amplitudes.

    Attributes:
        rows: to be run through once.
        description: of the source, for the summary.
        offline: P_beta of the same periods as computed afterwards, NaN where invalid; empty where there is nothing to compare.
        streamed: P_beta as it was known in time; grows while `rows` runs.
        participant: code of a synthetic participant; None where the source does not say whose it is.
    """

    rows: Rows
    description: str
    offline: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    streamed: list[float] = field(default_factory=list)
    participant: str | None = None


@dataclass(frozen=True, kw_only=True)
class Wish:
    """Request to a source.

    Attributes:
        channel: of a recording with several; the one with most valid periods when None.
        beta_source: how the beta amplitudes of a table were made; `table` when None.
        steps: length of a simulated session.
        realtime: decisions wait until they are due.
    """

    channel: str | None = None
    beta_source: str | None = None
    steps: int = 300
    realtime: bool = False


@dataclass(frozen=True, kw_only=True)
class Task:
    """Options of a run.

    Attributes:
        log: CSV to write, one row per decision; a session with a device side needs it.
        key: as `app.tablet.command.verified` takes it.
        participant: code that the bundle must be of.
        battery: JSON file with assumptions about the implant, as `read_implant` takes it.
        bench: without a participant, so that any bundle may run with a device side, and as often as wanted.
        ledger: folder of the runs of this tablet; the one in the home folder when None. withdrawn: the study's list of withdrawals.
        timed: so many decisions are timed first.
        begins: when a session on a simulated device begins, by the simulation's clock; now when None.
    """

    log: Path | None = None
    key: str | None = None
    participant: str | None = None
    battery: Path | None = None
    bench: bool = False
    ledger: Path | None = None
    withdrawn: Path | None = None
    timed: int = 0
    begins: datetime | None = None


def open_source(text: str, manifest: BundleManifest, wish: Wish, stdin: Iterable[str]) -> Source:
    """Open a source by its name.

    Args:
        text: a path (RC+S zip or folder, table of 2 s steps, table of `t_s, lfp`), `cohort:P1` or `cohort:P1:SEED`, or `-`.
        manifest: of the bundle: period, band, unit and source of its beta amplitudes.
        wish: what else was asked.
        stdin: lines of standard input.

    Raises:
        NotFound: no such file or participant. Invalid: nothing in it can be used.
    """
    if text == "-":
        return Source(_lines(stdin, manifest), "beta amplitudes from standard input, one per period")
    if text.startswith("cohort:"):
        return _cohort(text, manifest, wish.steps)
    path = Path(text)
    if not path.exists():
        raise NotFound(f"There is no file {path}.", "Name a recording, cohort:P1, or - for standard input.")
    try:
        if not path.is_dir() and sniff(path) == "csv" and (lfp := _lfp_columns(path)):
            return _raw(lfp, manifest, f"{path.name}, raw LFP")
        options = DecodeOptions(
            manifest.period_s,
            manifest.beta_low_hz,
            manifest.beta_high_hz,
            min_valid_fraction=manifest.min_valid_fraction,
            keep_samples=True,
        )
        return _recorded(path, options, manifest, wish)
    except UndecodableFile as error:
        raise Invalid(f"{path.name} cannot be used: {error.what} ({error.where}).", error.hint) from error


def _recorded(path: Path, options: DecodeOptions, manifest: BundleManifest, wish: Wish) -> Source:
    """Read the first recording of a file that has the bundle's kind of beta."""
    recordings = [r for r in decode(path, options=options).recordings if _same_side(r, manifest)]
    for recording in recordings:
        traces = [t for t in recording.traces if t.stream in ("beta", "band_power") and t.unit != "uV2"]
        sampled = {log.channel: log for log in recording.samples}
        measured = [t for t in traces if t.source == "time_domain" and t.channel in sampled]
        if measured and manifest.beta_source == "time_domain":
            trace = _chosen(measured, wish.channel)
            stretches = sampled[trace.channel].stretches()
            source = _raw(stretches, manifest, f"{path.name}, {trace.channel}, raw LFP", rows=trace.values.size)
            source.offline = _offline(stretches, manifest, trace.values.size)
            return source
        if traces:
            trace = _chosen([t for t in traces if t.source == manifest.beta_source] or traces, wish.channel)
            signal = Signal(trace.unit, wish.beta_source if wish.beta_source and trace.source == "table" else trace.source)
            return Source(_from_trace(trace, signal), f"{path.name}, {trace.channel or trace.stream}, one value per period as decoded")
    side = f" of the {manifest.hemisphere} hemisphere" if manifest.hemisphere else ""
    raise Invalid(
        f"{path.name} holds no beta amplitudes{side}.", "Name a recording with time-domain data, band power, or a table with beta."
    )


def _same_side(recording: RecordingLog, manifest: BundleManifest) -> bool:
    """Decide whether a recording can be of the bundle's hemisphere: one that names the other side never is."""
    return manifest.hemisphere is None or recording.hemisphere in (None, manifest.hemisphere)


def _chosen(traces: list[TraceLog], channel: str | None) -> TraceLog:
    if channel is None:
        return max(traces, key=lambda t: int(t.valid.sum()))
    named = [t for t in traces if t.channel == channel]
    if not named:
        raise NotFound(f"There is no channel '{channel}'.", f"Name one of: {', '.join(t.channel for t in traces)}.")
    return named[0]


def _from_trace(trace: TraceLog, signal: Signal) -> Rows:
    """Yield one value per period, known at its end; an invalid one comes as NaN."""
    for end_s, value, valid in zip(trace.t_end_s.tolist(), trace.values.tolist(), trace.valid.tolist(), strict=True):
        yield Row(end_s, BetaSample(end_s, value if valid else math.nan, signal))


def _lines(lines: Iterable[str], manifest: BundleManifest) -> Rows:
    """Read a line per period."""
    for k, line in enumerate(lines):
        now_s = k * manifest.period_s
        yield Row(now_s, _sample(line, now_s, manifest))


def _sample(line: str, now_s: float, manifest: BundleManifest) -> BetaSample | None:
    """Parse a number, taken to be of the bundle's unit and source; NaN where there is another text, nothing where the line is empty."""
    if not line.strip():
        return None
    return BetaSample(now_s, number(line.strip()), Signal(manifest.beta_unit, manifest.beta_source))


def _raw(stretches: list[Stretch], manifest: BundleManifest, description: str, rows: int | None = None) -> Source:
    """Compute P_beta in time from raw samples in uV."""
    end_s = max((start + x.size / rate for start, rate, x in stretches), default=0.0)
    count = math.ceil(end_s / manifest.period_s - 1e-9) if rows is None else rows
    if not stretches or count < 1:
        raise Invalid(f"{description}: there are no samples.", "Name another recording or channel.")
    streamed: list[float] = []
    offline = _offline(stretches, manifest, count)
    return Source(_stream(stretches, manifest, count, streamed), description, offline, streamed)


def _stream(stretches: list[Stretch], manifest: BundleManifest, count: int, streamed: list[float]) -> Rows:
    period = manifest.period_s
    signal = Signal("uV2" if manifest.beta_unit == "uV2" else "uV", "time_domain")
    beta = StreamingBeta(period, manifest.beta_low_hz, manifest.beta_high_hz, manifest.min_valid_fraction)
    for k, pieces in enumerate(split_by_period(stretches, period, count)):
        began = time.perf_counter_ns()
        for piece in pieces:
            beta.add(*piece)
        value = beta.value((k + 1) * period)
        streamed.append(value)
        used_us = (time.perf_counter_ns() - began) / 1000.0
        now_s = (k + 1) * period
        yield Row(now_s, BetaSample(now_s, value**2 if signal.unit == "uV2" else value, signal), used_us)


def _offline(stretches: list[Stretch], manifest: BundleManifest, rows: int) -> NDArray[np.float64]:
    found = band_rows(stretches, rows, manifest.period_s, manifest.beta_low_hz, manifest.beta_high_hz)
    return np.where(found.reached >= manifest.min_valid_fraction - 1e-9, found.rms, np.nan)


def _lfp_columns(path: Path) -> list[Stretch]:
    """Read gap-free stretches in uV of a table `t_s, lfp [unit]`; empty where the table is another.

    Raises:
        UndecodableFile: times that do not increase, or no known unit.
    """
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        if "lfp" not in stream.readline().lower():
            return []
    table = read_delimited(path, 2_000_000, "t_s and lfp [uV]")
    named = {column_name(header): i for i, header in enumerate(table.headers)}
    time_columns = [i for (name, _), i in named.items() if name in ("t_s", "t", "time_s", "time")]
    lfp = [(i, unit) for (name, unit), i in named.items() if name == "lfp"]
    if len(time_columns) != 1 or len(lfp) != 1:
        return []
    column, unit = lfp[0]
    known = unit_name(unit) if unit else "uV"
    if known not in LFP_UNITS:
        raise UndecodableFile(f"LFP in '{unit}'", "line 1, column lfp", f"Give it in one of {', '.join(LFP_UNITS)}.")
    decimal = table.decimal_mark([time_columns[0], column])
    t_s, values = table.numbers(time_columns[0], decimal), table.numbers(column, decimal) * LFP_UNITS[known]
    finite = np.isfinite(t_s) & np.isfinite(values)
    t_s, values = t_s[finite], values[finite]
    steps = np.diff(t_s)
    if t_s.size < 2 or np.any(steps <= 0):
        raise UndecodableFile("times that do not increase", "column t_s", "Sort the rows by time, each time once.")
    step = float(np.median(steps))
    cuts = (np.flatnonzero(steps > 1.5 * step) + 1).tolist()
    bounds = [0, *cuts, t_s.size]
    return [(float(t_s[a]), 1.0 / step, values[a:b]) for a, b in pairwise(bounds)]


def _cohort(text: str, manifest: BundleManifest, steps: int) -> Source:
    """Simulate a synthetic participant that answers to the amplitude: the loop is closed."""
    brain = brain_of(text.removeprefix("cohort:"), manifest, steps)
    return Source(_simulate(brain, manifest, steps), f"{brain.description}, closed loop of {steps} steps", participant=brain.participant)


def _simulate(brain: Brain, manifest: BundleManifest, steps: int) -> Rows:
    amplitude = manifest.cdbs_ma
    for k in range(1 - manifest.window, steps + 1):  # first the window before the session, recorded under cDBS
        now_s = k * manifest.period_s
        amplitude = yield Row(now_s, BetaSample(now_s, brain.beta(amplitude), brain.signal))
