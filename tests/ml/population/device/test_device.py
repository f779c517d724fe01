from __future__ import annotations

import io
import json
import zipfile

import numpy as np
import pytest

from ml.policies.policy import ConstantPolicy
from ml.population import PARTICIPANTS, rcs_session_zip, run_session, run_sessions, session_table_csv
from ml.population.device.settings import COUNTS_PER_VOLT, GAIN

START = 1_600_000_000_000
FILES = {
    "RawDataTD", "RawDataAccel", "RawDataPower", "RawDataFFT", "AdaptiveLog", "StimLog",
    "DeviceSettings", "EventLog", "TimeSync", "ErrorLog", "DiagnosticsLog",
}  # fmt: skip
STREAMS = {"RawDataTD": "TimeDomainData", "RawDataPower": "PowerDomainData", "TimeSync": "TimeSyncData"}


def unzip(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name.rpartition("/")[2].removesuffix(".json"): json.loads(archive.read(name)) for name in archive.namelist()}


@pytest.fixture(scope="module")
def sessions():
    random = run_session("P2", "random", seed=3, steps=150, resolution_ma=0.1)
    off = run_session("P2", "no_dbs", seed=4, steps=30, hour=0.5, resolution_ma=0.1)
    half = run_session("P2", ConstantPolicy(0.5), seed=5, steps=30, hour=1.0, resolution_ma=0.1)
    return [random, off, half]


@pytest.fixture(scope="module")
def recording(sessions):
    return unzip(rcs_session_zip(sessions, started_ms=START, gap_s=30, ins_clock_offset_s=-1e8))


def test_the_folder_and_its_eleven_files_are_those_of_the_device(sessions):
    content = rcs_session_zip(sessions[1], started_ms=START)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert set(archive.namelist()) == {f"Session{START}/DeviceSYN000001H/{name}.json" for name in FILES}
    assert content == rcs_session_zip(sessions[1], started_ms=START)


def test_every_record_names_the_session_and_files_are_in_time_order(recording):
    for name, records in recording.items():
        infos = [record["RecordInfo"] for record in records]
        assert all(info["SessionId"] == str(START) and info["DeviceId"] == "SYN000001H" for info in infos), name
        times = [info["HostUnixTime"] for info in infos]
        assert times == sorted(times), name


def session_starts(sessions):
    t = START + 5_000
    for session in sessions:
        start = t + 2_000 * session.lead_beta.size
        yield start
        t = start + 2_000 * session.steps + 30_000


def amplitude_at(records, times):
    """Compute delivered mA at PC times from the running merge of the delta records."""
    state, out, i = {}, [], 0
    for t in times:
        while i < len(records) and records[i]["RecordInfo"]["HostUnixTime"] <= t:
            state["on"] = records[i].get("therapyStatusData", {}).get("therapyStatus", state.get("on"))
            program = records[i].get("TherapyConfigGroup0", {}).get("program0", {})
            state["ma"] = program.get("AmplitudeInMilliamps", state.get("ma"))
            i += 1
        out.append(state["ma"] if state["on"] == 1 else 0.0)
    return np.array(out)


def test_the_stimulation_log_holds_the_amplitude_of_every_step(sessions, recording):
    for session, start in zip(sessions, session_starts(sessions), strict=True):
        times = start + 2_000 * np.arange(session.steps) + 1_000
        assert amplitude_at(recording["StimLog"], times) == pytest.approx(session.amplitude * 4.0, abs=1e-9)
        around = [start - 10_000, start + 2_000 * session.steps + 1_000]
        assert amplitude_at(recording["StimLog"], around) == pytest.approx([4.0, 4.0])


def test_settings_record_0_is_complete_and_later_ones_are_deltas(recording):
    first, *later = recording["DeviceSettings"]
    groups = {f"{kind}{n}" for kind in ("TherapyConfigGroup", "AmplitudeLimitsGroup") for n in range(4)}
    sections = groups | {
        "UtcOffset", "FirmwareID", "GeneralData", "OorData", "BatteryStatus", "FlashFormatHeader", "SubjectInfo", "LastPtmRtmInfo",
        "SensingConfig", "DetectionConfig", "SenseState", "StreamState", "AdaptiveConfig", "TelemetryModuleInfo", "FactorySettings",
    }  # fmt: skip
    assert sections < set(first)
    assert all(len(record) == 2 for record in later)
    program, *disabled = first["TherapyConfigGroup0"]["programs"]
    assert (program["isEnabled"], program["amplitudeInMilliamps"], program["pulseWidthInMicroseconds"]) == (0, 4.0, 60)
    assert {p["isEnabled"] for p in disabled} == {131}
    kinds = {i: e["electrodeType"] for i, e in enumerate(program["electrodes"]["electrodes"]) if not e["isOff"]}
    assert kinds == {2: 0, 16: 1}
    assert first["AmplitudeLimitsGroup0"]["prog0UpperInMilliamps"] == 4.0
    assert first["SubjectInfo"]["ID"] == "SYNTHETIC-P2"
    assert np.isnan(first["SubjectInfo"]["TargetCoordinates"][0]["TargetCoordinate1"])
    switches = [r["StreamState"]["TimeDomainStreamEnabled"] for r in later if "StreamState" in r]
    assert switches == [True, False] * 3


