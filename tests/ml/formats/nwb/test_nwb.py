"""NWB files: scales, times, what names a person, what is in another file, and what contradicts itself."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pynwb
import pytest
from pynwb.ecephys import ElectricalSeries

from ml.formats import DecodedFile, DecodeOptions, Redaction, UndecodableFile, decode, redact, sniff
from tests.ml.formats.peers import nwb

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
NAME = "Plantedname"
X = np.random.default_rng(0).normal(0, 3e-6, 10_000)


def write(path: Path, label: str = "LFP L 0-2", place: str = "left STN", head: dict[str, Any] | None = None, **fields: Any) -> None:
    """Write one electrical series of 40 s at 250 Hz."""
    file = nwb.new_file(**(head or {}))
    region = nwb.add_electrodes(file, [label], place)
    given: dict[str, Any] = {"name": "LFP", "data": X[:, None], "electrodes": region, "rate": 250.0, "starting_time": 0.0} | fields
    file.add_acquisition(ElectricalSeries(**{k: v for k, v in given.items() if v is not None}))
    nwb.write(path, file)


def read(path: Path) -> tuple[DecodedFile, Redaction]:
    assert sniff(path) == "nwb"
    done = redact(path, path.with_suffix(".clean"), "nwb", bytes(32))
    return decode(path.with_suffix(".clean"), "nwb", DecodeOptions(keep_samples=True)), done


def test_not_a_byte_of_what_names_a_person_is_stored(tmp_path: Path) -> None:
    person = pynwb.file.Subject(subject_id=f"{NAME}7", description=NAME, date_of_birth=datetime(1951, 2, 3, tzinfo=UTC), sex="F")
    head = {"identifier": NAME, "subject": person, "session_id": NAME, "keywords": [NAME], "protocol": NAME, "surgery": NAME}
    head |= {"experimenter": [f"{NAME}, Ada"], "institution": f"{NAME} hospital", "lab": NAME, "notes": f"{NAME} was tired"}
    file = nwb.new_file(**head)
    file.create_device(f"{NAME} amplifier", description=NAME)
    region = nwb.add_electrodes(file, [f"LFP {NAME}", "LFP L 1-3"], f"{NAME}, left STN")
    series = ElectricalSeries(
        name=f"LFP {NAME}", data=np.column_stack([X, X]), electrodes=region, rate=250.0, description=NAME, comments=NAME, filtering=NAME
    )
    file.create_processing_module(NAME, NAME).add(series)
    file.add_acquisition(pynwb.misc.AnnotationSeries(name=NAME, data=[f"{NAME} says 2 mA"], timestamps=[3.0], description=NAME))
    table = pynwb.epoch.TimeIntervals(name=f"{NAME} table", description=NAME)
    table.add_column(NAME, NAME)
    table.add_interval(start_time=5.0, stop_time=9.0, **{NAME: NAME})
    file.add_time_intervals(table)
    nwb.write(tmp_path / "a.nwb", file)
    found, done = read(tmp_path / "a.nwb")
    clean = (tmp_path / "a.clean").read_bytes()
    assert NAME.encode() in (tmp_path / "a.nwb").read_bytes()
    for word in (NAME, "Ada", "1951", "hospital", "tired", "amplifier"):
        assert word.encode() not in clean
        assert word.encode("utf-16-le") not in clean
    assert NAME not in str(found) + str(done)
    said = " ".join(done.removed)
    assert all(word in said for word in ("subject", "experimenter", "institution", "notes", "session_description", "devices", "names of"))
    (one,) = found.recordings
    assert one.hemisphere == "left"
    assert [e.label for e in one.events] == ["note stim 2 mA", "marker"]


def test_conversion_offset_and_the_factor_of_a_channel_are_applied(tmp_path: Path) -> None:
    raw = np.rint(np.random.default_rng(1).normal(0, 300, (10_000, 1))).astype(np.int16)
    write(tmp_path / "a.nwb", data=raw, conversion=1e-8, offset=2e-4, channel_conversion=[3.0])
    (one,) = read(tmp_path / "a.nwb")[0].recordings
    np.testing.assert_allclose(one.samples[0].values, 1e6 * (raw[:, 0] * 1e-8 * 3 + 2e-4), rtol=1e-6)
    assert one.samples[0].unit == "uV"
    for name, value in (("conversion", 1e-8), ("offset", 2e-4)):
        write(tmp_path / "b.nwb", data=raw, **{name: value, "conversion": 1e-8})
        (other,) = read(tmp_path / "b.nwb")[0].recordings
        np.testing.assert_allclose(other.samples[0].values, 1e6 * (raw[:, 0] * 1e-8 + (value if name == "offset" else 0)), rtol=1e-6)


def test_the_start_has_its_offset_from_utc(tmp_path: Path) -> None:
    write(tmp_path / "a.nwb", starting_time=7.5)
    (one,) = read(tmp_path / "a.nwb")[0].recordings
    assert one.started_at is not None
    assert one.started_at.isoformat().startswith("2026-03-02T08:30:07.496")
    assert one.settings["utc_offset_h"] == 1.0
    assert "clock" not in one.settings


def test_samples_stay_as_small_as_they_were_packed(tmp_path: Path) -> None:
    zeros = np.tile(np.rint(1e3 * np.sin(np.arange(250) / 5)), 400)[:, None].astype(np.int16)
    write(tmp_path / "a.nwb", data=pynwb.H5DataIO(zeros, compression="gzip", chunks=(10_000, 1)), conversion=1e-8)
    read(tmp_path / "a.nwb")
    assert (tmp_path / "a.clean").stat().st_size < 100_000 < zeros.nbytes


def test_a_clock_that_steps_back_puts_no_sample_twice_at_one_time(tmp_path: Path) -> None:
    t = np.arange(10_000) / 250
    t[6000:] -= 0.2
    write(tmp_path / "a.nwb", timestamps=t, rate=None, starting_time=None)
    found, _ = read(tmp_path / "a.nwb")
    (log,) = found.recordings[0].samples
    assert np.all(np.diff(log.t_s) > 0)
    np.testing.assert_allclose(log.values[-3000:], 1e6 * X[-3000:], rtol=1e-5)
    assert log.t_s[-1] == pytest.approx(40.0 - 0.2, abs=1e-6)
    assert any("steps back by 0.2 s" in s for s in found.reports[0].flagged)


def test_an_amplitude_that_holds_for_its_interval_holds_through_a_gap_and_not_after_it(tmp_path: Path) -> None:
    file = nwb.new_file()
    region = nwb.add_electrodes(file, ["LFP L 0-2"], "left STN")
    t = np.arange(10_000) / 250
    t[3000:] += 4
    file.add_acquisition(ElectricalSeries(name="LFP", data=X[:, None], electrodes=region, timestamps=t))
    table = pynwb.epoch.TimeIntervals(name="stimulation", description="on")
    table.add_column("amplitude_ma", "current")
    table.add_interval(start_time=4.0, stop_time=30.0, amplitude_ma=2.5)
    file.add_time_intervals(table)
    nwb.write(tmp_path / "a.nwb", file)
    (one,) = read(tmp_path / "a.nwb")[0].recordings
    amplitude = next(t for t in one.traces if t.stream == "amplitude").values
    np.testing.assert_allclose(amplitude[2:15], 2.5)
    assert np.isnan(amplitude[15:]).all()
    assert np.isnan(amplitude[:2]).all()


def test_two_series_of_one_name_are_both_kept_and_numbered(tmp_path: Path) -> None:
    file = nwb.new_file()
    region = nwb.add_electrodes(file, ["LFP L 0-2"], "left STN")
    file.add_acquisition(ElectricalSeries(name="LFP", data=X[:, None], electrodes=region, rate=250.0))
    module = file.create_processing_module("ecephys", "again")
    module.add(ElectricalSeries(name="LFP", data=2 * X[:, None], electrodes=region, rate=250.0))
    nwb.write(tmp_path / "a.nwb", file)
    found, _ = read(tmp_path / "a.nwb")
    assert [s.channel for s in found.recordings[0].samples] == ["STN LFP L +0-2", "STN LFP L +0-2 (2)"]
    assert "names of channels are there more than once" in " ".join(found.reports[0].flagged)


@pytest.mark.parametrize(
    ("label", "place", "side", "channel"),
    [
        ("", "right STN", "right", "right STN electrode 0"),
        ("LFP R 0-2", "left STN", None, "STN LFP R +0-2"),
        ("LFP1", "Globus pallidus internus, left", "left", "left GPi LFP1"),
        ("", "M. L. Smith", None, "electrode 0"),
    ],
)
def test_side_and_target_come_from_the_table_of_electrodes(label: str, place: str, side: str, channel: str, tmp_path: Path) -> None:
    write(tmp_path / "a.nwb", label=label, place=place)
    (one,) = read(tmp_path / "a.nwb")[0].recordings
    assert (one.hemisphere, one.samples[0].channel) == (side, channel)


def test_a_sensor_in_volts_is_no_field_potential_unless_its_name_says_so(tmp_path: Path) -> None:
    file = nwb.new_file()
    file.add_acquisition(pynwb.TimeSeries(name="photodiode", data=X, unit="volts", rate=250.0))
    nwb.write(tmp_path / "a.nwb", file)
    with pytest.raises(UndecodableFile, match="no channel of a local field potential"):
        read(tmp_path / "a.nwb")
    file = nwb.new_file()
    file.add_acquisition(pynwb.TimeSeries(name="LFP left", data=X, unit="volts", rate=250.0))
    nwb.write(tmp_path / "b.nwb", file)
    assert read(tmp_path / "b.nwb")[0].recordings[0].hemisphere == "left"


def _link_out(path: Path, how: str) -> None:
    """Put the samples of a file into another one."""
    write(path)
    with h5py.File(path.with_name("samples.h5"), "w") as other:
        other["x"] = X[:, None]
    with h5py.File(path, "r+") as file:
        place = file["acquisition/LFP"]
        kept = dict(place["data"].attrs)
        del place["data"]
        if how == "link":
            place["data"] = h5py.ExternalLink("samples.h5", "x")
        elif how == "storage":
            data = place.create_dataset("data", (1000, 1), "f8", external=[(str(path.with_name("samples.h5")), 0, 8000)])
        else:
            layout = h5py.VirtualLayout((10_000, 1), "f8")
            layout[:] = h5py.VirtualSource(str(path.with_name("samples.h5")), "x", (10_000, 1))
            data = place.create_virtual_dataset("data", layout)
        if how != "link":
            data.attrs.update(kept)


@pytest.mark.parametrize("how", ["link", "storage", "virtual"])
def test_samples_in_another_file_are_refused_with_their_place_and_what_to_do(how: str, tmp_path: Path) -> None:
    _link_out(tmp_path / "a.nwb", how)
    with pytest.raises(UndecodableFile, match="in another file, which was not sent") as error:
        read(tmp_path / "a.nwb")
    assert error.value.where == "/acquisition/LFP/data"
    assert "acquisition" not in error.value.stored_where
    assert "Copy the samples into the file" in error.value.hint
    assert not (tmp_path / "a.clean").exists()


def test_a_video_in_another_file_is_reported_and_the_signal_is_read(tmp_path: Path) -> None:
    file = nwb.new_file()
    region = nwb.add_electrodes(file, ["LFP L 0-2"], "left STN")
    file.add_acquisition(ElectricalSeries(name="LFP", data=X[:, None], electrodes=region, rate=250.0))
    file.add_acquisition(pynwb.image.ImageSeries(name="hand", external_file=[f"{NAME}.mp4"], format="external", rate=30.0, num_samples=3))
    nwb.write(tmp_path / "a.nwb", file)
    found, done = read(tmp_path / "a.nwb")
    assert len(found.recordings) == 1
    assert any("pictures, videos" in s for s in done.ignored)
    assert NAME.encode() not in (tmp_path / "a.clean").read_bytes()


@pytest.mark.parametrize("share", [0.02, 0.3, 0.95])
def test_a_cut_file_is_refused_with_both_lengths_and_nothing_is_written(share: float, tmp_path: Path) -> None:
    write(tmp_path / "a.nwb")
    raw = (tmp_path / "a.nwb").read_bytes()
    (tmp_path / "a.nwb").write_bytes(raw[: int(share * len(raw))])
    with pytest.raises(UndecodableFile, match=f"cut: {int(share * len(raw))} of {len(raw)} bytes"):
        read(tmp_path / "a.nwb")
    assert not (tmp_path / "a.clean").exists()


def test_damaged_bytes_end_in_a_sentence_or_in_the_same_numbers(tmp_path: Path) -> None:
    write(tmp_path / "a.nwb", data=pynwb.H5DataIO(X[:, None], compression="gzip", fletcher32=True))
    raw = (tmp_path / "a.nwb").read_bytes()
    whole = read(tmp_path / "a.nwb")[0].recordings[0].samples[0].values
    rng = np.random.default_rng(0)
    for _ in range(40):
        broken = bytearray(raw)
        for at in rng.integers(0, len(raw), 20):
            broken[at] ^= int(rng.integers(1, 256))
        (tmp_path / "b.nwb").write_bytes(broken)
        try:
            found, _ = read(tmp_path / "b.nwb")
        except UndecodableFile:
            continue
        values = found.recordings[0].samples[0].values
        assert values.size == whole.size


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda f: f.__delitem__("acquisition/LFP/starting_time"), "neither timestamps nor"),
        (lambda f: f["acquisition/LFP/starting_time"].attrs.__setitem__("rate", np.nan), "no finite number"),
        (lambda f: f["acquisition/LFP/data"].attrs.__setitem__("conversion", 0.0), "conversion"),
        (lambda f: f["acquisition/LFP"].create_dataset("timestamps", data=np.arange(7.0)), "7 timestamps"),
        (lambda f: f["acquisition/LFP"].create_dataset("channel_conversion", data=np.ones(3)), "channel_conversion has 3"),
        (lambda f: f.attrs.__setitem__("neurodata_type", "Other"), "none of NWB 2"),
    ],
)
def test_a_series_that_contradicts_itself_is_named_with_what_is_wrong(change: Any, says: str, tmp_path: Path) -> None:
    write(tmp_path / "a.nwb")
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        change(file)
    with pytest.raises(UndecodableFile, match=re.escape(says)):
        read(tmp_path / "a.nwb")
