"""Sessions written here, so that every number is known."""

from __future__ import annotations

import numpy as np
import pytest

from ml.formats import ArchiveLimits, DecodeOptions, UndecodableFile, decode
from ml.formats.rcs.labels import parse, render

FOLDER = "Session1700000000000/DeviceNPC799999H/"


def sine_mv(seconds, hz=22.0, amplitude=0.02, rate=500):
    return amplitude * np.sin(2 * np.pi * hz * np.arange(int(seconds * rate)) / rate)


def session(rcs, seconds=20.0, folder=FOLDER, lost=(), **files):
    content = {
        "DeviceSettings": rcs.settings(),
        "RawDataTD": rcs.time_domain(sine_mv(seconds), lost=lost),
        "StimLog": rcs.stim((-4, {"therapyStatusData": {"therapyStatus": 1, "activeGroup": 0}, **rcs.program(1.0)}), (5, rcs.program(3.0))),
        "RawDataPower": [],
        "AdaptiveLog": [],
        "EventLog": [],
    } | files
    return {f"{folder}{stem}.json": value for stem, value in content.items() if value is not None}


def one(decoded):
    (recording,) = decoded.recordings
    return recording


def trace(recording, stream):
    return next(t for t in recording.traces if t.stream == stream)


def test_a_sine_comes_back_with_its_rms_in_microvolts(rcs, pack):
    recording = one(decode(pack(session(rcs))))
    beta = trace(recording, "beta")
    assert (beta.channel, beta.unit, beta.t_end_first_s, beta.dt_s) == ("key 0 +2-0", "uV", 2.0, 2.0)
    assert beta.valid.all()
    np.testing.assert_allclose(beta.values, 20 / np.sqrt(2), rtol=0.01)
    np.testing.assert_allclose(trace(recording, "beta_power").values, 200.0, rtol=0.02)
    assert recording.duration_s == pytest.approx(20.0)
    assert recording.started_at.timestamp() == pytest.approx(rcs.start_ms / 1000, abs=0.01)


def test_the_amplitude_is_weighted_by_time_within_a_step(rcs, pack):
    amplitude = trace(one(decode(pack(session(rcs)))), "amplitude")
    np.testing.assert_allclose(amplitude.values, [1, 1, 2] + [3] * 7, atol=1e-3)


def test_lost_packets_make_a_window_invalid_below_the_stated_fraction(rcs, pack):
    path = pack(session(rcs, lost=[*range(20, 25), *range(60, 68)]))
    recording = one(decode(path))
    assert np.flatnonzero(~trace(recording, "beta").valid).tolist() == [3]
    assert recording.quality["time_domain"]["missing"] == 13
    strict = one(decode(path, options=DecodeOptions(min_valid_fraction=0.9)))
    assert np.flatnonzero(~trace(strict, "beta").valid).tolist() == [1, 3]
    np.testing.assert_allclose(trace(recording, "beta").values[1], 20 / np.sqrt(2), rtol=0.05)


def test_disabled_programs_and_therapy_off_deliver_nothing(rcs, pack):
    stim = rcs.stim(
        (-4, {"therapyStatusData": {"therapyStatus": 1, "activeGroup": 0}, **rcs.program(8.5)}),
        (-3, rcs.program(2.0, program=1)),
        (10, {"therapyStatusData": {"therapyStatus": 0}}),
    )
    recording = one(decode(pack(session(rcs, StimLog=stim, DeviceSettings=rcs.settings(enabled=(1,))))))
    (amplitude,) = (t for t in recording.traces if t.stream == "amplitude")
    assert amplitude.channel == "program 1"
    np.testing.assert_allclose(amplitude.values, [2] * 5 + [0] * 5, atol=1e-3)


def test_a_stimulation_log_alone_is_decoded_with_its_amplitude_unknown(rcs, pack):
    decoded = decode(pack(session(rcs, DeviceSettings=None)))
    assert trace(one(decoded), "amplitude").details["assumed_program"]
    flagged = [text for r in decoded.reports for text in r.flagged]
    assert any("no settings say which programs are enabled" in text for text in flagged)
    assert not trace(one(decoded), "amplitude").valid.any()
    assert any("not in the upload" in text for text in flagged)


@pytest.mark.parametrize("gone", ["DeviceSettings", "StimLog", "RawDataTD", "RawDataPower", "AdaptiveLog", "EventLog"])
def test_any_file_may_be_missing(rcs, pack, gone):
    decoded = decode(pack(session(rcs, **{gone: None})))
    assert one(decoded).fingerprint
    assert any(r.name == f"{gone}.json" and r.flagged for r in decoded.reports)


