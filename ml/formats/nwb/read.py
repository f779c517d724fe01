"""Reader of an NWB file without identity: conversion, offset and channel_conversion are applied, and times decide what is a gap."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from ml.formats.labs.build import recordings_of
from ml.formats.labs.content import Channel, Content, Course, Floats
from ml.formats.labs.marks import Mark
from ml.formats.labs.names import ChannelName
from ml.formats.labs.timing import Piece, Timing, of_pieces, only
from ml.formats.nwb.file import open_nwb, texts
from ml.formats.nwb.series import Objects, Series, find
from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, FileReport
from ml.formats.source import Source

SAME_RATE = 1e-7
"""Series of one stream differ by no more than this share of their rate."""
Part = tuple[Timing, Series, Any]
"""A series with its times, and its samples, which are read at once."""


def decode_nwb(path: Path, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode an NWB file that `redact_nwb` wrote.

    Raises:
        UndecodableFile: no channel of a local field potential.
    """
    report = FileReport(name or path.name)
    return DecodedFile(recordings_of(read_nwb(path, report), options, report), (report,))


def read_nwb(source: Source, report: FileReport) -> Content:
    """Read channels, courses and marks; 0 is the reference time of the file."""
    content = Content("nwb")
    with open_nwb(source) as file:
        _start(file, content, report)
        objects = find(file)
        streams: dict[Any, list[Part]] = defaultdict(list)
        for series in objects.series:
            names = series.names(objects.electrodes)
            if all(n.kind == "other" for n, _ in names):
                continue
            if series.stamps is not None and names[0][0].kind == "stimulation" and not _regular(series):
                _add_course(content, series, names)
                continue
            try:
                timing = series.timing()
            except ValueError as error:
                report.flagged.append(f"{names[0][1]}: {error}; left out")
                continue
            data = series.data[...]
            timing = _exclude_lost(timing, data, objects)
            if timing.pieces:
                streams[tuple(shown for _, shown in names), series.kind].append((timing, series, data))
        _add_streams(content, streams, objects)
    for moment in objects.moments:
        content.marks.append(Mark(moment.t_s, moment.cells["label"], moment.duration_s, moment.duration_s is not None))
    return content


def _start(file: Any, content: Content, report: FileReport) -> None:
    """Read the reference time, which is that of the session's start where the file has no other."""
    for name in ("timestamps_reference_time", "session_start_time"):
        for stated in texts(file, name):
            try:
                date = datetime.fromisoformat(stated)
            except ValueError:
                continue
            offset = date.utcoffset()
            content.started, content.clock_known = (0.0, date), offset is not None
            content.utc_offset_h = None if offset is None else offset.total_seconds() / 3600
            return
    report.flagged.append("the file has no date: state the start with the upload")


def _exclude_lost(timing: Timing, data: Any, objects: Objects) -> Timing:
    """Take out of a stream the spans that the file calls invalid, and samples that are no number in every channel."""
    good = np.ones(data.shape[0], dtype=bool)
    if data.dtype.kind == "f":
        good = np.isfinite(data) if data.ndim == 1 else np.isfinite(data).any(axis=1)
    for begin, end in objects.invalid:
        for p in timing.pieces:
            first, last = (p.begin + math.ceil((t - p.start_s) * timing.rate_hz - 1e-6) for t in (begin, end))
            good[max(first, p.begin) : max(p.begin, min(last, p.end))] = False
    return timing if good.all() else only(timing, good)


def _regular(series: Series) -> bool:
    """Decide whether times are those of a regular signal: nine of ten steps are the usual one."""
    steps = np.diff(np.asarray(series.stamps[:], dtype=np.float64))
    usual = float(np.median(steps)) if steps.size else 0.0
    return bool(steps.size > 10 and usual > 0 and np.mean(np.abs(steps - usual) < 0.05 * usual) > 0.9)


def _add_course(content: Content, series: Series, names: list[tuple[ChannelName, str]]) -> None:
    t_s: Floats = np.asarray(series.stamps[:], dtype=np.float64)
    order = np.argsort(t_s, kind="stable")
    for i, (name, shown) in enumerate(names):
        values = _reader([(np.atleast_2d(series.data[...].T).T, series)], i)()
        content.courses.append(Course(name, shown, series.unit, t_s[order], values[order]))


def _add_streams(content: Content, streams: dict[Any, list[Part]], objects: Objects) -> None:
    """Add channels. Series of the same channels, unit and rate that follow each other are one stream with gaps."""
    group = 0
    for parts in streams.values():
        waiting = sorted(parts, key=lambda part: part[0].span_s)
        while waiting:
            chain: list[Part] = [waiting[0]]
            rest: list[Part] = []
            for part in waiting[1:]:
                before, timing = chain[-1][0], part[0]
                follows = timing.span_s[0] >= before.span_s[1] - 0.5 / before.rate_hz
                same = abs(timing.rate_hz / before.rate_hz - 1) <= SAME_RATE and part[1].unit == chain[0][1].unit
                (chain if follows and same else rest).append(part)
            waiting = rest
            _add_channels(content, chain, objects, group)
            group += 1


def _add_channels(content: Content, chain: list[Part], objects: Objects, group: int) -> None:
    """Add the channels of one stream."""
    pieces, at = [], 0
    for timing, series, _ in chain:
        pieces += [Piece(at + p.begin, at + p.end, p.start_s) for p in timing.pieces]
        at += int(series.data.shape[0])
    first = chain[0][0]
    timing = first if len(chain) == 1 else of_pieces(pieces, first.rate_hz)
    raw = [(data if data.ndim == 2 else data[:, None], series) for _, series, data in chain]
    for i, (name, shown) in enumerate(chain[0][1].names(objects.electrodes)):
        content.channels.append(Channel(name, shown, chain[0][1].unit, timing, _reader(raw, i), group))


def _reader(parts: list[tuple[Any, Series]], i: int) -> Callable[[], Floats]:
    """Make the function that gives the samples of a channel in its unit."""

    def read() -> Floats:
        values = []
        for data, series in parts:
            x = data[:, i].astype(np.float64)
            x *= series.scale[i]
            if series.offset:
                x += series.offset
            values.append(x)
        return values[0] if len(values) == 1 else np.concatenate(values)

    return read
