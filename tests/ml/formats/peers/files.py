"""Files of every lab format with a known content, made at random from a seed; the faults of real recorders are among them."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pybv
from pynwb.ecephys import ElectricalSeries

from tests.ml.formats.peers import bids, nwb, xdf
from tests.ml.formats.peers.truth import Truth, make_truth


@dataclass(frozen=True)
class Written:
    """A file and what is known of it; `names`, `lsb_uv`, `pause`, `steps` as `check.compare` takes them."""

    truth: Truth
    names: dict[str, str]
    lsb_uv: float = 0.0
    pause: bool = False
    steps: list[tuple[float, float]] | None = None
    said: dict[str, str] = field(default_factory=dict)


WORDS = ("stim on {a} mA", "Stim {a}mA", "DBS amplitude = {a} mA", "STIM_ON_{a}mA", "therapy set to {a} mA 130 Hz")


def write_xdf(path: Path, rng: np.random.Generator) -> Written:
    """Write LFP and markers on two computers' clocks, with drift, jitter, chunks with one stamp, and losses from two samples to 2 s."""
    rate = float(rng.choice([200.0, 250.0, 500.0, 1000.0]))
    truth = make_truth(rng, rate_hz=rate, gaps=int(rng.integers(0, 6)), steps=int(rng.integers(0, 5)))
    stamped = bool(rng.integers(2))
    jitter = float(rng.choice([0.0, 0.1, 0.3])) / rate
    drift = float(rng.uniform(-1e-4, 1e-4))
    offset, other = float(rng.uniform(-500, 500)), float(rng.uniform(-500, 500))
    local = 4000.0 - offset + truth.t_s * (1 - drift)
    form = str(rng.choice(["float32", "double64"]))
    unit, scale = [("uV", 1.0), ("mV", 1e-3), ("V", 1e-6), ("microvolts", 1.0)][int(rng.integers(4))]
    x = scale * np.column_stack(list(truth.channels.values()))
    stamps = local + rng.normal(0, jitter, local.size)
    kind, size = str(rng.choice(["LFP", "EEG"])), int(rng.choice([8, 32, 100]))
    names, growth = list(truth.channels), drift / (1 - drift)
    amp = xdf.Stream("LFP", kind, rate, stamps, x, names, [unit, unit], form, offset, size, stamped, drift=growth)
    marks = [str(rng.choice(WORDS)).format(a=a) for _, a in truth.steps]
    at = np.array([4000.0 + t - other for t, _ in truth.steps])
    streams = [amp, xdf.Stream("Markers", "Markers", 0, at, marks, form="string", offset_s=other, per_chunk=1)]
    xdf.write(path, streams if rng.integers(2) else streams[::-1])
    return Written(truth, {n: n.replace(" 0", " +0").replace(" 1-", " +1-") for n in truth.channels})


