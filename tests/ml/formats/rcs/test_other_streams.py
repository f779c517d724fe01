"""Accelerometer, on-device spectra, clock exchanges, leads and logs of sessions written here."""

from __future__ import annotations

import numpy as np
import pytest

from ml.formats import decode

FOLDER = "Session1700000000000/DeviceNPC799999H/"


def one(decoded):
    (recording,) = decoded.recordings
    return recording


def trace(recording, stream):
    return next(t for t in recording.traces if t.stream == stream)


def packets(rcs, body, interval_s, count, drop=()):
    """Build packets numbered from 0 that end at multiples of the interval; `body` gives the fields of each."""
    out = []
    for i in range(count):
        t_s = (i + 1) * interval_s
        if i not in drop:
            clock = {"seconds": 700_000_000 + int(3.0 + t_s)}
            head = {"dataTypeSequence": i % 256, "systemTick": round((3.0 + t_s) * 10_000) % 65_536, "timestamp": clock}
            ms = rcs.start_ms + round(1000 * t_s)
            out.append({"Header": head, "PacketGenTime": ms, "PacketRxUnixTime": ms + 40, **body(i)})
    return out


def accel(rcs, seconds=20.0, amplitude=3.0, drop=()):
    rate = 65.104
    t = np.arange(int(seconds * rate / 8) * 8) / rate
    x, y, z = amplitude * np.sin(2 * np.pi * 5.0 * t), np.full(t.size, 7.0), np.full(t.size, -98.0)

    def body(i):
        part = slice(8 * i, 8 * i + 8)
        return {
            "SampleRate": 0,
            "Units": "centiG",
            **{n: v[part].round(4).tolist() for n, v in zip(("XSamples", "YSamples", "ZSamples"), (x, y, z), strict=True)},
        }

    return [{"RecordInfo": {}, "AccelData": packets(rcs, body, 8 / rate, t.size // 8, drop)}]


def fft(rcs, amplitude_mv, bins=64, size=256, rate=250.0, count=40):
    """Compute spectra as the device makes them: 4 |FFT| / N of 250 samples under a Hann window, padded to 256; a sine in the middle of a
    bin.
    """
    n = {256: 250}[size]
    hz = 26 * rate / size
    spectrum = 4 * np.abs(np.fft.rfft(amplitude_mv * np.sin(2 * np.pi * hz * np.arange(n) / rate) * np.hanning(n), size)) / size
    values = spectrum[:bins].tolist()
    body = {"Channel": 1, "FftOutput": values, "FftSize": 1, "SampleRate": 0, "Units": "millivolts"}
    return [{"RecordInfo": {}, "FftData": packets(rcs, lambda i: body, 0.5, count)}], hz


def test_movement_is_the_rms_without_gravity(rcs, pack):
    recording = one(decode(pack({FOLDER + "RawDataAccel.json": accel(rcs)})))
    movement = trace(recording, "acceleration")
    assert (movement.unit, movement.values.size, movement.details["rates_hz"]) == ("centiG", 10, [65.104])
    np.testing.assert_allclose(movement.values[movement.valid], 3.0 / np.sqrt(2), rtol=0.03)
    assert recording.duration_s == pytest.approx(20.0, abs=0.2)


def test_lost_movement_is_a_gap_and_counted(rcs, pack):
    recording = one(decode(pack({FOLDER + "RawDataAccel.json": accel(rcs, drop=range(33, 49))})))
    assert np.flatnonzero(~trace(recording, "acceleration").valid).tolist() == [2]
    assert recording.quality["accel"]["missing"] == 16
    assert recording.quality["accel"]["chunks"] == 2


def test_movement_neither_moves_nor_lengthens_the_grid_of_the_neural_signal(rcs, pack):
    td = rcs.time_domain(0.02 * np.sin(2 * np.pi * 22 * np.arange(5000) / 500))
    alone = one(decode(pack({FOLDER + "RawDataTD.json": td}, "a.zip")))
    both = one(decode(pack({FOLDER + "RawDataTD.json": td, FOLDER + "RawDataAccel.json": accel(rcs, 40.0)}, "b.zip")))
    assert (both.started_at, both.duration_s, both.fingerprint) == (alone.started_at, alone.duration_s, alone.fingerprint)
    assert trace(both, "acceleration").values.size == trace(both, "beta").values.size == 5


def test_two_recordings_of_movement_alone_are_two(rcs, pack):
    files = {"DeviceA/RawDataAccel.json": accel(rcs), "DeviceB/RawDataAccel.json": accel(rcs, 12.0)}
    assert len(decode(pack(files)).recordings) == 2


def test_a_sine_in_the_devices_own_spectrum_has_its_rms_in_the_band(rcs, pack):
    written, hz = fft(rcs, amplitude_mv=0.02)
    recording = one(decode(pack({FOLDER + "RawDataFFT.json": written})))
    band = trace(recording, "band_amplitude")
    assert (band.unit, band.source, band.details["channel_key"]) == ("uV", "device_power", 1)
    assert band.valid.mean() > 0.9
    np.testing.assert_allclose(band.values[band.valid], 20 / np.sqrt(2), rtol=0.02)
    (spectrum,) = recording.spectra
    assert spectrum.hz[np.argmax(spectrum.density)] == hz
    assert spectrum.density.sum() * 250 / 256 == pytest.approx(200.0, rel=0.02)


def test_clock_exchanges_give_latency_and_drift(rcs, pack):
    sync = packets(rcs, lambda i: {"LatencyMilliseconds": 30.0 + (i == 7) * 500}, 1.0, 120)
    for i, packet in enumerate(sync):
        packet["PacketGenTime"] += round(0.2 * i)  # the device's second is 1.0002 s of the PC
    quality = one(decode(pack({FOLDER + "TimeSync.json": [{"RecordInfo": {}, "TimeSyncData": sync}]}))).quality
    assert quality["time_sync"]["latency_median_ms"] == 30.0
    assert quality["clock"]["drift_ppm"] == pytest.approx(-200, abs=12)


def test_clock_exchanges_too_few_to_tell_give_no_drift(rcs, pack):
    sync = packets(rcs, lambda i: {}, 1.0, 10)
    quality = one(decode(pack({FOLDER + "TimeSync.json": [{"RecordInfo": {}, "TimeSyncData": sync}]}))).quality
    assert (quality["time_sync"]["latency_median_ms"], quality["clock"]["drift_ppm"]) == (None, None)


def test_errors_of_the_device_are_counted_without_their_texts(rcs, pack):
    errors = [{"RecordInfo": {}, "Error": {"Descriptor": "Ada Lovelace", "RejectCode": 14}}] * 3
    decoded = decode(pack({FOLDER + "ErrorLog.json": errors, FOLDER + "StimLog.json": rcs.stim((0, rcs.program(1.0)))}))
    assert one(decoded).quality["errors"] == 3
    assert any("the device reported 3 errors" in text for r in decoded.reports for text in r.flagged)
    assert "Lovelace" not in repr(decoded)


def power(rcs, values, **fields):
    body = {"Bands": [*[0] * 8], "ValidDataMask": 1, "FftSize": 1, "SampleRate": 1, "IsPowerChannelOverrange": False}
    return [
        {"RecordInfo": {}, "PowerDomainData": packets(rcs, lambda i: body | {"Bands": [values[i], *[0] * 7]} | fields, 0.1, len(values))}
    ]


def test_power_over_range_is_a_gap_and_counted(rcs, pack):
    written = power(rcs, [200] * 200)
    for packet in written[0]["PowerDomainData"][40:60]:
        packet["IsPowerChannelOverrange"] = True
    decoded = decode(pack({FOLDER + "RawDataPower.json": written}))
    assert np.flatnonzero(~trace(one(decoded), "band_power").valid).tolist() == [2]
    assert one(decoded).quality["power"]["over_range"] == 20
    assert any("20 packets over range" in text for r in decoded.reports for text in r.flagged)


def test_a_power_spike_is_kept_out_of_its_row_and_told(rcs, pack):
    values = np.random.default_rng(0).chisquare(40, 600).round().astype(int).tolist()
    values[300:303] = [1_000_000] * 3
    values[400:412] = [1_000_000] * 12
    recording = one(decode(pack({FOLDER + "RawDataPower.json": power(rcs, values)})))
    band = trace(recording, "band_power")
    assert np.nanmax(band.values) < 60
    assert (band.details["spike_packets"], band.details["spike_rows"]) == (15, [15, 20])
    assert np.flatnonzero(~band.valid).tolist() == [20]
    assert recording.quality["spike_packets"] == {band.channel: 15}


def test_the_side_of_two_implants_is_told_apart(rcs, pack):
    files = {}
    for code, (side, serial) in enumerate((("Left STN", "A"), ("STN", "B")), start=1):
        settings = rcs.settings()
        settings[0]["SubjectInfo"] |= {"LeadTargets": [side, "", "", ""], "LeadLocation": [code, 0, 0, 0]}
        files[f"Session1/Device{serial}/DeviceSettings.json"] = settings
        files[f"Session1/Device{serial}/RawDataTD.json"] = rcs.time_domain(np.full(5000, 0.01 * code))
    decoded = decode(pack(files))
    assert [r.hemisphere for r in decoded.recordings] == ["left", "right"]
    assert len({r.fingerprint for r in decoded.recordings}) == 2


@pytest.mark.parametrize("folder", ["", "some folder/", "a/b/c/"])
def test_loose_files_at_any_level_are_one_recording_however_few(rcs, pack, folder):
    td = rcs.time_domain(0.02 * np.sin(2 * np.pi * 22 * np.arange(5000) / 500))
    files = {f"{folder}RawDataTD.json": td, f"{folder}RawDataPower.json": [], f"{folder}TimeSync.json": "[]"}
    recording = one(decode(pack(files)))
    np.testing.assert_allclose(trace(recording, "beta").values, 20 / np.sqrt(2), rtol=0.01)
