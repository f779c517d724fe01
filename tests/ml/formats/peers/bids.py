"""BIDS folders (iEEG) written by the specification 1.10: inherited sidecars, tables of channels, electrodes, events and scans."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tests.ml.formats.peers.truth import Truth

RUN = "sub-PD07_ses-03_task-rest_run-02"
PLACE = "sub-PD07/ses-03/ieeg"


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> bytes:
    """Write a table with tabs."""
    return "\n".join("\t".join(str(c) for c in row) for row in [heads, *rows]).encode() + b"\n"


def folder(
    data: Mapping[str, bytes], channels: Sequence[str], events: Sequence[Sequence[object]], rate_hz: float, run: str = RUN,
    heads: Sequence[str] = ("onset", "duration", "sample", "trial_type"), recording: str = "continuous",
) -> dict[str, bytes]:  # fmt: skip
    """Make the files of a folder with one run; `data` has the content of the data file by its ending."""
    out = {f"{PLACE}/{run}_ieeg.{ending}": content for ending, content in data.items()}
    sidecar = {"SamplingFrequency": rate_hz, "RecordingType": recording, "PowerLineFrequency": 50, "iEEGReference": "mastoid"}
    out["dataset_description.json"] = json.dumps({"Name": "A study", "BIDSVersion": "1.10.0", "Authors": ["Someone"]}).encode()
    out["participants.tsv"] = table(("participant_id", "age"), [("sub-PD07", 61)])
    # inherited from above: every run of the task has it
    out["task-rest_ieeg.json"] = json.dumps(sidecar).encode()
    first = next(iter(data), "edf")
    out["sub-PD07/ses-03/sub-PD07_ses-03_scans.tsv"] = table(
        ("filename", "acq_time", "operator"), [(f"ieeg/{run}_ieeg.{first}", "2026-03-02T09:30:00", "Someone")]
    )
    rows = [(c, "DBS", "µV", "good", "n/a") for c in channels]
    out[f"{PLACE}/{run}_channels.tsv"] = table(("name", "type", "units", "status", "notch"), rows)
    out[f"{PLACE}/{run}_events.tsv"] = table(heads, events)
    return out


def pack(path: Path, files: Mapping[str, bytes], top: str = "study/") -> Path:
    """Zip the files of a folder."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(f"{top}{name}", content)
    return path


def write(path: Path, data: Path, kind: str, truth: Truth, texts: Sequence[str], how: str, lasting: bool) -> None:
    """Write a folder around a data file of a known content.

    Args:
        texts: of the steps. how: states the amplitude in the text, in a column with its unit, or in one whose unit events.json has.
        lasting: gives each step its duration.
    """
    times = [t for t, _ in truth.steps]
    ends = [*times[1:], truth.total / truth.rate_hz + 1][: len(times)]
    column = {"text": "response", "column": "stim_amplitude_ma", "unit": "amplitude"}[how]
    rows = []
    for (t, a), end, text in zip(truth.steps, ends, texts, strict=True):
        # an NWB file may count samples that are no number
        recorded = kind != "nwb" and np.min(np.abs(truth.t_s - t)) < 1 / truth.rate_hz
        sample = int(np.searchsorted(truth.t_s, t)) if recorded else "n/a"
        word = text if how == "text" else "stimulation"
        rows.append((f"{t:.9f}", f"{end - t:.9f}" if lasting else "n/a", sample, word, "n/a" if how == "text" else a))
    heads = ("onset", "duration", "sample", "trial_type", column)
    content = {"edf": data.read_bytes()} if kind == "edf" else {"nwb": data.read_bytes()} if kind == "nwb" else _three(data)
    discontinuous = bool(truth.gaps)
    files = folder(
        content, list(truth.channels), rows, truth.rate_hz, heads=heads, recording="discontinuous" if discontinuous else "continuous"
    )
    if how == "unit":
        files[f"{PLACE}/{RUN}_events.json"] = json.dumps({"amplitude": {"Description": "of DBS", "Units": "mA"}}).encode()
    pack(path, files)


def _three(data: Path) -> dict[str, bytes]:
    """Rename the three files of a BrainVision recording as BIDS asks."""
    with zipfile.ZipFile(data) as archive:
        content = {name.rsplit(".", 1)[-1]: archive.read(name) for name in archive.namelist()}
    for ending in ("vhdr", "vmrk"):
        content[ending] = content[ending].replace(b"file.", f"{RUN}_ieeg.".encode())
    return {ending: content[ending] for ending in ("vhdr", "vmrk", "eeg")}