def write_edf(path: Path, rng: np.random.Generator, marked: bool = True) -> Written:
    """Write EDF+ by edfio or pyedflib, or BDF+ by pyedflib; for an EDF+D the records that were lost are taken out of the bytes.

    edfio writes no gaps, so the file is written whole and keeps the time-keeping annotations of the records that stay.
    """
    import edfio

    rate, record = 250.0, 250
    lossy = bool(rng.integers(2))
    truth = make_truth(rng, rate_hz=rate, gaps=int(rng.integers(1, 5)) if lossy else 0, steps=int(rng.integers(0, 5)), block=record)
    unit, scale = [("uV", 1.0), ("mV", 1e-3)][int(rng.integers(2))]
    whole = {name: np.zeros(truth.total) for name in truth.channels}
    at = np.rint(truth.t_s * rate).astype(int)
    for name, x in truth.channels.items():
        whole[name][at] = np.round(np.clip(x, -40, 40) / (100 / 65535)) * (100 / 65535)
        truth.channels[name][:] = np.clip(x, -40, 40)
    marks = [(t, str(rng.choice(WORDS)).format(a=a)) for t, a in truth.steps if marked]
    bdf = not lossy and bool(rng.integers(2))
    if bdf:
        _by_pyedflib(path, whole, marks, rate, scale, unit)
    else:
        signals = [
            edfio.EdfSignal(scale * x, rate, label=n, physical_dimension=unit, physical_range=(-50 * scale, 50 * scale))
            for n, x in whole.items()
        ]
        edfio.Edf(signals, data_record_duration=1.0, annotations=[edfio.EdfAnnotation(t, None, text) for t, text in marks]).write(path)
    steps = truth.steps
    if lossy:
        gone = [g + k * record for g, size in truth.gaps for k in range(size // record)]
        _take_records_out(path, {g // record for g in gone})
        # an annotation is in the record of its time: one of a lost record is lost
        steps = [(t, a) for t, a in truth.steps if int(t) * record not in gone]
    names = {n: n.replace(" 0", " +0").replace(" 1-", " +1-") for n in truth.channels}
    return Written(truth, names, 2 * 100 / 65535, pause=lossy, steps=steps)


def _by_pyedflib(path: Path, whole: dict[str, np.ndarray], marks: list[tuple[float, str]], rate: float, scale: float, unit: str) -> None:
    import pyedflib

    with pyedflib.EdfWriter(str(path), len(whole), file_type=pyedflib.FILETYPE_BDFPLUS) as writer:
        for i, name in enumerate(whole):
            bounds = {"physical_min": -50 * scale, "physical_max": 50 * scale, "digital_min": -8388608, "digital_max": 8388607}
            writer.setSignalHeader(
                i, {"label": name, "dimension": unit, "sample_frequency": rate, "prefilter": "", "transducer": "", **bounds}
            )
        writer.writeSamples([scale * x for x in whole.values()])
        for t, text in marks:
            writer.writeAnnotation(t, -1, text)


def _take_records_out(path: Path, numbers: set[int]) -> None:
    raw = path.read_bytes()
    count = int(raw[252:256])
    size = 256 * (count + 1)
    samples = [int(raw[256 + count * 216 + 8 * i : 264 + count * 216 + 8 * i]) for i in range(count)]
    length = 2 * sum(samples)
    records = [raw[size + k * length : size + (k + 1) * length] for k in range((len(raw) - size) // length)]
    kept = [r for k, r in enumerate(records) if k not in numbers]
    head = raw[:192] + b"EDF+D".ljust(44) + str(len(kept)).encode().ljust(8) + raw[244:size]
    path.write_bytes(head + b"".join(kept))


def write_brainvision(path: Path, rng: np.random.Generator, marked: bool = True) -> Written:
    """Write the three files by pybv, zipped; segments after a loss begin with a dated New Segment marker, as the recorder writes it."""
    rate = float(rng.choice([250.0, 500.0]))
    truth = make_truth(rng, rate_hz=rate, gaps=int(rng.integers(0, 5)), steps=int(rng.integers(0, 5)))
    form, lsb = [("binary_float32", 1e-5), ("binary_int16", 0.01)][int(rng.integers(2))]
    start = datetime(2026, 3, 2, 9, 30)
    inside = [(t, a) for t, a in truth.steps if marked and np.min(np.abs(truth.t_s - t)) < 1 / rate]
    events: list[dict[str, object]] = [
        {"onset": int(np.searchsorted(truth.t_s, t)), "duration": 1, "type": "Comment", "description": str(rng.choice(WORDS)).format(a=a)}
        for t, a in inside
    ]
    with tempfile.TemporaryDirectory() as name:
        pybv.write_brainvision(
            data=1e-6 * np.stack(list(truth.channels.values())), sfreq=rate, ch_names=list(truth.channels), fname_base="file",
            folder_out=name, events=events, fmt=form, resolution=0.01 if "int" in form else 1e-3, unit="µV", meas_date=start,
        )  # fmt: skip
        marks = Path(name, "file.vmrk")
        text = marks.read_text("utf-8")
        for k, (begin, _) in enumerate(truth.pieces()[1:]):
            date = (start + timedelta(seconds=float(truth.t_s[begin] - truth.t_s[0]))).strftime("%Y%m%d%H%M%S%f")
            text += f"Mk{len(events) + k + 2}=New Segment,,{begin + 1},1,0,{date}\n"
        marks.write_text(text, "utf-8")
        with zipfile.ZipFile(path, "w") as archive:
            for file in sorted(Path(name).iterdir()):
                archive.write(file, f"visit/{file.name}")
    names = {n: n.replace(" 0", " +0").replace(" 1-", " +1-") for n in truth.channels}
    return Written(truth, names, 2 * lsb, pause=True, steps=inside)


def write_nwb(path: Path, rng: np.random.Generator, marked: bool = True) -> Written:
    """Write NWB by pynwb: integers with scales or volts; timestamps, a series per stretch, NaN or invalid times; three ways of doses."""
    truth = make_truth(rng, rate_hz=float(rng.choice([250.0, 500.0, 1000.0])), gaps=int(rng.integers(0, 5)), steps=int(rng.integers(0, 5)))
    file, begin_s = nwb.new_file(), float(rng.choice([0.0, 12.3456]))
    place = str(rng.choice(["left STN", "Left subthalamic nucleus", "unknown"]))
    lsb = nwb.add_signal(file, truth, rng, nwb.add_electrodes(file, list(truth.channels), place), begin_s)
    pause = not marked or nwb.add_dose(file, truth, rng, WORDS, begin_s)
    if rng.integers(2):
        # what another sensor recorded meanwhile shows that the recording went on, and so did its marks
        # but within invalid times nothing counts as recorded
        nwb.add_others(file, truth, begin_s)
        pause = pause and file.invalid_times is not None
    nwb.write(path, file)
    target = "" if place == "unknown" else "STN "
    return Written(truth, {n: target + n.replace(" 0", " +0").replace(" 1-", " +1-") for n in truth.channels}, lsb, pause=pause)


def write_bids(path: Path, rng: np.random.Generator) -> Written:
    """Write a zipped BIDS folder, by the specification, around a data file of another writer; doses are in events.tsv alone."""
    kind = str(rng.choice(["edf", "brainvision", "nwb"]))
    with tempfile.TemporaryDirectory() as name:
        data = Path(name, "data")
        one = {"edf": write_edf, "brainvision": write_brainvision, "nwb": write_nwb}[kind](data, rng, False)
        lasting = bool(rng.integers(2))
        how = str(rng.choice(["text", "column", "unit"]))
        bids.write(path, data, kind, one.truth, [str(rng.choice(WORDS)).format(a=a) for _, a in one.truth.steps], how, lasting)
    return Written(one.truth, one.names, one.lsb_uv, pause=one.pause and not lasting)


WRITERS: dict[str, Callable[[Path, np.random.Generator], Written]] = {
    "bids": write_bids,
    "brainvision": write_brainvision,
    "edf": write_edf,
    "nwb": write_nwb,
    "xdf": write_xdf,
}
"""By kind."""


def large_edf(path: Path, megabytes: int) -> None:
    """Write an EDF+ of eight channels at 1 kHz."""
    import edfio

    n = megabytes * 1_000_000 // 16 // 1000 * 1000
    rng = np.random.default_rng(0)
    names = [f"LFP L {k}-{k + 2}" for k in range(8)]
    edfio.Edf(
        [edfio.EdfSignal(rng.normal(0, 3, n), 1000.0, label=x, physical_dimension="uV", physical_range=(-50, 50)) for x in names]
    ).write(path)


def large_xdf(path: Path, megabytes: int) -> None:
    """Write an XDF of eight channels at 1 kHz, in chunks of 100 samples."""
    n = megabytes * 1_000_000 // 41
    x = np.random.default_rng(0).normal(0, 3, (n, 8))
    names = [f"LFP L {k}-{k + 2}" for k in range(8)]
    xdf.write(path, [xdf.Stream("LFP", "LFP", 1000.0, 100.0 + np.arange(n) / 1000, x, names, ["uV"] * 8, per_chunk=100)])


def large_nwb(path: Path, megabytes: int) -> None:
    """Write an NWB of eight channels at 1 kHz, as integers of 16 bits."""
    n = megabytes * 1_000_000 // 16
    file = nwb.new_file()
    region = nwb.add_electrodes(file, [f"LFP L {k}-{k + 2}" for k in range(8)], "left STN")
    x = np.random.default_rng(0).normal(0, 300, (n, 8)).astype(np.int16)
    file.add_acquisition(ElectricalSeries(name="LFP", data=x, electrodes=region, rate=1000.0, conversion=1e-8))
    nwb.write(path, file)


def large_bids(path: Path, megabytes: int) -> None:
    """Write a zipped BIDS folder around a large EDF+."""
    with tempfile.TemporaryDirectory() as name:
        large_edf(Path(name, "data"), megabytes)
        bids.pack(path, bids.folder({"edf": Path(name, "data").read_bytes()}, [f"LFP L {k}-{k + 2}" for k in range(8)], [], 1000.0))


LARGE = {"bids": large_bids, "edf": large_edf, "nwb": large_nwb, "xdf": large_xdf}
"""Large files by kind, for what reading takes."""
