"""BIDS folders: what tables and sidecars say, what names a person, what is missing or contradicts, and folders of several runs."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import edfio
import numpy as np
import pytest

from ml.formats import DecodedFile, DecodeOptions, Redaction, UndecodableFile, decode, redact, sniff
from tests.ml.formats.brainvision.test_brainvision import three
from tests.ml.formats.peers import bids

NAME = "Plantedname"
X = np.random.default_rng(0).normal(0, 3, 10_000)


def edf(path: Path, labels: tuple[str, ...] = ("LFP 0-2",), unit: str = "uV") -> bytes:
    """Write 40 s at 250 Hz as plain EDF."""
    signals = [edfio.EdfSignal(X, 250.0, label=n, physical_dimension=unit, physical_range=(-50, 50)) for n in labels]
    edfio.Edf(signals, data_record_duration=1.0).write(path)
    return path.read_bytes()


def a_folder(tmp_path: Path, events: list[tuple[object, ...]] | None = None, **given: Any) -> dict[str, bytes]:
    labels = given.pop("labels", ("LFP 0-2",))
    data = {"edf": edf(tmp_path / "x.edf", labels, given.pop("unit", "uV"))}
    return bids.folder(data, labels, events or [], 250.0, **given)


def read(path: Path, files: Mapping[str, bytes]) -> tuple[DecodedFile, Redaction]:
    bids.pack(path, files)
    assert sniff(path) == "bids"
    done = redact(path, path.with_suffix(".clean"), "bids", bytes(32))
    assert sniff(path.with_suffix(".clean")) == "bids"
    return decode(path.with_suffix(".clean"), "bids", DecodeOptions(keep_samples=True)), done


def amplitude(file: DecodedFile) -> list[float]:
    return [float(v) for v in next(t for t in file.recordings[0].traces if t.stream == "amplitude").values]


def test_not_a_byte_of_what_names_a_person_is_stored(tmp_path: Path) -> None:
    run = f"sub-{NAME}_ses-{NAME}_task-{NAME}"
    files = bids.folder({"edf": edf(tmp_path / "x.edf", (f"LFP {NAME}", "LFP 1-3"))}, (f"LFP {NAME}", "LFP 1-3"), [], 250.0, run)
    files[f"{bids.PLACE}/{run}_events.tsv"] = bids.table(
        ("onset", "duration", "trial_type", "rater"), [(3, "n/a", f"{NAME} says 2 mA", NAME), (9, "n/a", NAME, NAME)]
    )
    files[f"{bids.PLACE}/{run}_ieeg.json"] = json.dumps({"InstitutionName": NAME, "ElectricalStimulationParameters": NAME}).encode()
    files |= {"participants.tsv": NAME.encode(), "README": NAME.encode(), f"sourcedata/{NAME}.txt": NAME.encode()}
    files[f"{bids.PLACE}/sub-{NAME}_scan.jpg"] = NAME.encode()
    found, done = read(tmp_path / "a.zip", files)
    raw = (tmp_path / "a.clean").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.clean") as archive:
        assert all(
            word not in archive.read(n) + n.encode() + raw for n in archive.namelist() for word in (NAME.encode(), b"Someone", b"PD07")
        )
    assert NAME not in str(found) + str(done)
    assert "participants.tsv" in " ".join(done.removed)
    assert [e.label for e in found.recordings[0].events] == ["note stim 2 mA", "marker …"]


def test_events_state_the_amplitude_for_their_duration_and_in_the_unit_of_the_sidecar(tmp_path: Path) -> None:
    heads = ("onset", "duration", "trial_type", "amplitude")
    files = a_folder(tmp_path, [(4, 10, "stimulation", 2500), (20, "n/a", "stimulation", 1500)], heads=heads)
    files["task-rest_events.json"] = json.dumps({"amplitude": {"Units": "uA"}}).encode()
    got = amplitude(read(tmp_path / "a.zip", files)[0])
    np.testing.assert_allclose(got[:16], [np.nan] * 2 + [2.5] * 5 + [np.nan] * 3 + [1.5] * 6)
    _, done = read(tmp_path / "c.zip", files)
    assert not any("no data file" in s for s in done.flagged)
    del files["task-rest_events.json"]
    found, _ = read(tmp_path / "b.zip", files)
    assert np.isnan(amplitude(found)).all()


@pytest.mark.parametrize(
    ("row", "dose"),
    [
        (("stim off", 2.5, "n/a"), None),
        (("stim on 2 mA", 2.5, "n/a"), None),
        (("stim on", 2.5, "L"), 2.5),
        (("stim right", 2.5, "left"), None),
        (("movement", "n/a", "n/a"), None),
        (("stim on", -1, "n/a"), None),
        (("stim off", "n/a", "n/a"), 0.0),
    ],
)
def test_cells_that_contradict_each_other_state_no_amplitude(row: tuple[object, ...], dose: float | None, tmp_path: Path) -> None:
    heads = ("onset", "duration", "trial_type", "stim_amplitude_mA", "hemisphere")
    files = a_folder(tmp_path, [(0.5, "n/a", *row)], heads=heads, labels=("LFP L 0-2",))
    found, _ = read(tmp_path / "a.zip", files)
    traces = [t for t in found.recordings[0].traces if t.stream == "amplitude"]
    assert [v for t in traces for v in t.values[2:4].tolist() if np.isfinite(v)] == ([dose] * 2 if dose is not None else [])


def test_a_sample_that_is_not_at_its_onset_makes_the_amplitude_unknown(tmp_path: Path) -> None:
    events: list[tuple[object, ...]] = [(4, "n/a", 1000, "stim on 2 mA"), (20, "n/a", 4000, "stim on 1 mA")]
    found, _ = read(tmp_path / "a.zip", a_folder(tmp_path, events))
    got = amplitude(found)
    assert got[3] == 2.0
    assert np.isnan(got[11:]).all()
    assert any("not at their onset" in s for s in found.reports[0].flagged)


def test_channels_take_type_status_unit_and_side_from_their_tables(tmp_path: Path) -> None:
    labels = ("LFP 0-2", "LFP 1-3", "LFP 4", "SENSOR")
    files = a_folder(tmp_path, labels=labels, unit="")
    rows = [("LFP 0-2", "DBS", "uV", "good", "50, 100"), ("LFP 1-3", "DBS", "uV", "bad", "n/a"), ("LFP 4", "EMG", "mV", "good", "n/a")]
    files[f"{bids.PLACE}/{bids.RUN}_channels.tsv"] = bids.table(
        ("name", "type", "units", "status", "notch"), [*rows, ("SENSOR", "MISC", "V", "good", "n/a"), ("gone", "DBS", "uV", "good", "n/a")]
    )
    files[f"{bids.PLACE}/sub-PD07_ses-03_space-ACPC_electrodes.tsv"] = bids.table(("name", "x", "hemisphere"), [("LFP 0-2", 1.5, "R")])
    found, done = read(tmp_path / "a.zip", files)
    (one,) = found.recordings
    assert one.hemisphere == "right"
    assert [s.channel for s in one.samples] == ["right LFP +0-2"]
    np.testing.assert_allclose(one.samples[0].values, X, atol=1e-3)
    assert any("channels.tsv calls bad" in s for s in found.reports[0].ignored)
    assert any("notch filter at 50 100 Hz" in s for s in found.reports[0].flagged)
    assert any("1 rows of channels.tsv name no channel" in s for s in done.flagged)


def test_runs_of_several_sessions_are_recordings_of_their_own_with_their_starts(tmp_path: Path) -> None:
    data = edf(tmp_path / "x.edf", ("LFP L 0-2", "LFP R 0-2"))
    files: dict[str, bytes] = {}
    scans = []
    for k in (1, 2):
        files |= bids.folder({"edf": data}, ("LFP L 0-2", "LFP R 0-2"), [], 250.0, f"sub-PD07_ses-03_task-rest_run-{k}")
        scans.append((f"ieeg/sub-PD07_ses-03_task-rest_run-{k}_ieeg.edf", f"2026-03-02T1{k}:00:00"))
    files["sub-PD07/ses-03/sub-PD07_ses-03_scans.tsv"] = bids.table(("filename", "acq_time"), scans)
    found, _ = read(tmp_path / "a.zip", files)
    assert [(r.run, r.hemisphere) for r in found.recordings] == [(0, "left"), (0, "right"), (1, "left"), (1, "right")]
    assert [r.started_at.hour for r in found.recordings if r.started_at] == [10, 10, 11, 11]
    assert [r.settings["clock"]["known"] for r in found.recordings] == [False] * 4


def test_a_brainvision_run_without_its_marker_file_waits_and_the_other_is_read(tmp_path: Path) -> None:
    three_files = {n.rsplit(".", 1)[-1]: c.replace(b"Plantedname.", f"{bids.RUN}_ieeg.".encode()) for n, c in three().items()}
    del three_files["vmrk"]
    files = bids.folder(three_files, ["LFP L 0-2"], [], 250.0)
    with pytest.raises(UndecodableFile, match="no gap can be seen"):
        read(tmp_path / "a.zip", files)
    assert not (tmp_path / "a.clean").exists()
    files |= bids.folder({"edf": edf(tmp_path / "x.edf")}, ["LFP 0-2"], [], 250.0, bids.RUN.replace("run-02", "run-01"))
    found, done = read(tmp_path / "b.zip", files)
    assert len(found.recordings) == 1
    assert done.unreadable[0].startswith("run 2: the marker file that the header names is not there")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda f: f.pop(f"{bids.PLACE}/{bids.RUN}_ieeg.edf"), "no data file of a run in here: its sidecars alone"),
        (lambda f: f.update({f"{bids.PLACE}/sub-PD08_task-rest_ieeg.edf": b"x"}), "recordings of 2 participants"),
        (lambda f: f.update({"task-rest_ieeg.json": b"[1"}), "a sidecar is no JSON object"),
        (lambda f: f.update({f"{bids.PLACE}/{bids.RUN}_events.tsv": b"onset\tduration\n1\n"}), "line 2 has 1 cells for 2 columns"),
        (lambda f: f.update({f"{bids.PLACE}/{bids.RUN}_ieeg.json": b'{"RecordingType": "epoched"}'}), "cut into epochs"),
        (lambda f: f.update({f"{bids.PLACE}/{bids.RUN}_ieeg.json": b'{"RecordingType": "discontinuous"}'}), "the data file shows none"),
        (lambda f: f.update({f"{bids.PLACE}/{bids.RUN}_ieeg.set": f.pop(f"{bids.PLACE}/{bids.RUN}_ieeg.edf")}), "format that is not read"),
    ],
)
def test_a_folder_that_lacks_or_contradicts_is_refused_with_what_to_do(change: Any, says: str, tmp_path: Path) -> None:
    files = a_folder(tmp_path)
    change(files)
    with pytest.raises(UndecodableFile, match=says) as error:
        read(tmp_path / "a.zip", files)
    assert error.value.hint
    assert "PD07" not in str(error.value.stored)


def test_sidecars_without_a_data_file_are_told(tmp_path: Path) -> None:
    files = a_folder(tmp_path)
    files[f"{bids.PLACE}/{bids.RUN.replace('run-02', 'run-05')}_channels.tsv"] = b"name\n"
    _, done = read(tmp_path / "a.zip", files)
    assert any("1 runs have sidecars and no data file" in s for s in done.flagged)


def test_a_start_that_was_shifted_is_no_start(tmp_path: Path) -> None:
    files = a_folder(tmp_path)
    files["sub-PD07/ses-03/sub-PD07_ses-03_scans.tsv"] = bids.table(
        ("filename", "acq_time"), [(f"ieeg/{bids.RUN}_ieeg.edf", datetime(1912, 3, 2, 9).isoformat())]
    )
    found, _ = read(tmp_path / "a.zip", files)
    assert found.recordings[0].started_at is None
    assert any("shifted" in s for s in found.reports[0].flagged)
