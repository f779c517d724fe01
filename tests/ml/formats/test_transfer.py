"""Results of a decoder are the same on the other side of a process, bounded in size, and nothing in them can run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ml.formats import DecodedFile, TremorLog, UndecodableFile, decode, transfer


def test_every_kind_of_file_is_the_same_after_the_transfer(rcs, percept, pack, tmp_path, same_recording) -> None:
    sine = 0.01 * np.sin(2 * np.pi * 20 * np.arange(15_000) / 500)
    session = {"RawDataTD": rcs.time_domain(sine), "DeviceSettings": rcs.settings(), "StimLog": rcs.stim((0, rcs.program(1.0)))}
    paths = [pack({f"D/{stem}.json": content for stem, content in session.items()}), tmp_path / "p.json", tmp_path / "t.csv"]
    paths[1].write_text(json.dumps(percept.one_run(lost=(4,))))
    paths[2].write_text("time,class\n1772445600,none\n1772445660,mild\n")
    for number, path in enumerate(paths):
        folder = tmp_path / str(number)
        folder.mkdir()
        before = decode(path)
        transfer.write(before, folder)
        after = transfer.read(folder)
        assert after.reports == before.reports
        assert len(after.recordings) == len(before.recordings)
        assert all(same_recording(a, b) for a, b in zip(before.recordings, after.recordings, strict=True))
        for a, b in zip(before.outcomes, after.outcomes, strict=True):
            np.testing.assert_array_equal(a.fractions, b.fractions)


def test_what_is_too_large_is_refused_by_who_writes_and_by_who_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    year = np.zeros(500_000)
    decoded = DecodedFile((), (), outcomes=(TremorLog(year, year, np.zeros((500_000, 6)), year),))
    transfer.write(decoded, tmp_path)
    monkeypatch.setattr(transfer, "MOST_NUMBERS", 1 << 20)
    with pytest.raises(UndecodableFile, match="MiB of numbers"):
        transfer.write(decoded, tmp_path)
    with pytest.raises(ValueError, match="larger than it may be"):
        transfer.read(tmp_path)


def test_no_object_and_no_other_class_comes_back(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="gives no PosixPath"):
        transfer.write(DecodedFile((), (tmp_path,)), tmp_path)  # type: ignore[arg-type]
    transfer.write(DecodedFile((), ()), tmp_path)
    (tmp_path / "decoded.json").write_text('{"$": "Popen", "fields": {"args": "true"}}')
    with pytest.raises(ValueError, match="gives no Popen"):
        transfer.read(tmp_path)
    np.savez(tmp_path / "arrays.npz", a0=np.array([print], dtype=object))
    (tmp_path / "decoded.json").write_text('{"$": "array", "number": 0}')
    with pytest.raises(ValueError, match="pickle"):
        transfer.read(tmp_path)
