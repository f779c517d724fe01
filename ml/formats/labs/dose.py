"""Amplitude of a lab's recording: from a channel in mA, and from what marks state. Unknown where neither states it, or both differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.beta import step_trace
from ml.formats.disagreements import CONFLICTS, disagreements_of_rows
from ml.formats.dose import LIMIT_TOLERANCE_MA, UPPER_PLAUSIBLE_MA
from ml.formats.labs.content import Channel, Content
from ml.formats.labs.marks import Mark
from ml.formats.labs.names import MA
from ml.formats.options import DecodeOptions
from ml.formats.recording import FileReport, Hemisphere, TraceLog
from ml.signals import row_means, step_means

Floats = NDArray[np.float64]
Rows = tuple[Floats, Floats]
"""Mean amplitude per row, mA, [rows], NaN where unknown; and the known share of each row, [rows]."""

SAME_S = 1e-3
"""An end and the next begin that are no further apart are one moment, as texts round both."""
WAVEFORM = 0.05
"""A channel that changes at more than this share of its samples shows the pulses, not the amplitude."""


def amplitude_traces(
    content: Content,
    origin_s: float,
    rows: int,
    side: Hemisphere | None,
    options: DecodeOptions,
    report: FileReport,
    quality: dict[str, Any],
) -> list[TraceLog]:
    """Make the amplitude trace of one side, where any source states an amplitude.

    Args:
        origin_s: begin of row 0 on the file's clock.
        side: whose amplitude; a source that names no side counts for both.
        quality: takes `amplitude_conflicts`.
    """
    sources: list[tuple[str, Rows]] = []
    for channel in content.channels:
        if (
            channel.name.kind == "stimulation"
            and channel.name.side in (None, side)
            and (found := _of_channel(channel, origin_s, rows, options, report))
        ):
            sources.append((channel.shown, found))
    for course in content.courses:
        if course.name.side in (None, side):
            if course.unit not in MA:
                report.flagged.append(_no_unit(course.shown, course.unit))
                continue
            end = content.cut_s if content.cut_s is not None else origin_s + rows * options.period_s
            t_s, values = course.t_s - origin_s, _plausible(course.values * MA[course.unit], course.shown, report)
            sources.append((course.shown, step_means(t_s, values, end - origin_s, rows, options.period_s)))
    stated = [m for m in content.marks if m.statement.mentions and m.statement.side in (None, side)]
    if stated:
        sources.append(("marks", _of_marks(content, stated, origin_s, rows, options, report)))
    if not sources:
        return []
    (name, (values, covered)), *others = sources
    for other, (values_2, covered_2) in others:
        both = np.isfinite(values) & np.isfinite(values_2)
        differ = both & (np.abs(values - values_2) > LIMIT_TOLERANCE_MA)
        steady = differ & (covered > 1 - 1e-9) & (covered_2 > 1 - 1e-9)
        if steady.any():
            said = disagreements_of_rows(steady, {name: values, other: values_2}, "amplitude_ma", 0.0, options.period_s)
            quality.setdefault(CONFLICTS, []).extend(said)
            report.flagged.append(f"{name} and {other} differ about the amplitude in {int(differ.sum())} steps, which are unknown there")
        covered = np.where(differ, 0.0, np.where(np.isfinite(values), covered, covered_2))
        values = np.where(differ, np.nan, np.where(np.isfinite(values), values, values_2))
        name = f"{name} and {other}"
    details = {"origin": name}
    return [step_trace(("amplitude", "amplitude_ma", "mA"), "device_log", values, covered, options, details)]


def _of_channel(channel: Channel, origin_s: float, rows: int, options: DecodeOptions, report: FileReport) -> Rows | None:
    """Average an amplitude channel per row; None, and a sentence, where it is no amplitude in a known unit."""
    if channel.unit not in MA:
        report.flagged.append(_no_unit(channel.shown, channel.unit))
        return None
    x = channel.read() * MA[channel.unit]
    moves = np.diff(x[np.isfinite(x)])
    if moves.size and float(np.mean(np.abs(moves) > LIMIT_TOLERANCE_MA)) > WAVEFORM:
        report.flagged.append(
            f"{channel.shown}: it changes from sample to sample, so it shows pulses and no amplitude: the amplitude is unknown"
        )
        return None
    x = _plausible(x, channel.shown, report)
    rate = channel.timing.rate_hz
    t_s = np.concatenate([p.start_s + np.arange(p.end - p.begin) / rate for p in channel.timing.pieces]) - origin_s
    values = np.concatenate([x[p.begin : p.end] for p in channel.timing.pieces])
    return row_means(t_s, values, np.full(t_s.size, 1.0 / rate), rows, options.period_s)


def _no_unit(label: str, unit: str) -> str:
    said = f"in {unit}, which is no current" if unit else "in no known unit"
    return f"{label}: an amplitude {said}, so the amplitude is unknown. Give the channel the unit mA in the recording software."


def _plausible(x: Floats, label: str, report: FileReport) -> Floats:
    wrong = (x < -LIMIT_TOLERANCE_MA) | (x >= UPPER_PLAUSIBLE_MA)
    if wrong.any():
        report.flagged.append(f"{label}: {int(wrong.sum())} amplitudes below 0 or above {UPPER_PLAUSIBLE_MA:g} mA are unknown")
    return np.where(wrong, np.nan, np.maximum(x, 0.0))


def _of_marks(
    content: Content, marks: Sequence[Mark], origin_s: float, rows: int, options: DecodeOptions, report: FileReport
) -> Rows:  # fmt: skip
    """Compute the amplitude that marks state. A mark of one moment holds until the next; one with a duration holds for that alone."""
    knots: list[tuple[float, int, float]] = []
    begins = np.array(sorted(m.t_s for m in marks))
    for mark in sorted(marks, key=lambda m: m.t_s):
        dose = mark.statement.dose_ma
        value = np.nan if dose is None or dose >= UPPER_PLAUSIBLE_MA else dose
        knots.append((mark.t_s, 2, value))
        if mark.duration_s:
            end = mark.t_s + mark.duration_s
            after = max(np.searchsorted(begins, end - SAME_S), np.searchsorted(begins, mark.t_s, "right"))
            if after == begins.size or begins[after] > end + SAME_S:
                knots.append((end, 1, np.nan))
    if content.marks_pause:
        # what was set while nothing was recorded is in no mark
        lasting = np.array([(m.t_s, m.t_s + m.duration_s) for m in marks if m.lasting and m.duration_s]).reshape(-1, 2)
        knots += [(at, 0, np.nan) for at, _ in _pauses(content) if not np.any((lasting[:, 0] <= at) & (at < lasting[:, 1]))]
    if content.cut_s is not None:
        knots.append((content.cut_s, 3, np.nan))
    knots.sort(key=lambda k: (k[0], k[1]))
    vague = sum(not m.statement.clear for m in marks)
    open_ = sum(m.statement.clear and m.statement.dose_ma is None for m in marks)
    if vague:
        report.flagged.append(
            f"{vague} markers speak of stimulation in words that betaloop does not know: the amplitude is unknown after them"
        )
    if open_:
        report.flagged.append(f"{open_} markers of stimulation state no amplitude in mA: the amplitude is unknown after them")
    at = np.array([k[0] for k in knots]) - origin_s
    values = np.array([k[2] for k in knots])
    same = np.flatnonzero((np.diff(at) == 0) & (np.diff(values) != 0) & np.isfinite(values[:-1]) & np.isfinite(values[1:]))
    values[same + 1] = np.nan
    return step_means(at, values, rows * options.period_s, rows, options.period_s)


def _pauses(content: Content) -> list[tuple[float, float]]:
    """List the times, s, in which no channel was recorded."""
    spans = sorted(
        (p.start_s, p.start_s + (p.end - p.begin) / c.timing.rate_hz) for c in content.channels for p in c.timing.pieces
    )  # fmt: skip
    out, until = [], -np.inf
    for begin, end in spans:
        if np.isfinite(until) and begin > until + 1e-3:
            out.append((until, begin))
        until = max(until, end)
    return out
