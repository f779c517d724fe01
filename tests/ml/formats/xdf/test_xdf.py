"""XDF files: what is lost, contradictory, or of a person in them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from ml.formats import DecodedFile, DecodeOptions, UndecodableFile, decode, redact, sniff
from tests.ml.formats.peers.xdf import Stream, chunk, write

NAME = "Plantedname"


def lfp(seconds: float = 40.0, name: str = "LFP", unit: str = "uV", start: float = 100.0, **more: object) -> Stream:
    t = np.arange(int(seconds * 250)) / 250
    x = 5 * np.sin(2 * np.pi * 20 * t)[:, None] + np.random.default_rng(0).normal(0, 1, (t.size, 1))
    return Stream(name, "LFP", 250.0, start + t, x, ["LFP L 0-2"], [unit], **more)  # type: ignore[arg-type]


def marks(*said: tuple[float, str], **more: object) -> Stream:
    return Stream("Markers", "Markers", 0, np.array([100.0 + t for t, _ in said]), [s for _, s in said], form="string", per_chunk=1, **more)  # type: ignore[arg-type]


def read(path: Path, **options: object) -> DecodedFile:
    assert sniff(path) == "xdf"
    done = redact(path, path.with_suffix(".clean"), "xdf", bytes(32))
    found = decode(path.with_suffix(".clean"), "xdf", DecodeOptions(**options))  # type: ignore[arg-type]
    found.reports[0].flagged.extend(done.flagged)
    found.reports[0].removed.extend(done.removed)
    return found


def amplitude(file: DecodedFile) -> list[float]:
    return [float(v) for v in next(t for t in file.recordings[0].traces if t.stream == "amplitude").values]


def test_streams_of_one_file_are_one_session_with_its_amplitude_and_date(tmp_path: Path) -> None:
    write(tmp_path / "a.xdf", [lfp(), marks((10, "stim on 2.5 mA"), (30, "stim off"))])
    found = read(tmp_path / "a.xdf")
    (one,) = found.recordings
    assert (one.hemisphere, one.run) == ("left", 0)
    assert one.started_at is not None
    assert one.started_at.isoformat().startswith("2026-03-02T07:59:59.996")
    assert one.settings["utc_offset_h"] == 1.0
    got = amplitude(found)
    assert all(np.isnan(got[:5]))
    assert got[6:15] == [2.5] * 9
    assert got[16:] == [0.0] * 4


def test_the_library_s_own_times_would_be_wrong_where_ours_are_right(tmp_path: Path) -> None:
    pyxdf = pytest.importorskip("pyxdf")
    one = lfp(60)
    there = np.ones(one.stamps.size, dtype=bool)
    there[5000:5495] = False
    one.stamps, one.values = one.stamps[there], np.asarray(one.values)[there]
    write(tmp_path / "a.xdf", [one])
    spread = pyxdf.load_xdf(str(tmp_path / "a.xdf"))[0][0]["time_stamps"]
    assert np.max(np.abs(spread - one.stamps)) > 0.5  # this is why its de-jittering is off
    found = read(tmp_path / "a.xdf", keep_samples=True)
    np.testing.assert_allclose(found.recordings[0].samples[0].t_s + 100 - 1 / 250, one.stamps, atol=1e-6)


def test_no_name_of_a_person_machine_or_host_stays(tmp_path: Path) -> None:
    said = f"<hostname>{NAME}-pc</hostname><source_id>{NAME}</source_id><uid>{NAME}</uid><v4address>10.0.0.7</v4address>"
    amp = lfp(name=f"{NAME} amp", extra=said)
    amp.labels = [f"{NAME} LFP"]
    write(tmp_path / "a.xdf", [amp, marks((5, f"{NAME} says 2 mA"), (9, NAME))])
    found = read(tmp_path / "a.xdf")
    assert NAME.encode() not in (tmp_path / "a.clean").read_bytes()
    assert len(found.reports[0].removed) == 3
    assert NAME not in str(found)
    assert all(np.isnan(amplitude(found)))


def test_a_file_cut_in_mid_chunk_keeps_what_is_whole_and_says_so(tmp_path: Path) -> None:
    write(tmp_path / "a.xdf", [lfp(), marks((10, "2 mA"))], closed=False, cut=7)
    found = read(tmp_path / "a.xdf")
    said = " ".join(found.reports[0].flagged)
    assert "ends within a chunk, at byte" in said
    assert "did not close" in said
    assert found.recordings[0].duration_s > 39
    assert np.isnan(amplitude(found)[-1])


def test_after_a_damaged_chunk_the_amplitude_is_unknown_until_the_next_marker(tmp_path: Path) -> None:
    write(tmp_path / "a.xdf", [lfp(), marks((2, "1 mA"), (30, "2 mA"))])
    raw = bytearray((tmp_path / "a.xdf").read_bytes())
    at = raw.index(bytes.fromhex("43a546dccbf5410fb30ed5467383cbe4")) + 16 + 200
    begin = raw.index(b"\x04", at)
    raw[begin : begin + 3000] = b"\xff" * 3000
    (tmp_path / "a.xdf").write_bytes(raw)
    found = read(tmp_path / "a.xdf")
    assert any("stepped over" in s for s in found.reports[0].flagged)
    got = amplitude(found)
    assert 1.0 not in got
    assert got[16:] == [2.0] * 4


def test_two_streams_of_one_name_are_both_kept_and_flagged(tmp_path: Path) -> None:
    write(tmp_path / "a.xdf", [lfp(), lfp()])
    found = read(tmp_path / "a.xdf")
    assert {t.channel for t in found.recordings[0].traces if t.stream == "beta"} == {"LFP L +0-2", "LFP L +0-2 (2)"}
    assert any("more than once" in s for s in found.reports[0].flagged)


def test_markers_of_a_computer_without_clock_offsets_are_not_placed(tmp_path: Path) -> None:
    write(tmp_path / "a.xdf", [lfp(), marks((10, "2 mA"), offset_s=None)])
    found = read(tmp_path / "a.xdf")
    assert any("no clock offsets" in s for s in found.reports[0].flagged)
    assert not any(t.stream == "amplitude" for t in found.recordings[0].traces)


def test_a_channel_in_no_known_unit_is_asked_about_and_read_once_it_is_stated(tmp_path: Path) -> None:
    write(tmp_path / "a.xdf", [lfp(unit="")])
    with pytest.raises(UndecodableFile, match="known unit"):
        read(tmp_path / "a.xdf")
    assert read(tmp_path / "a.xdf", table_lfp_unit="mV").recordings


def test_amplitudes_as_a_channel_of_numbers_in_ma_are_read_and_without_a_unit_unknown(tmp_path: Path) -> None:
    def course(unit: str) -> Stream:
        return Stream("stim", "Stim", 0, np.array([110.0, 120.0]), np.array([[1.5], [3.0]]), ["stim amplitude"], [unit], per_chunk=1)

    write(tmp_path / "a.xdf", [lfp(), course("mA")])
    got = amplitude(read(tmp_path / "a.xdf"))
    assert got[6:10] == [1.5] * 4
    assert got[11:] == [3.0] * 9
    write(tmp_path / "b.xdf", [lfp(), course("")])
    found = read(tmp_path / "b.xdf")
    assert any("no known unit" in s for s in found.reports[0].flagged)
    assert not any(t.stream == "amplitude" for t in found.recordings[0].traces)


def test_a_rate_of_stimulation_that_folds_into_beta_is_flagged(tmp_path: Path) -> None:
    write(tmp_path / "a.xdf", [lfp(), marks((1, "stim on 2 mA 130 Hz"))])
    assert any("130 Hz sampled at 250 Hz" in s and "20 Hz" in s for s in read(tmp_path / "a.xdf").reports[0].flagged)


def test_a_stream_that_claims_more_samples_than_it_has_takes_no_memory(tmp_path: Path) -> None:
    write(tmp_path / "a.xdf", [lfp()])
    bomb = chunk(3, struct.pack("<BQ", 8, 2**40) + b"\x00", 1)
    (tmp_path / "a.xdf").write_bytes((tmp_path / "a.xdf").read_bytes() + bomb)
    assert any("damaged" in s for s in read(tmp_path / "a.xdf").reports[0].flagged)


@pytest.mark.parametrize("raw", [b"XDF:", b"XDF:" + chunk(1, b"<!DOCTYPE a><info/>"), b"XDF:\x00\x00"])
def test_a_file_without_a_stream_is_refused_and_nothing_is_written(raw: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.xdf").write_bytes(raw)
    with pytest.raises(UndecodableFile, match="no stream"):
        redact(tmp_path / "a.xdf", tmp_path / "clean", "xdf", bytes(32))
    assert not (tmp_path / "clean").exists()
