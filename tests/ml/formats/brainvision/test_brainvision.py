"""BrainVision recordings: a file of the three is missing, cut, or names a person; loose files; segments without a date."""

from __future__ import annotations

import tempfile
import zipfile
from datetime import datetime
from pathlib import Path

import numpy as np
import pybv
import pytest

from ml.formats import DecodedFile, DecodeOptions, UndecodableFile, decode, redact, sniff

NAME = "Plantedname"


def three(label: str = "LFP L 0-2", text: str = "stim on 2 mA") -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        events = [{"onset": 2500, "duration": 1, "type": "Comment", "description": text}]
        pybv.write_brainvision(
            data=np.random.default_rng(0).normal(0, 3e-6, (1, 10_000)), sfreq=250, ch_names=[label], fname_base=NAME, folder_out=folder,
            events=events, fmt="binary_int16", resolution=0.01, meas_date=datetime(2026, 3, 2, 9, 30),
        )  # fmt: skip
        return {p.name: p.read_bytes() for p in sorted(Path(folder).iterdir())}


def pack(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def read(path: Path) -> DecodedFile:
    assert sniff(path) == "brainvision"
    redact(path, path.with_suffix(".clean"), "brainvision", bytes(32))
    return decode(path.with_suffix(".clean"), "brainvision", DecodeOptions(keep_samples=True))


def test_nothing_that_names_a_person_stays(tmp_path: Path) -> None:
    files = three(f"LFP {NAME}", f"{NAME} says 2 mA")
    files[f"{NAME}.vhdr"] += f"\n[Comment]\n{NAME}, born 1901\n".encode()
    found = read(pack(tmp_path / "a.zip", files))
    with zipfile.ZipFile(tmp_path / "a.clean") as archive:
        assert NAME not in "".join(archive.namelist())
        assert all(NAME.encode() not in archive.read(n) for n in archive.namelist())
    assert NAME not in str(found)
    amplitude = next(t for t in found.recordings[0].traces if t.stream == "amplitude")
    assert not amplitude.valid.any()


def test_the_recording_begins_by_its_first_segment(tmp_path: Path) -> None:
    (one,) = read(pack(tmp_path / "a.zip", three())).recordings
    assert one.started_at is not None
    assert one.started_at.isoformat().startswith("2026-03-02T09:29:59.996")
    assert one.settings["clock"]["known"] is False
    assert one.duration_s == 40.0


@pytest.mark.parametrize(("suffix", "says"), [(".vmrk", "no gap can be seen"), (".eeg", "file of samples")])
def test_a_missing_file_is_named_and_nothing_is_written(suffix: str, says: str, tmp_path: Path) -> None:
    files = three()
    del files[f"{NAME}{suffix}"]
    pack(tmp_path / "a.zip", files)
    with pytest.raises(UndecodableFile, match=says):
        redact(tmp_path / "a.zip", tmp_path / "clean", "brainvision", bytes(32))
    assert not (tmp_path / "clean").exists()


def test_after_a_segment_without_a_date_nothing_is_placed(tmp_path: Path) -> None:
    files = three()
    files[f"{NAME}.vmrk"] += b"Mk3=New Segment,,5001,1,0\n"
    found = read(pack(tmp_path / "a.zip", files))
    assert any("begins at sample 5001 without a date" in s for s in found.reports[0].flagged)
    assert found.recordings[0].samples[0].values.size == 5000


def test_samples_that_end_within_a_sample_are_told(tmp_path: Path) -> None:
    files = three()
    files[f"{NAME}.eeg"] = files[f"{NAME}.eeg"][:-1]
    assert any("ends within a sample" in s for s in read(pack(tmp_path / "a.zip", files)).reports[0].flagged)


def test_a_format_that_is_not_read_says_so(tmp_path: Path) -> None:
    files = three()
    files[f"{NAME}.vhdr"] = files[f"{NAME}.vhdr"].replace(b"INT_16", b"INT_99")
    pack(tmp_path / "a.zip", files)
    with pytest.raises(UndecodableFile, match="unknown format"):
        redact(tmp_path / "a.zip", tmp_path / "clean", "brainvision", bytes(32))
