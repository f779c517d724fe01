"""Real recordings against the numbers of the format notes."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from ml.formats import DecodeOptions, FileReport, decode
from ml.formats.archive import ZipFiles
from ml.formats.rcs.folder import _interval_at, _records, _stream, decode_rcs, find_sessions, read_streams
from ml.formats.rcs.outliers import power_spikes
from ml.formats.rcs.packets.streams import read_adaptive, read_power, read_time_domain
from ml.formats.rcs.packets.ticks import device_ms
from ml.formats.rcs.packets.time import reconstruct
from ml.formats.rcs.settings import follow

MEDIAN_BAND_1 = {0: 454, 0.3: 357, 0.6: 237, 0.8: 200, 0.9: 173, 1.1: 156, 1.3: 173, 1.6: 151, 1.9: 127, 2.2: 129, 2.4: 125}


def opened(path: Path):
    files = ZipFiles(path, DecodeOptions().archive)
    session = find_sessions(files, FileReport("test"))[0]
    settings = follow(_records(session, files, "DeviceSettings", []), _records(session, files, "StimLog", []))
    return files, session, settings


def stream(path: Path, stem: str, read):
    files, session, settings = opened(path)
    return _stream(session, files, stem, [], lambda packets: read(packets, settings)), settings


def read_bands(packets, settings):
    return read_power(packets, _interval_at(settings))


def one(decoded):
    (recording,) = decoded.recordings
    return recording


def report(decoded, name):
    return next(r for r in decoded.reports if r.name.endswith(name))


@pytest.fixture(scope="session")
def sweep(recordings):
    return one(decode(recordings / "rcs/stim_sweep.zip"))


@pytest.fixture(scope="session")
def adaptive(recordings):
    return one(decode(recordings / "rcs/embedded_adaptive.zip"))


def test_the_sweep_has_its_fourteen_states_of_therapy_and_amplitude(sweep):
    steps = [e for e in sweep.events if e.kind == "stimulation"]
    found = [(e.data["therapy_on"], e.data["programs"][0]["amplitude_ma"]) for e in steps]
    assert found == [(False, 1.0), (True, 1.0)] + [(True, a) for a in (0, 0.3, 0.8, 0.6, 0.9, 1.1, 1.3, 1.6, 1.9, 2.2, 2.4, 1.0)]
    assert len(found) == 14
    assert steps[0].data["delivered_ma"][0] == 0.0
    assert {e.data["rate_hz"] for e in steps} == {130.2}
    assert {e.data["programs"][0]["pulse_width_us"] for e in steps} == {60.0}


def test_the_median_power_of_band_1_falls_with_the_amplitude_as_in_the_notes(recordings, sweep):
    power, settings = stream(recordings / "rcs/stim_sweep.zip", "RawDataPower", read_bands)
    times = reconstruct(power.headers)
    amplitude = np.array([settings.therapy.at(t).programs[0].amplitude_ma for t in times.last_ms])
    medians = {a: float(np.median(power.bands[amplitude == a, 0])) for a in MEDIAN_BAND_1}
    assert {a: round(m) for a, m in medians.items()} == pytest.approx(MEDIAN_BAND_1, abs=3)
    band = next(t for t in sweep.traces if t.channel == "band 1 17.8-22.2 Hz")
    assert (band.unit, band.source, band.stream) == ("device units", "device_power", "band_power")
    assert (band.details["low_hz"], band.details["high_hz"]) == (17.822, 22.217)


def test_the_two_second_rows_of_the_sweep_show_the_same_dose_response(sweep):
    band = next(t for t in sweep.traces if t.channel.startswith("band 1 "))
    amplitude = next(t for t in sweep.traces if t.stream == "amplitude")
    assert band.values.shape == amplitude.values.shape == (222,)
    assert amplitude.unit == "mA"
    held = np.diff(amplitude.values, prepend=np.nan) == 0
    steady = [np.median(band.values[band.valid & held & np.isclose(amplitude.values, a)]) for a in (0, 0.6, 1.1, 2.4)]
    assert steady == sorted(steady, reverse=True)
    assert steady[0] > 3 * steady[-1]


def test_the_amplifiers_own_step_after_switching_on_is_left_out(sweep):
    band = next(t for t in sweep.traces if t.channel.startswith("band 1 "))
    assert not band.valid[0]
    assert band.valid[1:16].all()
    assert np.nanmax(band.values[:16]) < 5000


def test_spikes_at_amplitude_steps_are_marked_and_reach_no_row(recordings, sweep):
    bands = [t for t in sweep.traces if t.stream == "band_power"]
    power, _ = stream(recordings / "rcs/stim_sweep.zip", "RawDataPower", read_bands)
    for band in bands:
        raw = power.bands[:, band.details["band"] - 1]
        assert np.nanmax(raw) > 100 * np.nanmax(band.values)
        assert np.nanmax(band.values) < 20 * np.nanmedian(band.values)
        assert band.details["spike_packets"] == sweep.quality["spike_packets"][band.channel] == 281
        assert set(np.flatnonzero(~band.valid)) - {0} <= set(band.details["spike_rows"])
    steps = [e.t_s for e in sweep.events if e.kind == "stimulation" and e.t_s > 30]
    rows = np.array(bands[0].details["spike_rows"])
    near = [any(abs(2.0 * row + 1.0 - t) < 4.0 for t in steps) for row in rows]
    assert np.mean(near) > 0.9
    said = next(r for r in decode(recordings / "rcs/stim_sweep.zip").reports if r.name == "RawDataPower.json")
    assert any("281 packets with power spikes in 25 rows became gaps" in text for text in said.flagged)


def test_the_medians_per_amplitude_hold_without_the_spikes_too(recordings, sweep):
    power, settings = stream(recordings / "rcs/stim_sweep.zip", "RawDataPower", read_bands)
    times = reconstruct(power.headers)
    amplitude = np.array([settings.therapy.at(t).programs[0].amplitude_ma for t in times.last_ms])
    kept = ~power_spikes(power.bands[:, 0], 0.1, 2.048)
    medians = {a: float(np.median(power.bands[(amplitude == a) & kept, 0])) for a in MEDIAN_BAND_1}
    for a, median in medians.items():
        assert median == pytest.approx(MEDIAN_BAND_1[a], rel=0.1)


def test_the_bench_recording_of_six_ramps_has_no_spike(adaptive):
    band = next(t for t in adaptive.traces if t.stream == "band_power")
    assert band.details["spike_packets"] == 0
    assert adaptive.quality["spike_packets"] == {}


def test_the_hemisphere_is_that_of_the_leads(sweep, adaptive, recordings):
    assert (sweep.hemisphere, adaptive.hemisphere) == ("right", "right")
    montage = one(decode(recordings / "rcs/montage_packet_loss.zip"))
    assert (montage.hemisphere, montage.settings["leads"]) == ("left", ["left STN", "", "left M1", ""])


def test_the_battery_is_told_in_percent_and_volt(adaptive):
    assert adaptive.settings["battery"] == {"percent": 73.0, "voltage_v": 2.415}


def test_movement_clocks_and_errors_are_told(sweep, adaptive):
    movement = next(t for t in sweep.traces if t.stream == "acceleration")
    assert (movement.unit, movement.values.shape) == ("centiG", (222,))
    assert movement.valid.mean() > 0.99
    assert 0.5 < np.nanmedian(movement.values) < 5
    assert sweep.quality["accel"]["packets"] == 3617
    assert (sweep.quality["time_sync"]["packets"], sweep.quality["time_sync"]["latency_median_ms"]) == (446, 36.183)
    assert abs(sweep.quality["clock"]["drift_ppm"]) < 100
    assert (sweep.quality["errors"], adaptive.quality["errors"]) == (3, 2)


def test_four_of_the_twenty_two_notes_disagree_with_the_device(sweep):
    notes = [e for e in sweep.events if e.kind == "operator_note"]
    assert len(notes) == 22
    wrong = [(e.data["amplitude_ma"], e.data["device_amplitude_ma"]) for e in notes if e.data["conflict"]]
    assert wrong == [(0.0, 0.3), (0.0, 0.3), (0.6, 0.9), (0.6, 0.9)]
    assert notes[0].label == "start, 0 mA, 130.2 Hz, 60 us, group A"


def test_the_limits_of_the_sweep_are_those_of_enabled_programs_only(sweep):
    assert sweep.limits["group A"] == {"program 0": {"lower_ma": 0.0, "upper_ma": 3.4}}


def test_with_the_interval_in_force_the_sweep_has_no_false_gaps(sweep):
    assert sweep.quality["power"]["missing"] == 11
    assert sweep.quality["power"]["chunks"] == 12
    assert sweep.clock == "pc"


def test_device_power_is_the_detectors_input_in_every_packet(recordings):
    path = recordings / "rcs/embedded_adaptive.zip"
    power, _ = stream(path, "RawDataPower", read_bands)
    log, _ = stream(path, "AdaptiveLog", lambda packets, settings: read_adaptive(packets, _interval_at(settings)))
    ours = dict(zip(zip(power.headers.seconds, power.headers.tick, strict=True), power.bands[:, 0], strict=True))
    theirs = dict(zip(zip(log.headers.seconds, log.headers.tick, strict=True), log.ld0_inputs[:, 0], strict=True))
    assert len(ours) == len(theirs) == 547
    assert ours == theirs
    np.testing.assert_array_equal(log.state == 2, log.ld0_output > 150_000)


def test_the_adaptive_states_change_when_they_did(adaptive):
    changes = [e for e in adaptive.events if e.kind == "adaptive_state"]
    first = changes[0].t_s
    assert [c.data["state"] for c in changes] == [0, 2, 0, 2, 0, 2, 0]
    assert [c.t_s - first for c in changes[1:]] == pytest.approx([10.1, 15.1, 25.1, 30.1, 40.2, 45.0], abs=0.11)


def test_under_embedded_adaptive_the_adaptive_log_gives_the_amplitude(adaptive):
    trace = next(t for t in adaptive.traces if t.stream == "amplitude")
    assert trace.details["origin"] == "AdaptiveLog"
    top = trace.values[trace.valid] > 5.9
    assert int(np.sum(np.diff(top.astype(int)) == 1)) == 3
    assert np.nanmax(trace.values) == pytest.approx(6.0)
    assert np.nanmin(trace.values) == 0.0


def test_beta_from_the_time_domain_follows_the_devices_own_band(recordings):
    options = DecodeOptions(beta_low_hz=18.6, beta_high_hz=22.5)
    recording = one(decode(recordings / "rcs/embedded_adaptive.zip", options=options))
    beta = next(t for t in recording.traces if t.stream == "beta_power")
    band = next(t for t in recording.traces if t.stream == "band_power")
    both = beta.valid & band.valid
    assert both.sum() == 27
    assert np.corrcoef(beta.values[both], band.values[both])[0, 1] > 0.95
    assert (beta.unit, beta.source, beta.details["low_hz"]) == ("uV2", "time_domain", 18.6)


def test_the_devices_band_power_is_reproduced_from_the_placed_time_domain(recordings):
    """The device's window ends some 32 ms before its packet's tick; u, gain and scale are those of the format notes, A.11."""
    path = recordings / "rcs/embedded_adaptive.zip"
    data, _ = stream(path, "RawDataTD", lambda packets, settings: read_time_domain(packets))
    power, _ = stream(path, "RawDataPower", read_bands)
    td_ms, power_ms = reconstruct(data.headers).last_ms, reconstruct(power.headers).last_ms
    start_ms = td_ms[0] - 2.0 * (data.headers.samples[0] - 1)
    units = data.samples[0] * (250 * 236 / 255) * 48644.8683623726 / 1200
    last = np.rint((power_ms - 32.0 - start_ms) / 2.0).astype(int) + 1
    usable = np.flatnonzero((last >= 250) & (last <= units.size) & (np.arange(last.size) >= 20))
    spectra = [np.fft.rfft(units[last[i] - 250 : last[i]] * np.hanning(250), 256) for i in usable]
    ours = np.floor(64 * np.abs(np.array(spectra)[:, 10:12]) ** 2 / 256**2 / 2).sum(axis=1)
    theirs = power.bands[usable, 0]
    assert usable.size > 500
    assert np.corrcoef(ours, theirs)[0, 1] > 0.999
    assert 0.98 < np.polyfit(theirs, ours, 1)[0] < 1.02


def test_the_montage_lacks_23_per_cent_of_its_signal_in_303_chunks(recordings):
    decoded = decode(recordings / "rcs/montage_packet_loss.zip")
    quality = one(decoded).quality["time_domain"]
    assert quality["packets"] == 2156
    assert quality["chunks"] == 303
    assert (quality["loss"], quality["missing_s"], quality["paused_s"]) == (0.2325, 47.255, 3.402)
    assert any("23.3 % of the signal is missing (47.3 s; 335 packets lost)" in text for text in report(decoded, "RawDataTD.json").flagged)


@pytest.mark.parametrize("name", ["montage_packet_loss", "stim_sweep", "embedded_adaptive"])
def test_packets_of_people_lie_on_the_ticks_and_none_is_dropped(recordings, name):
    with ZipFiles(recordings / f"rcs/{name}.zip", DecodeOptions().archive) as files:
        (session,) = find_sessions(files, FileReport(name))
        streams = read_streams(session, files)
    timeline, _ = streams.placed()
    for stream, headers in streams.headers().items():
        placed = timeline.streams[stream]
        assert np.isfinite(placed.last_ms).all()
        off = placed.last_ms - timeline.clock.timeline_ms(device_ms(headers))
        off -= np.median(off)
        # those that carry the tick of the packet after them are put back
        assert int(np.sum(np.abs(off) > 50)) == placed.moved
        assert np.percentile(np.abs(off), 99) < (9.0 if stream == "accel" else 2.5)
        if stream == "accel":
            assert placed.moved == {"montage_packet_loss": 8, "stim_sweep": 2, "embedded_adaptive": 0}[name]


def test_the_montage_keeps_contact_pairs_apart_and_shows_gaps(recordings):
    recording = one(decode(recordings / "rcs/montage_packet_loss.zip"))
    beta = {t.channel: t for t in recording.traces if t.stream == "beta"}
    assert {"key 0 +2-0", "key 0 +1-0", "key 2 +10-8"} <= set(beta)
    stn, cortex = beta["key 0 +2-0"], beta["key 2 +10-8"]
    assert 1 < np.nanmedian(stn.values) < 6
    assert 10 < np.nanmedian(cortex.values) < 60
    assert np.isnan(stn.values[~stn.valid]).all()
    assert not (beta["key 0 +2-0"].valid & beta["key 0 +1-0"].valid).any()
    amplitude = next(t for t in recording.traces if t.stream == "amplitude")
    assert np.all(amplitude.values[amplitude.valid] == 0)


def test_the_spectra_of_the_montage_peak_in_beta_8_to_11_db_above_the_background(recordings):
    spectra = {s.channel: s for s in one(decode(recordings / "rcs/montage_packet_loss.zip")).spectra}
    assert len(spectra) == 13
    for channel in ("key 0 +2-0", "key 0 +3-0"):
        hz, db = spectra[channel].hz, 10 * np.log10(spectra[channel].density)
        assert (hz[1] - hz[0], hz[-1], spectra[channel].unit) == (1.0, 100.0, "uV2/Hz")
        background = ((hz >= 5) & (hz <= 12)) | ((hz >= 40) & (hz <= 90))
        line = np.polyval(np.polyfit(np.log10(hz[background]), db[background], 1), np.log10(np.maximum(hz, 1)))
        beta = np.flatnonzero((hz >= 13) & (hz <= 35))
        peak = beta[np.argmax((db - line)[beta])]
        assert 24 <= hz[peak] <= 29
        assert 8 < (db - line)[peak] < 11.5


def test_a_recording_without_data_is_a_recording_and_says_so(recordings):
    decoded = decode(recordings / "rcs/empty_streams.zip")
    recording = one(decoded)
    assert recording.traces == ()
    assert recording.duration_s == 0
    assert "holds no data" in decoded.reports[0].flagged[0]
    assert any("without data" in text for text in report(decoded, "RawDataTD.json").flagged)


@pytest.mark.parametrize(
    ("name", "packets", "said"),
    [
        ("RawDataTD_INF_token.json", 279, "INF in place of a number"),
        ("RawDataTD_cut_mid_packet.json", 278, "is cut"),
        ("RawDataTD_duplicate_packet.json", 280, "the same packet twice"),
        ("RawDataTD_gap7packets.json", 272, "; 7 packets lost"),
    ],
)
def test_every_complete_packet_of_a_malformed_file_is_kept_and_the_defect_said(recordings, tmp_path, name, packets, said):
    shutil.copy(recordings / "rcs/malformed" / name, tmp_path / "RawDataTD.json")
    decoded = decode_rcs(tmp_path, DecodeOptions())
    assert one(decoded).quality["time_domain"]["packets"] == packets
    about = report(decoded, "RawDataTD.json")
    assert any(said in text for text in (*about.repaired, *about.flagged))


def test_the_duplicate_counts_once(recordings, tmp_path):
    shutil.copy(recordings / "rcs/malformed/RawDataTD_duplicate_packet.json", tmp_path / "RawDataTD.json")
    quality = one(decode_rcs(tmp_path, DecodeOptions())).quality["time_domain"]
    assert quality["rejected"] == {"duplicate": 1}
    assert quality["packets"] - 1 == 279


def test_a_stimulation_log_without_its_closing_bracket_keeps_its_six_records(recordings, tmp_path):
    shutil.copy(recordings / "rcs/malformed/StimLog_missing_bracket.json", tmp_path / "StimLog.json")
    decoded = decode_rcs(tmp_path, DecodeOptions())
    about = report(decoded, "StimLog.json")
    assert "6 records" in about.understood
    assert any("end of the file is missing" in text for text in about.flagged)
