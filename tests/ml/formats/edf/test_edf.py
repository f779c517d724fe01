"""EDF, EDF+ and BDF files: what contradicts itself, is lost, or of a person in them."""

from __future__ import annotations

from datetime import date, time
from pathlib import Path

import edfio
import numpy as np
import pytest

from ml.formats import DecodedFile, DecodeOptions, UndecodableFile, decode, redact, sniff
from ml.formats.edf.head import Annotation, read_annotations, read_head, write_annotations

NAME = "Plantedname"
NOTES = ((5.0, None, "stim on 2 mA"), (30.0, None, f"{NAME} is tired"))


def write(path: Path, marks: tuple[tuple[float, float | None, str], ...] = NOTES, label: str = "LFP R 1-3", unit: str = "uV") -> None:
    x = np.random.default_rng(0).normal(0, 3, 10_000)
    who = edfio.Patient(code="MRN0047110", name=NAME, birthdate=date(1951, 2, 3))
    by = edfio.Recording(startdate=date(2026, 3, 2), investigator_technician_code=NAME, equipment_code=NAME)
    signal = edfio.EdfSignal(
        x, 250.0, label=label, physical_dimension=unit, physical_range=(-50, 50), transducer_type=NAME, prefiltering=NAME
    )
    notes = [edfio.EdfAnnotation(*m) for m in marks]
    edfio.Edf([signal], patient=who, recording=by, starttime=time(9, 30), data_record_duration=1.0, annotations=notes).write(path)


def read(path: Path, **options: object) -> DecodedFile:
    assert sniff(path) == "edf"
    done = redact(path, path.with_suffix(".clean"), "edf", bytes(32))
    found = decode(path.with_suffix(".clean"), "edf", DecodeOptions(**options))  # type: ignore[arg-type]
    found.reports[0].flagged.extend(done.flagged)
    return found


def amplitude(file: DecodedFile) -> list[float]:
    return [float(v) for v in next(t for t in file.recordings[0].traces if t.stream == "amplitude").values]


def test_nothing_of_the_patient_stays_and_another_reader_still_opens_the_file(tmp_path: Path) -> None:
    write(tmp_path / "a.edf")
    found = read(tmp_path / "a.edf", keep_samples=True)
    clean = (tmp_path / "a.clean").read_bytes()
    assert NAME.encode() not in clean
    assert b"MRN" not in clean
    assert b"1951" not in clean
    again = edfio.read_edf(tmp_path / "a.clean")
    np.testing.assert_allclose(found.recordings[0].samples[0].values, again.signals[0].data, atol=1e-4)
    first, second = (a.text for a in again.annotations)
    assert (first, second[:6], second[-1]) == ("stim on 2 mA", "marker", "…")
    assert NAME not in str(found)


def test_the_local_time_of_the_header_is_a_clock_of_unknown_offset(tmp_path: Path) -> None:
    write(tmp_path / "a.edf")
    (one,) = read(tmp_path / "a.edf").recordings
    assert one.started_at is not None
    assert one.started_at.isoformat().startswith("2026-03-02T09:29:59.996")
    assert one.settings["clock"]["known"] is False
    assert one.hemisphere == "right"


def test_an_annotation_with_a_duration_holds_for_it_alone(tmp_path: Path) -> None:
    write(tmp_path / "a.edf", ((10.0, 10.0, "stim on 2 mA"),))
    got = amplitude(read(tmp_path / "a.edf"))
    assert got[5:10] == [2.0] * 5
    assert all(np.isnan(got[11:]))


def test_a_header_that_contradicts_the_length_keeps_the_whole_records_and_says_so(tmp_path: Path) -> None:
    write(tmp_path / "a.edf")
    (tmp_path / "a.edf").write_bytes((tmp_path / "a.edf").read_bytes()[:-700])
    found = read(tmp_path / "a.edf")
    assert "the header says 40 records, the file has 38" in " ".join(found.reports[0].flagged)
    assert found.recordings[0].duration_s == 38.0


def test_cleaned_annotations_that_are_longer_than_the_original_find_room(tmp_path: Path) -> None:
    # each text grows when it is spelled out
    write(tmp_path / "a.edf", tuple((10 + k / 100, None, "amp=1mA R") for k in range(60)))
    found = read(tmp_path / "a.edf")
    assert sum(e.label == "stim right 1 mA" for e in found.recordings[0].events) == 60


def test_a_channel_without_a_scale_or_a_whole_record_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a.edf", unit="")
    with pytest.raises(UndecodableFile, match="known unit"):
        read(tmp_path / "a.edf")
    write(tmp_path / "b.edf")
    raw = (tmp_path / "b.edf").read_bytes()
    (tmp_path / "b.edf").write_bytes(raw[: read_head(raw).size + 100])
    with pytest.raises(UndecodableFile, match="no whole data record"):
        redact(tmp_path / "b.edf", tmp_path / "clean", "edf", bytes(32))
    assert not (tmp_path / "clean").exists()


@pytest.mark.parametrize(("begin", "text"), [(252, b"x   "), (236, b"many    "), (244, b"long    "), (252, b"9999")])
def test_a_header_with_impossible_numbers_is_no_file_of_ours(begin: int, text: bytes, tmp_path: Path) -> None:
    write(tmp_path / "a.edf")
    raw = bytearray((tmp_path / "a.edf").read_bytes())
    raw[begin : begin + len(text)] = text
    with pytest.raises(UndecodableFile):
        read_head(bytes(raw))


def test_a_table_that_begins_like_the_version_is_no_edf(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("0       1\n" * 100)
    assert sniff(tmp_path / "a.csv") != "edf"


def test_annotations_are_written_as_they_are_read() -> None:
    found = [Annotation(0.0, None, ("",)), Annotation(1.5, 2.0, ("a", "b"))]
    assert read_annotations(write_annotations(found) + b"\0\0\0") == found
