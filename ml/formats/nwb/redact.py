"""Take identity out of an NWB file before it is stored: a fresh file is written of what may stay.

An attribute that is deleted stays in the free space of an HDF5 file, so nothing is changed in place.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np

from ml.formats.labs.events import labels_of
from ml.formats.labs.names import clean_label
from ml.formats.nwb.file import HINT, READ_ERRORS, child, open_nwb, text, texts
from ml.formats.nwb.series import Electrode, Objects, Series, find
from ml.formats.options import ArchiveLimits
from ml.formats.recording import UndecodableFile
from ml.formats.redaction_record import Redaction
from ml.formats.source import Source

DATE = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}:\d{2}(\.\d{1,9})?(Z|[+-]\d{2}:?\d{2})?")
DATES = ("session_start_time", "timestamps_reference_time")
REMOVED = "removed"
BLOCK = 8 << 20
"""Bytes that are copied at a time."""
HEAD = (
    "subject", "experimenter", "institution", "lab", "notes", "session_id", "experiment_description", "keywords", "protocol",
    "related_publications", "surgery", "pharmacology", "data_collection", "devices", "source_script", "stimulus", "virus", "slices",
)  # fmt: skip
"""Parts of `general` that a report names; others are counted."""


def redact_nwb(source: Source, target: Path, key: bytes, limits: ArchiveLimits | None = None) -> Redaction:
    """Write the file without identity; the same bytes in give the same bytes out.

    Raises:
        UndecodableFile: no NWB 2 file, damaged, or with its samples in another file; nothing is written then.
    """
    done = Redaction()
    try:
        with open_nwb(source) as file:
            objects = find(file)
            if not objects.series:
                said = objects.faults[0] if objects.faults else "no series of samples in here"
                raise UndecodableFile(said, "acquisition, processing and stimulus", HINT)
            most = limits or ArchiveLimits()
            total = sum(s.data.size * s.data.dtype.itemsize for s in objects.series)
            if total > most.total_bytes:
                what = f"its samples have {total / 1e6:.0f} MB, more than {most.total_bytes / 1e6:.0f} MB"
                raise UndecodableFile(what, "series", "Upload fewer sessions at once.")
            _account(file, objects, done)
            _write(target, file, objects, key, done)
    except READ_ERRORS as error:
        target.unlink(missing_ok=True)
        raise UndecodableFile("the HDF5 file is damaged: a part of it cannot be read", "file", HINT) from error
    except UndecodableFile:
        target.unlink(missing_ok=True)
        raise
    return done


def _account(file: Any, objects: Objects, account: Redaction) -> None:
    """Describe what does not stay."""
    general = child(file, "general")
    names = [n for n in (() if general is None else sorted(general)) if n != "extracellular_ephys"]
    known = [n for n in HEAD if n in names] + [n for n in ("identifier", "session_description") if texts(file, n) not in ([], [REMOVED])]
    others = len(set(names) - set(HEAD))
    if known or others:
        listed = ", ".join(known) or "fields"
        account.removed.append(f"of the head: {listed}{f' and {others} other fields' if others else ''}")
    account.removed.append("descriptions and comments of series, tables and devices, and identifiers of objects")
    account.flagged += objects.faults
    if objects.skipped:
        account.ignored.append(f"{objects.skipped} objects that are no samples: pictures, videos, spikes or unknown types")
    if objects.invalid:
        account.flagged.append(f"{len(objects.invalid)} spans that the file calls invalid are gaps")


def _write(target: Path, file: Any, objects: Objects, key: bytes, account: Redaction) -> None:
    """Write the fresh file."""
    import h5py

    with h5py.File(target, "w") as sink:
        _set_type(sink, "NWBFile", "")
        version = text(file.attrs.get("nwb_version"))
        sink.attrs["nwb_version"] = version if re.fullmatch(r"2(\.\d{1,3}){1,3}", version) else "2.0"
        for name in DATES:
            if (stated := texts(file, name)) and DATE.fullmatch(stated[0]):
                sink[name] = stated[0]
        sink["identifier"] = sink["session_description"] = REMOVED
        _electrodes(sink, objects.electrodes)
        unnamed = sum(not e.label for e in objects.electrodes)
        acquisition = sink.create_group("acquisition")
        for number, series in enumerate(objects.series, start=1):
            name, own = clean_label(series.name, "", number)
            unnamed += not own
            room = _set_type(acquisition.create_group(f"s{number:04d}"), "ProcessingModule", f"s{number}")
            _series(room, series, name if own else f"series {number}")
        if unnamed:
            account.removed.append(f"names of series and electrodes with words that are not on the lists ({unnamed}×)")
        intervals = sink.create_group("intervals")
        rows = [
            (m.t_s, m.t_s + m.duration_s if m.duration_s else np.nan, label)
            for m in objects.moments
            for label in labels_of(m.cells, {}, key)
        ]
        if rows:
            account.removed.append(f"words of events: amplitude, rate, pulse width, side, on and off, and numbers stay ({len(rows)} rows)")
            table = _table(intervals, "marks", [r[0] for r in rows], [r[1] for r in rows])
            table["label"] = np.array([r[2] for r in rows], dtype=h5py.string_dtype())
        if objects.invalid:
            _table(intervals, "invalid_times", [a for a, _ in objects.invalid], [b for _, b in objects.invalid])


def _set_type(group: Any, kind: str, place: str) -> Any:
    """Give a group its type, and an identifier that is made of its place alone."""
    group.attrs["neurodata_type"], group.attrs["namespace"] = kind, "core"
    group.attrs["object_id"] = str(uuid5(NAMESPACE_URL, f"betaloop/{place}"))
    return group


def _electrodes(sink: Any, electrodes: tuple[Electrode, ...]) -> None:
    import h5py

    table = _set_type(sink.create_group("general/extracellular_ephys/electrodes"), "DynamicTable", "electrodes")
    table["id"] = np.arange(len(electrodes))
    for name, values in (("label", [e.label for e in electrodes]), ("location", [e.place for e in electrodes])):
        table[name] = np.array(values, dtype=h5py.string_dtype())


def _table(parent: Any, name: str, begins: list[float], ends: list[float]) -> Any:
    table = _set_type(parent.create_group(name), "TimeIntervals", name)
    table["start_time"], table["stop_time"] = np.array(begins), np.array(ends)
    return table


def _series(room: Any, series: Series, name: str) -> None:
    """Copy one series: samples as they are, block by block, and what turns them into a unit."""
    group = _set_type(room.create_group(name), series.kind, f"{room.name}/{name}")
    data = _copy(group, "data", series.data)
    data.attrs["unit"], data.attrs["offset"], data.attrs["conversion"] = series.unit, series.offset, 1.0
    group["channel_conversion"] = np.array(series.scale)
    if series.electrodes:
        group["electrodes"] = np.array(series.electrodes)
    if series.stamps is not None:
        _copy(group, "timestamps", series.stamps)
    else:
        group["starting_time"] = series.start_s
        group["starting_time"].attrs["rate"] = series.rate_hz


def _copy(group: Any, name: str, source: Any) -> Any:
    packed = {"chunks": source.chunks, "compression": "gzip", "compression_opts": 1, "shuffle": True} if source.compression else {}
    out = group.create_dataset(name, shape=source.shape, dtype=source.dtype, **packed)
    step = max(1, BLOCK // max(1, source.dtype.itemsize * int(np.prod(source.shape[1:]))))
    if source.chunks:
        step = max(source.chunks[0], step // source.chunks[0] * source.chunks[0])
    for begin in range(0, source.shape[0], step):
        out[begin : begin + step] = source[begin : begin + step]
    return out
