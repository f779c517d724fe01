"""One signal of a session, as the writers of files take it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from app.ingest.uploads.compute import options_of
from app.platform.jobs import StepReport
from ml import formats
from ml.formats import SampleLog, UndecodableFile
from ml.sample_views import Stretch, pyramid, spectrogram

if TYPE_CHECKING:
    from pynwb import NWBFile


@dataclass(frozen=True)
class Signal:
    """One channel or trace of a session.

    Attributes:
        recording: its number. hemisphere: `left`, `right` or None. stream: `lfp`, or that of a trace. channel, unit: as stored.
        t_s: seconds from the session's start, [n]: of a sample, or the end of a trace's row.
        values: float32, [n]; NaN where a trace's row is invalid.
        rates_hz: rates of the samples; empty for traces.
        stretches: gap-free pieces of the samples, (first, end, rate in Hz) each; empty for traces.
    """

    recording: int
    hemisphere: str | None
    stream: str
    channel: str
    unit: str
    t_s: NDArray[np.float64]
    values: NDArray[np.float32]
    rates_hz: tuple[float, ...] = ()
    stretches: tuple[tuple[int, int, float], ...] = ()


# A session's signals as one Parquet table: a row per sample, a row group per channel.

_WORDS = pa.dictionary(pa.int32(), pa.string())
SCHEMA = pa.schema(
    [
        pa.field("recording", pa.int64()),
        pa.field("hemisphere", _WORDS),
        pa.field("stream", _WORDS),
        pa.field("channel", _WORDS),
        pa.field("unit", _WORDS),
        pa.field("t_s", pa.float64()),
        pa.field("value", pa.float32()),
    ]
)


def write_parquet(target: Path, signals: Sequence[Signal], about: Mapping[str, Any]) -> None:
    """Write the table; `about` is stored as JSON under the key `betaloop` of its schema. An invalid row of a trace is null."""
    said = {**about, "rates_hz": {f"{s.recording} {s.channel}": s.rates_hz for s in signals if s.rates_hz}}
    schema = SCHEMA.with_metadata({"betaloop": json.dumps(said)})
    with pq.ParquetWriter(target, schema, compression="zstd") as out:
        for s in signals:
            n = s.values.size
            words = [_repeated(word, n) for word in (s.hemisphere, s.stream, s.channel, s.unit)]
            values = pa.array(s.values, type=pa.float32(), from_pandas=True)  # NaN becomes null
            out.write_table(pa.table([pa.array([s.recording] * n, pa.int64()), *words, pa.array(s.t_s), values], schema=schema))


def _repeated(word: str | None, n: int) -> pa.DictionaryArray:
    indices = pa.nulls(n, pa.int32()) if word is None else pa.array(np.zeros(n, np.int32))
    return pa.DictionaryArray.from_arrays(indices, pa.array([] if word is None else [word], pa.string()))


# A session's signals as Neurodata Without Borders (NWB 2, HDF5). It needs the extra `nwb`.

UNITS = {"uV": ("volts", 1e-6), "mA": ("amperes", 1e-3)}
"""Unit and factor by which values become it, where NWB has an SI unit for them."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def write_nwb(target: Path, signals: Sequence[Signal], about: Mapping[str, Any]) -> None:
    """Write the file: samples as electrical series, traces as time series in the processing module `steps`.

    Sex and age of the subject are stated as unknown: `U`, and `P0D/`, which is any age. NWB wants a start time: it is the session's day
    since enrolment, counted from 1970-01-01, for no date leaves.
    """
    from pynwb import NWBHDF5IO, NWBFile  # an optional package, and half a second of imports: only where it is asked for
    from pynwb.file import Subject

    days = about["day"]
    content = NWBFile(
        session_description=f"Session {about['session']} of visit {about['visit']}: {about['controller'] or 'controller not stated'}. "
        + ("Its day is not known." if days is None else "The date is the day since enrolment, counted from 1970-01-01."),
        identifier=f"{about['participant']}-session-{about['session']}",
        session_start_time=EPOCH + timedelta(days=days or 0.0),
        session_id=str(about["session"]),
        notes=json.dumps(about),
        subject=Subject(subject_id=about["participant"], species="Homo sapiens", sex="U", age="P0D/"),
    )
    _samples(content, [s for s in signals if s.stream == "lfp"])
    _traces(content, [s for s in signals if s.stream != "lfp"])
    with NWBHDF5IO(target, "w") as out:
        out.write(content)