@pytest.mark.parametrize("stem", ["DeviceSettings", "StimLog", "RawDataTD", "RawDataPower", "AdaptiveLog", "EventLog"])
@pytest.mark.parametrize(
    "content", ["", "no json", "[", '[{"RecordInfo":5}]', "[[[]]]", '[{"RecordInfo":{"HostUnixTime":"x"},"TherapyConfigGroup0":[1]}]']
)
def test_nonsense_in_one_file_never_costs_the_others(rcs, pack, stem, content):
    recording = one(decode(pack(session(rcs, **{stem: content}))))
    if stem != "RawDataTD":
        assert trace(recording, "beta").values.size == 10


def test_wrong_kinds_inside_packets_cost_those_packets(rcs, pack):
    td = rcs.time_domain(sine_mv(20.0))
    packets = td[0]["TimeDomainData"]
    packets[3]["Header"]["systemTick"] = "soon"
    packets[5]["ChannelSamples"] = {"Key": 0}
    packets[7]["Header"] = None
    packets[9]["ChannelSamples"][0]["Value"][4] = None
    decoded = decode(pack(session(rcs, RawDataTD=td)))
    about = next(r for r in decoded.reports if r.name == "RawDataTD.json")
    assert any("3 packets left out" in text for text in about.flagged)
    assert any("1 samples" in text for text in about.flagged)
    assert about.repaired == []
    assert one(decoded).quality["time_domain"]["packets"] == 197


def test_the_session_level_is_optional_and_two_devices_are_two_recordings(rcs, pack):
    left = session(rcs, folder="DeviceA/")
    right = session(rcs, seconds=10.0, folder="Session1/DeviceB/")
    decoded = decode(pack(left | right))
    assert sorted(r.duration_s for r in decoded.recordings) == pytest.approx([10.0, 20.0])
    assert not any("DeviceA" in r.name for r in decoded.reports)


def test_the_same_recording_in_another_zip_has_the_same_fingerprint(rcs, pack):
    first = one(decode(pack(session(rcs), "a.zip")))
    assert one(decode(pack(session(rcs, folder="Elsewhere/"), "b.zip"))).fingerprint == first.fingerprint
    assert one(decode(pack(session(rcs, seconds=18.0), "c.zip"))).fingerprint != first.fingerprint
    twice = decode(pack(session(rcs) | session(rcs, folder="copy/"), "d.zip"))
    assert len(twice.recordings) == 1
    assert any("twice" in text for text in twice.reports[0].ignored)


def test_notes_keep_their_label_and_lose_their_text(rcs, pack):
    notes = [
        rcs.note(
            1.0, "Stop Stim Run. Stim amp: 0.8mA. Stim Rate: 130.2Hz. Pulse Width: 60μs. Group A. Mrs Lovelace was tired", swapped=True
        ),
        rcs.note(8.0, "Mrs Lovelace says 3.0 mA is fine"),
        rcs.note(9.0, "call 555 1234"),
    ]
    events = [e for e in one(decode(pack(session(rcs, EventLog=notes)))).events if e.kind == "operator_note"]
    assert [e.label for e in events] == ["stop, 0.8 mA, 130.2 Hz, 60 us, group A", "3 mA", "note"]
    assert [e.data.get("conflict") for e in events] == [True, False, None]
    assert "Lovelace" not in repr(events)


def test_every_label_says_the_same_after_it_was_written_and_read_again():
    found = parse("Start Stim Run. Stim amp: 0.8mA. Stim Rate: 130.2Hz. Pulse Width: 60μs. Group A")
    assert found == {"verb": "start", "amplitude_ma": 0.8, "rate_hz": 130.2, "pulse_width_us": 60.0, "group": "A"}
    assert parse(render(found)) == found
    assert parse("2 mA or 3 mA") == {}
    assert parse(None, 5, "12345 mA") == {}


def test_a_stream_that_lies_days_away_is_left_out_and_said(rcs, pack):
    power = {
        "Header": {"systemTick": 1, "timestamp": {"seconds": 1}, "dataTypeSequence": 0},
        "PacketGenTime": 86_400_000,
        "PacketRxUnixTime": 86_400_000,
        "Bands": [1] * 8,
        "ValidDataMask": 255,
        "FftSize": 1,
        "SampleRate": 1,
    }
    decoded = decode(pack(session(rcs, RawDataPower=[{"RecordInfo": {}, "PowerDomainData": [power]}])))
    assert trace(one(decoded), "beta").values.size == 10
    assert any("days away" in text for r in decoded.reports for text in r.flagged)


def test_an_archive_without_a_session_is_refused(pack):
    with pytest.raises(UndecodableFile, match="no RC\\+S session"):
        decode(pack({"holiday.txt": "hello"}))


def test_limits_of_the_archive_hold_before_anything_is_read(rcs, pack):
    path = pack(session(rcs))
    with pytest.raises(UndecodableFile, match="more than"):
        decode(path, options=DecodeOptions(archive=ArchiveLimits(total_bytes=1000)))
