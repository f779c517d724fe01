"""Series of samples, marks and spans of an NWB file. Source: NWB 2 schema, nwb-schema.readthedocs.io.

Samples are `data * conversion * channel_conversion + offset`, in the unit of `data`; libraries give the raw numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.labs.names import ChannelName, channel_name, clean_unit
from ml.formats.labs.timing import Timing, even, of_stamps
from ml.formats.nwb.file import child, number, numbers, text, texts
from ml.formats.nwb.places import LABELS, electrode_name, kept_label, place_of
from ml.formats.recording import UndecodableFile

Floats = NDArray[np.float64]
KINDS = ("ElectricalSeries", "TimeSeries", "SpatialSeries")
"""Types whose samples are read; samples of others are pictures, spikes, or of no known meaning."""
TABLES = ("TimeIntervals", "EventsTable")
ROOMS = ("acquisition", "processing", "stimulus/presentation", "intervals", "events")
INVALID = "invalid_times"
UNITS = {"amperes": "A", "ampere": "A", "amps": "A", "meters/second^2": "m/s2", "m/s/s": "m/s2"}
MOST_OBJECTS = 5_000
MOST_CHANNELS = 1024
_DEPTH = 8


@dataclass(frozen=True, slots=True)
class Electrode:
    """Row of the table of electrodes, with what may stay: its label and its place."""

    label: str
    place: str


@dataclass(frozen=True, slots=True)
class Series:
    """One series of samples, unread.

    Attributes:
        group: of the file. kind: its type. data: dataset [n] or [n, channels].
        electrodes: rows of the table, one per channel; empty where it has none.
        scale: of each channel, [channels]; samples are raw * scale + offset, in `unit`.
        stamps: dataset of times, s, [n]; None where `rate_hz` and `start_s` say when the samples were.
    """

    group: Any
    kind: str
    data: Any
    electrodes: tuple[int, ...]
    unit: str
    scale: tuple[float, ...]
    offset: float
    stamps: Any
    rate_hz: float
    start_s: float

    @property
    def name(self) -> str:
        """Name within its group."""
        return str(self.group.name).rsplit("/", 1)[-1]

    @property
    def channels(self) -> int:
        """Number of channels."""
        return 1 if self.data.ndim == 1 else int(self.data.shape[1])

    def timing(self) -> Timing:
        """Find the gap-free pieces. Raises ValueError where the times make no signal."""
        n = int(self.data.shape[0])
        if self.stamps is None:
            return even(n, self.rate_hz, self.start_s)
        t_s: Floats = np.asarray(self.stamps[:], dtype=np.float64)
        steps = np.diff(t_s)
        usual = float(np.median(steps)) if steps.size else 0.0
        if not usual > 0:
            raise ValueError("times that do not rise")
        return of_stamps(t_s, 1.0 / usual)

    def names(self, table: tuple[Electrode, ...]) -> list[tuple[ChannelName, str]]:
        """Read the name of each channel, with its name for people."""
        if self.electrodes:
            return [electrode_name(table[i].label, table[i].place, i) for i in self.electrodes]
        # a plain series is one of a local field potential only where its name says so
        of_type = "seeg" if self.kind == "ElectricalSeries" else "trig"
        named = channel_name(self.name, of_type)
        if self.channels == 1:
            return [(named, named.text or self.name)]
        out = []
        for i in range(self.channels):
            shown = f"{named.text or self.name} ({i + 1})"
            out.append((ChannelName(shown if named.text else "", named.kind, named.side, named.target, ()), shown))
        return out


@dataclass(frozen=True, slots=True)
class Moment:
    """Row of a table of events, or an annotation: `cells` are its texts by column; `duration_s` is None for one of a moment."""

    t_s: float
    duration_s: float | None
    cells: dict[str, str]


@dataclass(slots=True)
class Objects:
    """Everything of a file that is read.

    Attributes:
        invalid: spans that the file calls invalid, s. skipped: number of objects that are not read.
        faults: sentences about series that are not read though they should be.
    """

    electrodes: tuple[Electrode, ...] = ()
    series: list[Series] = field(default_factory=list)
    moments: list[Moment] = field(default_factory=list)
    invalid: list[tuple[float, float]] = field(default_factory=list)
    skipped: int = 0
    faults: list[str] = field(default_factory=list)


def find(file: Any) -> Objects:
    """Find all that is read of a file. Raises UndecodableFile where samples are in another file."""
    objects = Objects(_electrodes(file))
    for group in _objects(file):
        kind = text(group.attrs.get("neurodata_type"))
        if kind in KINDS:
            _take_series(group, kind, objects)
        elif kind == "AnnotationSeries":
            _take_annotations(group, objects)
        elif kind in TABLES:
            _take_table(group, objects)
        elif group.get("data", getlink=True) is not None or kind in ("Units", "Images"):
            objects.skipped += 1
    return objects


def _objects(file: Any) -> Iterator[Any]:
    """Yield the groups of the rooms that are looked at, in the order of their names; none twice."""
    import h5py

    seen: set[Any] = set()
    for room in ROOMS:
        start = file
        for part in room.split("/"):
            start = child(start, part) if isinstance(start, h5py.Group) else None
        waiting = [(start, 0)] if isinstance(start, h5py.Group) else []
        while waiting:
            group, depth = waiting.pop()
            key = h5py.h5o.get_info(group.id).addr
            if key in seen:
                continue
            seen.add(key)
            if len(seen) > MOST_OBJECTS:
                what = f"the file has more than {MOST_OBJECTS} objects"
                raise UndecodableFile(what, "file", "Send one session per file, without sorted units or pictures.")
            if depth:
                yield group
            if depth < _DEPTH:
                waiting += [(m, depth + 1) for name in sorted(group, reverse=True) if isinstance(m := child(group, name), h5py.Group)]


def _electrodes(file: Any) -> tuple[Electrode, ...]:
    """Read the table of electrodes."""
    table = file
    for part in ("general", "extracellular_ephys", "electrodes"):
        table = child(table, part) if table is not None else None
    if table is None:
        return ()
    columns = {name: texts(table, name) for name in ("location", "group_name", *LABELS)}
    ids = numbers(table, "id")
    count = max([0 if ids is None else int(ids.size), *map(len, columns.values())])
    label = next((columns[name] for name in LABELS if len(columns[name]) == count), [""] * count)
    places = [columns[name] if len(columns[name]) == count else [""] * count for name in ("location", "group_name")]
    return tuple(
        Electrode(kept_label(own, i), place_of(where) or place_of(group))
        for i, (own, where, group) in enumerate(zip(label, *places, strict=True))
    )  # fmt: skip


def _take_series(group: Any, kind: str, objects: Objects) -> None:
    """Add a series; one that contradicts itself is a fault."""
    data = numbers(group, "data")
    place = f"series {len(objects.series) + len(objects.faults) + 1}"
    if data is None or data.ndim not in (1, 2) or not data.size:
        objects.skipped += 1
        return
    n, channels = int(data.shape[0]), 1 if data.ndim == 1 else int(data.shape[1])
    stamps, start = numbers(group, "timestamps"), numbers(group, "starting_time")
    rate = number(start.attrs.get("rate"), 0.0) if start is not None else 0.0
    if stamps is None and not rate > 0:
        objects.faults.append(f"{place}: it has neither timestamps nor starting_time and rate; excluded")
    elif stamps is not None and stamps.shape != (n,):
        objects.faults.append(f"{place}: it has {n} samples and {stamps.size} timestamps; excluded. Are its axes exchanged?")
    elif channels > MOST_CHANNELS:
        objects.faults.append(f"{place}: it has {channels} channels of {n} samples; excluded. Are its axes exchanged?")
    else:
        rows = _rows(group, channels, len(objects.electrodes), place, objects)
        per_channel = numbers(group, "channel_conversion")
        if per_channel is not None and per_channel.shape != (channels,):
            objects.faults.append(f"{place}: channel_conversion has {per_channel.size} numbers for {channels} channels; excluded")
            return
        factors = np.ones(channels) if per_channel is None else np.asarray(per_channel[:], dtype=np.float64)
        scale = number(data.attrs.get("conversion"), 1.0) * factors
        offset = number(data.attrs.get("offset"), 0.0)
        stated = text(data.attrs.get("unit")).strip()
        unit = clean_unit(UNITS.get(stated.lower(), stated))
        begin = float(start[()]) if stamps is None else 0.0
        if not np.all(np.isfinite([*scale, begin])) or not np.all(scale):
            objects.faults.append(f"{place}: its conversion or starting_time is no number, or zero; excluded")
            return
        objects.series.append(Series(group, kind, data, rows, unit, tuple(scale.tolist()), offset, stamps, rate, begin))


def _rows(group: Any, channels: int, count: int, place: str, objects: Objects) -> tuple[int, ...]:
    """Read which electrodes a series names; empty where it names none, or not one per channel."""
    rows = numbers(group, "electrodes")
    if rows is None:
        return ()
    listed = [int(i) for i in np.atleast_1d(rows[()]).tolist()]
    if len(listed) != channels or any(not 0 <= i < count for i in listed):
        objects.faults.append(f"{place}: it names {len(listed)} electrodes for {channels} channels: their places are unknown")
        return ()
    return tuple(listed)


def _take_annotations(group: Any, objects: Objects) -> None:
    words, stamps = texts(group, "data"), numbers(group, "timestamps")
    if stamps is None or stamps.size != len(words):
        objects.faults.append("annotations without their times: excluded")
        return
    objects.moments += [Moment(t, None, {"label": w}) for t, w in zip(np.asarray(stamps[:], dtype=float).tolist(), words, strict=True)]


def _take_table(group: Any, objects: Objects) -> None:
    """Add the rows of a table of intervals or events; a column of lists is not read."""
    begins = numbers(group, "start_time") if child(group, "start_time") is not None else numbers(group, "timestamp")
    if begins is None:
        return
    t_s: Floats = np.asarray(begins[:], dtype=np.float64).ravel()
    ends, lengths = numbers(group, "stop_time"), numbers(group, "duration")
    span: Floats = np.full(t_s.size, np.nan)
    if ends is not None and ends.shape == t_s.shape:
        span = np.asarray(ends[:], dtype=np.float64) - t_s
    elif lengths is not None and lengths.shape == t_s.shape:
        span = np.asarray(lengths[:], dtype=np.float64)
    if str(group.name).rsplit("/", 1)[-1] == INVALID:
        objects.invalid += [(t, t + s) for t, s in zip(t_s.tolist(), span.tolist(), strict=True) if s > 0 and np.isfinite(t)]
        return
    columns: dict[str, list[str]] = {}
    for name in sorted(group):
        if name in ("start_time", "stop_time", "timestamp", "duration", "id") or name.endswith("_index") or f"{name}_index" in group:
            continue
        values = numbers(group, name)
        cells = texts(group, name) if values is None else [] if values.shape != t_s.shape else [f"{v:.9g}" for v in values[:].tolist()]
        if len(cells) == t_s.size:
            columns[name] = cells
    for i, (t, s) in enumerate(zip(t_s.tolist(), span.tolist(), strict=True)):
        if np.isfinite(t):
            objects.moments.append(Moment(t, s if s > 0 else None, {name: cells[i] for name, cells in columns.items()}))