def _samples(content: NWBFile, signals: Sequence[Signal]) -> None:
    """Add each gap-free stretch as a series with its start and rate; times without samples are invalid times.

    Readers divide samples by the span for the rate, so that a gap within a series would move every frequency. Each stretch is a plain
    series too, since some readers take no electrical one.
    """
    from pynwb import TimeSeries
    from pynwb.ecephys import ElectricalSeries

    if not signals:
        return
    device = content.create_device(name="implanted neurostimulator", description="the device that recorded")
    groups = {
        side: content.create_electrode_group(
            name=f"{side} lead", description=f"contacts of the {side} side", location=f"{side} side; target not stated", device=device
        )
        for side in dict.fromkeys(s.hemisphere or "unknown" for s in signals)
    }
    plain = content.create_processing_module("lfp", "The samples of acquisition as plain time series, for readers without electrical ones.")
    for s in signals:
        group = groups[s.hemisphere or "unknown"]
        content.add_electrode(location=group.location, group=group, reference=f"bipolar: {s.channel}")
    for i, s in enumerate(signals):
        region = content.create_electrode_table_region([i], f"contacts of {s.channel}")
        for number, (first, end, rate_hz) in enumerate(s.stretches, start=1):
            values, name = s.values[first:end], f"{_name(s)} stretch {number}"
            about = f"recording {s.recording}, {s.channel}: no sample is lost within this stretch"
            times = {"starting_time": float(s.t_s[first]), "rate": rate_hz, "conversion": 1e-6, "description": about}
            content.add_acquisition(ElectricalSeries(name=name, data=_stored(values[:, None]), electrodes=region, **times))
            plain.add(TimeSeries(name=name, data=_stored(values), unit="volts", **times))
    for begin_s, end_s in sorted({span for s in signals for span in _gaps(s)}):
        content.add_invalid_time_interval(start_time=begin_s, stop_time=end_s)


def _gaps(signal: Signal) -> Iterator[tuple[float, float]]:
    """Yield the times between stretches in which samples are lost, s."""
    for (_, end, rate_hz), (first, _, _) in pairwise(signal.stretches):
        begin_s = round(float(signal.t_s[end - 1]) + 1.0 / rate_hz, 6)
        if (end_s := round(float(signal.t_s[first]), 6)) - begin_s >= 0.5 / rate_hz:
            yield begin_s, end_s


def _traces(content: NWBFile, signals: Sequence[Signal]) -> None:
    from pynwb import TimeSeries

    if not signals:
        return
    steps = content.create_processing_module("steps", "Traces on the control grid; a time is the end of its step, NaN an invalid step.")
    for s in signals:
        unit, factor = UNITS.get(s.unit, (s.unit, 1.0))
        said = f"recording {s.recording}, {s.stream} in {s.unit}"
        steps.add(TimeSeries(name=_name(s), data=_stored(s.values), unit=unit, conversion=factor, description=said, **_times(s)))


def _times(trace: Signal) -> dict[str, Any]:
    """State the times of a trace: start and rate where its rows are even, else each time."""
    steps = np.diff(trace.t_s)
    if steps.size and float(np.ptp(steps)) < 1e-6 and steps[0] > 0:
        return {"starting_time": float(trace.t_s[0]), "rate": 1.0 / float(steps[0])}
    return {"timestamps": _stored(trace.t_s)}


def _stored(values: np.ndarray[Any, Any]) -> Any:
    """Compress values as HDF5 stores them."""
    from pynwb import H5DataIO

    return H5DataIO(values, compression="gzip", shuffle=True) if values.size else values


def _name(s: Signal) -> str:
    """Make a name that no other signal of the session has; NWB takes neither slashes nor colons."""
    return f"recording {s.recording} {s.stream} {s.channel}".strip().replace("/", "-").replace(":", "-")


# A session's samples and traces as one file, written in a limited child: samples are decoded again from the files that came.
#
# The child knows no settings and no database: its params contain all that it needs. `samples` is its caller's side.

WRITERS = {"parquet": write_parquet, "nwb": write_nwb}


