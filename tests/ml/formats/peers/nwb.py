"""NWB files written by pynwb with a known content, in every way in which the schema states samples, times and doses."""

from __future__ import annotations

import warnings
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pynwb
from pynwb.behavior import SpatialSeries
from pynwb.ecephys import LFP, ElectricalSeries

from tests.ml.formats.peers.truth import Truth

START = datetime(2026, 3, 2, 9, 30, tzinfo=timezone(timedelta(hours=1)))


def new_file(**head: Any) -> pynwb.NWBFile:
    """Make an empty file."""
    return pynwb.NWBFile("a session", head.pop("identifier", "id"), START, **head)


def add_electrodes(file: pynwb.NWBFile, labels: list[str], location: str) -> Any:
    """Add one electrode per label, and return their region."""
    group = file.create_electrode_group("lead", "the lead", location, file.create_device("amplifier"))
    if any(labels):
        file.add_electrode_column("label", "its name")
    for label in labels:
        file.add_electrode(location=location, group=group, **({"label": label} if any(labels) else {}))
    return file.create_electrode_table_region(list(range(len(labels))), "all")


def write(path: Path, file: pynwb.NWBFile) -> None:
    """Write the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pynwb.NWBHDF5IO(str(path), "w") as sink:
            sink.write(file)


def add_signal(file: pynwb.NWBFile, truth: Truth, rng: np.random.Generator, region: Any, begin_s: float) -> float:
    """Add the truth's samples as electrical series, and return their resolution in uV."""
    x = 1e-6 * np.column_stack(list(truth.channels.values()))
    scaled = bool(rng.integers(2))
    lsb, offset, factors = 2e-8, float(rng.choice([0.0, 5e-4])), np.array([1.0, 2.0])
    how = str(rng.choice(["stamps", "pieces", "nan" if not scaled else "stamps", "invalid"]))
    fields: dict[str, Any] = {"electrodes": region}
    if scaled:
        fields |= {"conversion": lsb, "offset": offset, "channel_conversion": factors}

    def pack(values: np.ndarray) -> np.ndarray:
        return np.rint((values - offset) / (lsb * factors)).astype(np.int32) if scaled else values

    parts: list[ElectricalSeries] = []
    if how == "stamps":
        parts.append(ElectricalSeries(name="LFP", data=pack(x), timestamps=begin_s + truth.t_s, **fields))
    elif how == "pieces":
        for k, (a, b) in enumerate(truth.pieces()):
            parts.append(
                ElectricalSeries(
                    name=f"part{k}", data=pack(x[a:b]), starting_time=begin_s + float(truth.t_s[a]), rate=truth.rate_hz, **fields
                )
            )
    else:
        whole = np.full((truth.total, x.shape[1]), np.nan if how == "nan" else 3e-6)
        whole[np.rint(truth.t_s * truth.rate_hz).astype(int)] = x
        parts.append(ElectricalSeries(name="LFP", data=pack(whole), starting_time=begin_s, rate=truth.rate_hz, **fields))
        for first, count in truth.gaps if how == "invalid" else []:
            file.add_invalid_time_interval(begin_s + (first - 0.4) / truth.rate_hz, begin_s + (first + count - 0.6) / truth.rate_hz)
    if rng.integers(2):
        module = file.create_processing_module("ecephys", "signals")
        module.add(LFP(electrical_series=parts))
    else:
        for part in parts:
            file.add_acquisition(part)
    return 2 * 1e6 * lsb if scaled else 0.0


def add_dose(file: pynwb.NWBFile, truth: Truth, rng: np.random.Generator, words: tuple[str, ...], begin_s: float) -> bool:
    """Add the truth's steps; returns whether a gap loses the amplitude."""
    how = str(rng.choice(["annotations", "intervals", "series"]))
    if not truth.steps:
        return False
    times = begin_s + np.array([t for t, _ in truth.steps])
    if how == "annotations":
        texts = [str(rng.choice(words)).format(a=a) for _, a in truth.steps]
        file.add_acquisition(pynwb.misc.AnnotationSeries(name="marks", data=texts, timestamps=times))
    elif how == "intervals":
        table = pynwb.epoch.TimeIntervals(name="stimulation", description="what was on")
        column = str(rng.choice(["amplitude_ma", "stim_amplitude [mA]", "Stim_Current_mA"]))
        table.add_column(column, "amplitude")
        ends = [*times[1:].tolist(), begin_s + truth.total / truth.rate_hz + 1]
        for (_, a), begin, end in zip(truth.steps, times.tolist(), ends, strict=True):
            table.add_interval(start_time=begin, stop_time=end, **{column: a})
        file.add_time_intervals(table)
    else:
        values = np.array([a for _, a in truth.steps])
        file.add_stimulus(
            pynwb.TimeSeries(name="stim amplitude", data=values, unit="A", conversion=1e-3, timestamps=times, continuity="step")
        )
    return how == "annotations"


def add_others(file: pynwb.NWBFile, truth: Truth, begin_s: float) -> None:
    """Add what is no field potential: an accelerometer in g, and a hand's place."""
    n = int(truth.total / truth.rate_hz * 50)
    file.add_acquisition(
        pynwb.TimeSeries(name="ACC", data=np.random.default_rng(0).normal(0, 1, (n, 3)), unit="g", rate=50.0, starting_time=begin_s)
    )
    file.add_acquisition(SpatialSeries(name="hand", data=np.zeros((n, 2)), reference_frame="the corner", rate=50.0, starting_time=begin_s))