@pytest.mark.parametrize("name", STREAMS)
def test_counters_roll_over_and_ticks_follow_the_samples(name, recording):
    packets = recording[name][0][STREAMS[name]]
    headers = [p["Header"] for p in packets]
    assert set(np.diff([h["dataTypeSequence"] for h in headers])) <= {1, -255}
    ticks = np.diff([h["systemTick"] for h in headers]) % 65536
    assert np.min([h["systemTick"] for h in headers]) >= 0
    assert np.max([h["systemTick"] for h in headers]) <= 65535
    expected = {"RawDataTD": 1_000, "RawDataPower": 5_000, "TimeSync": 10_000}[name]
    assert np.count_nonzero(ticks != expected) == 2  # the pauses between three sessions
    assert [p["PacketGenTime"] > 0 for p in packets[:4]] == [False, False, False, True]
    timed = [p for p in packets if p["PacketGenTime"] > 0]
    assert len(packets) - len(timed) == 3 * 3  # each session's streams start without generation times
    seconds = np.array([p["Header"]["timestamp"]["seconds"] for p in timed]) + 951_868_800 + 1e8
    assert np.abs(seconds - np.array([p["PacketGenTime"] for p in timed]) / 1000).max() < 1.2


def test_global_sequence_counts_all_streams_together(recording):
    merged = [(p["PacketRxUnixTime"], p["Header"]) for name, key in STREAMS.items() for p in recording[name][0][key]]
    counts = np.bincount([h["globalSequence"] for _, h in merged], minlength=256)
    assert counts.max() - counts.min() <= 1


def test_the_time_domain_is_the_lfp_within_one_step_of_the_converter(sessions, recording):
    packets = recording["RawDataTD"][0]["TimeDomainData"]
    samples = np.concatenate([p["ChannelSamples"][0]["Value"] for p in packets])
    lfp = np.concatenate([s.lfp for s in sessions])
    assert samples.size == lfp.size
    assert np.abs(samples - lfp).max() <= 0.5 * 1200 / (GAIN * COUNTS_PER_VOLT) + 2e-6
    assert all(p["Header"]["dataSize"] == 2 * len(p["ChannelSamples"][0]["Value"]) for p in packets)


def test_on_device_power_is_that_of_its_band(sessions, recording):
    packets = recording["RawDataPower"][0]["PowerDomainData"]
    first = np.array([p["Bands"][0] for p in packets[:318]])
    lfp = sessions[0].lfp.astype(np.float64) * GAIN * COUNTS_PER_VOLT / 1200
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(250) / 249)
    for j in (0, 7, 200):
        piece = lfp[125 * j : 125 * j + 250] * window
        bins = [np.sum(piece * np.exp(-2j * np.pi * k * np.arange(250) / 256)) for k in range(14, 36)]
        expected = sum(64 * abs(b) ** 2 / 256**2 / 2 for b in bins)
        assert first[j] == pytest.approx(expected, rel=0.05, abs=30)
    assert all(p["Bands"][2:] == [0] * 6 and p["ValidDataMask"] == 3 for p in packets)


def test_lost_packets_leave_gaps_in_the_sequence_at_the_asked_rate(sessions):
    files = unzip(rcs_session_zip(sessions[0], started_ms=START, packet_loss=0.15, seed=2))
    headers = [p["Header"] for p in files["RawDataTD"][0]["TimeDomainData"]]
    steps = np.diff([h["dataTypeSequence"] for h in headers]) % 256
    missing = int((steps - 1).sum())
    assert missing + len(headers) == pytest.approx(3_200, abs=5)
    assert missing / 3_200 == pytest.approx(0.15, abs=0.04)
    ticks = np.diff([h["systemTick"] for h in headers]) % 65536
    assert np.array_equal(ticks[steps < 60], 1_000 * steps[steps < 60])


def test_events_do_not_tell_the_controller(recording):
    text = json.dumps(recording["EventLog"]).lower()
    assert not any(word in text for word in ("random", "dbs", "policy", "rl"))
    assert [r["Event"]["EventType"] for r in recording["EventLog"]][:3] == ["Start session 1", "Grasp test of session 1", "Stop session 1"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sessions": []}, "at least one session"),
        ({"packet_loss": 1.0}, "packet loss"),
        ({"serial": "X"}, "ten letters"),
        ({"gap_s": 0.0}, "pause"),
    ],
)
def test_recordings_that_cannot_be_are_refused(change, message, sessions):
    arguments = {"sessions": sessions[1:], "started_ms": START} | change
    with pytest.raises(ValueError, match=message):
        rcs_session_zip(arguments.pop("sessions"), **arguments)


def test_sessions_without_lfp_or_of_two_participants_are_refused(sessions):
    bare = run_sessions("P2", "cdbs", seeds=[1], steps=5).session(0)
    with pytest.raises(ValueError, match="no LFP"):
        rcs_session_zip(bare, started_ms=START)
    with pytest.raises(ValueError, match="one participant"):
        rcs_session_zip([sessions[1], run_session("P1", "cdbs", seed=1, steps=5)], started_ms=START)


def test_delivered_amplitudes_lie_on_the_devices_grid_and_never_below_the_bound():
    participant = PARTICIPANTS["P4"]
    session = run_sessions(participant, "random", seeds=[2], steps=200, resolution_ma=0.1).session(0)
    tenths = 10 * participant.cdbs_amplitude_ma * session.amplitude
    assert tenths == pytest.approx(np.rint(tenths), abs=1e-9)
    assert session.amplitude.min() >= 0.3
    assert session.amplitude.max() <= 1


def test_the_step_table_puts_the_window_before_the_session_at_times_up_to_0(sessions):
    lines = session_table_csv(sessions[0]).decode().splitlines()
    assert lines[0] == "t_s,beta,amplitude_fraction"
    rows = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    assert np.array_equal(rows[:, 0], 2.0 * np.arange(-9, 151))
    assert np.array_equal(rows[:, 1], np.concatenate([sessions[0].lead_beta, sessions[0].beta]))
    assert np.array_equal(rows[10:, 2], sessions[0].amplitude)
    assert np.all(rows[:10, 2] == 1)