def write(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Write the file.

    Args:
        params: `format` (of `WRITERS`), `target` and `traces` (paths; traces as `npz`) and `headers` of the traces. Also `files` with their
            `recordings`, and `session`, what the file says of the session.
        workdir: not used.
        report: takes the share that was read.

    Returns:
        `missing`: numbers of recordings that the present decoder does not find in their file; `samples`, how many were written.
    """
    signals: list[Signal] = []
    missing: list[int] = []
    for k, file in enumerate(params["files"]):
        report.progress(k / len(params["files"]), "reading the samples")
        found, lost = _samples_of(file)
        signals += found
        missing += lost
    samples = sum(s.values.size for s in signals)
    with np.load(params["traces"], allow_pickle=False) as arrays:
        signals += [Signal(**header, t_s=arrays[f"t{i}"], values=arrays[f"v{i}"]) for i, header in enumerate(params["headers"])]
    about = {**params["session"], "recordings_without_samples": missing}
    WRITERS[params["format"]](Path(params["target"]), signals, about)
    return {"missing": missing, "samples": samples}


def _samples_of(file: Mapping[str, Any]) -> tuple[list[Signal], list[int]]:
    """Return the samples of a file's recordings within the session as signals, and which recordings it no longer gives."""
    logs, missing = samples_within(file)
    return [
        Signal(row["id"], row["hemisphere"], "lfp", log.channel, log.unit, log.t_s, log.values, log.rates_hz, _pieces(log))
        for row, log in logs
    ], missing


def _pieces(log: SampleLog) -> tuple[tuple[int, int, float], ...]:
    """List the gap-free pieces of a channel: first sample, end, rate in Hz."""
    bounds = [*log.starts.tolist(), log.values.size]
    return tuple((a, b, rate_hz) for (a, b), (_, rate_hz, _) in zip(pairwise(bounds), log.stretches(), strict=True))


def samples_within(file: Mapping[str, Any]) -> tuple[list[tuple[Mapping[str, Any], SampleLog]], list[int]]:
    """Return the samples of a file's recordings within the session.

    Args:
        file: as `app.overview.samples.files_of` gives it.

    Returns:
        (recording, samples with times from the session's start) per channel, and numbers of the recordings that the present decoder does
        not find in the file.
    """
    wanted: Sequence[Mapping[str, Any]] = file["recordings"]
    try:
        decoded = formats.decode(Path(file["source"]), file["kind"], options_of(file["options"]), name=file["name"]).recordings
    except UndecodableFile:
        return [], [r["id"] for r in wanted]
    by_content = {r.fingerprint: r for r in decoded}
    found = []
    for row in wanted:
        if row["fingerprint"] not in by_content:
            continue
        for log in by_content[row["fingerprint"]].samples:
            here = log.between(row["begin_s"], row["end_s"])
            if here.values.size:
                found.append((row, replace(here, t_s=here.t_s - row["start_s"])))
    return found, [r["id"] for r in wanted if r["fingerprint"] not in by_content]


# Data for the screen from a session's samples, written once in a limited child: samples, their extremes per bin, the spectrogram.
#
# The child knows no settings and no database. `signals` is its caller's side, and reads the folder that is written here.

HEADER = "channels.json"


def build(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Write the folder `target`: `channels.json`, and for channel i `i-t.npy`, `i-v.npy`, `i-<level>.npy` ([2, bins]) and `i-density.npy`.

    Args:
        params: `target`, and `files` as `app.overview.samples.files_of` gives them.
        workdir: not used.
        report: takes the share that was read.

    Returns:
        `channels`, how many there are.
    """
    target = Path(params["target"])
    channels: list[dict[str, Any]] = []
    missing: list[int] = []
    for k, file in enumerate(params["files"]):
        report.progress(k / len(params["files"]), "reading the samples")
        logs, lost = samples_within(file)
        missing += lost
        for row, log in logs:
            channels.append({"recording": row["id"], "hemisphere": row["hemisphere"], **_written(log, target, len(channels))})
    (target / HEADER).write_text(json.dumps({"channels": channels, "missing": missing}))
    return {"channels": len(channels)}


def _written(log: SampleLog, target: Path, number: int) -> dict[str, Any]:
    """Write one channel's arrays; what the header says of it."""
    np.save(target / f"{number}-t.npy", log.t_s)
    np.save(target / f"{number}-v.npy", log.values)
    levels = pyramid(log.t_s, log.values, max(log.rates_hz))
    for k, level in enumerate(levels):
        np.save(target / f"{number}-{k}.npy", np.stack([level.low, level.high]))
    begin, end = float(log.t_s.min()), float(log.t_s.max())
    power = spectrogram(_stretches(log), begin, end)
    np.save(target / f"{number}-density.npy", power.density)
    return {
        "channel": log.channel,
        "unit": log.unit,
        "rates_hz": list(log.rates_hz),
        "samples": int(log.values.size),
        "begin_s": begin,
        "end_s": end,
        "widths_s": [level.width_s for level in levels],
        "column_s": power.width_s,
        "hz": power.hz.tolist(),
    }


def _stretches(log: SampleLog) -> Iterator[Stretch]:
    """Yield gap-free pieces with the rate that their own times have."""
    for first, stop in zip(log.starts, [*log.starts[1:], log.values.size], strict=True):
        if stop - first > 1:
            rate = (stop - first - 1) / (log.t_s[stop - 1] - log.t_s[first])
            nominal = min(log.rates_hz, key=lambda r: abs(r - rate))
            yield float(log.t_s[first]), float(nominal), log.values[first:stop]
