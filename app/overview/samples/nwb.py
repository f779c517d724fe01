"""A session's signals as Neurodata Without Borders (NWB 2, HDF5). It needs the extra `nwb`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from app.overview.samples.signal import Signal

if TYPE_CHECKING:
    from pynwb import NWBFile

UNITS = {"uV": ("volts", 1e-6), "mA": ("amperes", 1e-3)}
"""Unit and factor by which values become it, where NWB has an SI unit for them."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def write_nwb(target: Path, signals: Sequence[Signal], about: Mapping[str, Any]) -> None:
    """Write the file: samples as electrical series, traces as time series in the processing module `steps`.

    NWB wants a start time: it is the session's day since enrolment, counted from 1970-01-01, for no date leaves.
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
        subject=Subject(subject_id=about["participant"], species="Homo sapiens"),
    )
    _samples(content, [s for s in signals if s.stream == "lfp"])
    _traces(content, [s for s in signals if s.stream != "lfp"])
    with NWBHDF5IO(target, "w") as out:
        out.write(content)


def _samples(content: NWBFile, signals: Sequence[Signal]) -> None:
    from pynwb.ecephys import ElectricalSeries

    if not signals:
        return
    device = content.create_device(name="implanted neurostimulator")
    groups = {
        side: content.create_electrode_group(
            name=f"{side} lead", description=f"contacts of the {side} side", location=f"{side} side; target not stated", device=device
        )
        for side in dict.fromkeys(s.hemisphere or "unknown" for s in signals)
    }
    for i, s in enumerate(signals):
        group = groups[s.hemisphere or "unknown"]
        content.add_electrode(location=group.location, group=group, reference=f"bipolar: {s.channel}")
        region = content.create_electrode_table_region([i], f"contacts of {s.channel}")
        said = f"recording {s.recording}, {s.channel}, sampled at {' and '.join(f'{r:g}' for r in s.rates_hz)} Hz; lost samples are absent"
        series = ElectricalSeries(
            name=_name(s), data=_stored(s.values), electrodes=region, timestamps=_stored(s.t_s), conversion=1e-6, description=said
        )
        content.add_acquisition(series)


def _traces(content: NWBFile, signals: Sequence[Signal]) -> None:
    from pynwb import TimeSeries

    if not signals:
        return
    steps = content.create_processing_module("steps", "Traces on the control grid; a time is the end of its step, NaN an invalid step.")
    for s in signals:
        unit, factor = UNITS.get(s.unit, (s.unit, 1.0))
        said = f"recording {s.recording}, {s.stream} in {s.unit}"
        steps.add(
            TimeSeries(name=_name(s), data=_stored(s.values), unit=unit, conversion=factor, timestamps=_stored(s.t_s), description=said)
        )


def _stored(values: np.ndarray[Any, Any]) -> Any:
    """Compressed as HDF5 holds it."""
    from pynwb import H5DataIO

    return H5DataIO(values, compression="gzip", shuffle=True) if values.size else values


def _name(s: Signal) -> str:
    """A name that no other signal of the session has; NWB takes neither slashes nor colons."""
    return f"recording {s.recording} {s.stream} {s.channel}".strip().replace("/", "-").replace(":", "-")
