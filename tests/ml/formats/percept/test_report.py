from __future__ import annotations

import json
import zipfile
from datetime import UTC, datetime

import numpy as np
import pytest

from ml.formats import DecodeOptions, decode, redact, sniff
from ml.formats.percept.details import groups
from ml.formats.percept.enums import word
from ml.formats.percept.report_json import channel_names, packet_list, side_of, utc_offset_h
from ml.formats.percept.streams import device_powers, time_domains
from ml.signals import band_pass

RIGHT, LEFT = "ONE_THREE_RIGHT", "ZERO_TWO_LEFT"


def trace(recording, stream):
    return next(t for t in recording.traces if t.stream == stream)


def of_side(decoded, side, run=0):
    return next(r for r in decoded.recordings if r.hemisphere == side and r.run == run)


def test_the_real_report_gives_its_four_runs_with_their_samples_and_ticks(recordings):
    path = recordings / "percept/percept_session_report.zip"
    assert sniff(path) == "percept"
    decoded = decode(path)
    right = [of_side(decoded, "right", run) for run in range(4)]
    assert [r.quality["time_domain"][RIGHT]["samples"] for r in right] == [51375, 1500, 31125, 34375]
    assert [r.quality["time_domain"][RIGHT]["missing_samples"] for r in right] == [0, 0, 0, 0]
    # the first packet of run 1 ends at tick 310250, the last at 515250: 205.0 s and one packet of 0.5 s
    assert right[0].settings["first_tick_ms"] == 310250 - 500
    assert right[0].duration_s == 205.5
    assert [r.duration_s for r in right] == [205.5, 6.0, 124.5, 137.5]
    assert right[0].started_at == datetime(2024, 3, 14, 10, 5, 52, tzinfo=UTC)
    assert {r.run for r in decoded.recordings} == {0, 1, 2, 3, None}
    assert any("SessionDate says 2022-12-16" in text for text in decoded.reports[0].flagged)
    assert right[0].settings["clock"] | {"why": "", "showed": ""} == {
        "name": "implant",
        "known": False,
        "ahead_s": None,
        "ahead_at_end_s": None,
        "uncertainty_s": None,
        "why": "",
        "showed": "",
    }


def test_power_and_amplitude_of_the_real_report_stand_beside_the_samples_they_came_with(recordings):
    decoded = decode(recordings / "percept/percept_session_report.zip")
    for run in range(4):
        right, left = of_side(decoded, "right", run), of_side(decoded, "left", run)
        errors = [t for t in right.traces if t.stream == "beta_error"]
        assert [(t.unit, np.flatnonzero(t.values).tolist()) for t in errors] == [("uV", [t.values.size - 1]) for t in errors]
        assert len(errors) == (run in (0, 3))  # their last period is cut, at 1.5 s of 2
        assert [(t.stream, t.unit, t.source) for t in right.traces if t not in errors] == [
            ("beta", "uV", "time_domain"),
            ("beta_power", "uV2", "time_domain"),
            ("band_power", "device units", "percept_lfp"),
            ("amplitude", "mA", "device_log"),
        ]
        assert [t.stream for t in left.traces] == ["amplitude"]
        assert np.nanmax(trace(left, "amplitude").values) == np.float32(0.0 if run == 3 else 3.1)
        assert np.nanmax(trace(right, "amplitude").values) == 0.0
        assert len({t.values.size for t in (*right.traces, *left.traces)}) == 1


def test_a_period_of_the_real_power_is_the_mean_of_its_four_values(recordings):
    path = recordings / "percept/percept_session_report.zip"
    with zipfile.ZipFile(path) as archive:
        rows = json.loads(archive.read("leadsense.json"))["BrainSenseLfp"][0]["LfpData"]
    values = np.array([row["Right"]["LFP"] for row in rows], dtype=float)
    found = trace(of_side(decode(path), "right"), "band_power").values
    np.testing.assert_allclose(found[:102], values[:408].reshape(102, 4).mean(axis=1), rtol=1e-6)
    assert np.isnan(found[102])


def test_the_devices_power_follows_the_band_power_of_the_samples_it_is_paired_with(recordings):
    path = recordings / "percept/percept_session_report.zip"
    with zipfile.ZipFile(path) as archive:
        report = json.loads(archive.read("leadsense.json"))
    domains, powers = time_domains("run", report["BrainSenseTimeDomain"]), device_powers(report["BrainSenseLfp"])
    for run in (0, 2, 3):
        domain, power = domains[run], powers[run]
        # 11.72 Hz was sensed, averaged over 3 s; the device reports it some 1.5 s late
        band = band_pass(domain.values, 250.0, 9.22, 14.22) ** 2
        total = np.concatenate(([0.0], np.cumsum(band)))
        end = ((power.ticks_ms - domain.begin_ms - 1500.0) / 4.0).astype(int)
        whole = end >= 750
        own = (total[end[whole]] - total[end[whole] - 750]) / 750
        assert np.corrcoef(own, power.power["right"][whole])[0, 1] > 0.8


def test_the_montage_of_the_real_report_is_spectra_and_no_session(recordings):
    history = next(r for r in decode(recordings / "percept/percept_session_report.zip").recordings if r.run is None)
    assert len(history.spectra) == 30 + 12 + 8
    assert all(s.unit == "uV2/Hz" and s.hz[-1] == 100.0 and s.seconds > 20 for s in history.spectra)
    assert history.traces == ()
    assert len(history.settings["group_history"]) == 5
    assert history.settings["battery"]["percent"] == 74
    assert len(history.events) == 47
    assert "impedance investigate" in {e.label for e in history.events}


def test_a_report_of_group_history_alone_is_kept_and_said_to_be_no_session(recordings):
    path = recordings / "percept/group_history.json"
    assert sniff(path) == "percept"
    decoded = decode(path)
    (history,) = decoded.recordings
    assert (history.run, history.traces) == (None, ())
    newest = history.settings["group_history"][0]["groups"][0]
    assert (newest["group"], newest["active"], newest["sensing"][0]["frequency_hz"]) == ("C", True, 72.2)
    assert newest["programs"][0]["amplitude_ma"] is None
    assert any("nothing in it can be a session" in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize("spelling", ["comma", "bracket", "list"])
def test_the_three_spellings_of_packet_lists_give_the_same_recording(write, spelling, percept):
    right = of_side(decode(write(percept.one_run(spelling=spelling, lost=(5, 6)))), "right")
    assert right.fingerprint == of_side(decode(write(percept.one_run(lost=(5, 6)))), "right").fingerprint
    assert right.quality["time_domain"][RIGHT]["missing_samples"] == 250


def test_beta_of_a_sine_is_its_rms_and_its_power_is_the_square(write, percept):
    right = of_side(decode(write(percept.one_run())), "right")
    np.testing.assert_allclose(trace(right, "beta").values, 3 / np.sqrt(2), rtol=0.01)
    np.testing.assert_allclose(trace(right, "beta_power").values, 4.5, rtol=0.02)
    (spectrum,) = right.spectra
    assert spectrum.hz[np.argmax(spectrum.density)] == 20.0


def test_where_power_is_the_measure_beta_is_in_squared_microvolts(write, percept):
    right = of_side(decode(write(percept.one_run()), options=DecodeOptions(beta_measure="power")), "right")
    beta, rms = trace(right, "beta"), trace(right, "beta_rms")
    assert (beta.unit, beta.details["measure"], rms.unit) == ("uV2", "power", "uV")
    np.testing.assert_allclose(beta.values, rms.values**2, rtol=1e-5)


def test_a_lost_packet_costs_its_window_and_no_other(write, percept):
    right = of_side(decode(write(percept.one_run(lost=(9, 10, 11)))), "right")
    # packet k covers (k / 2, (k + 1) / 2] s: three of the four packets of the window (4, 6] are gone
    assert trace(right, "beta").valid.tolist() == [True, True, False, *[True] * 7]
    assert right.quality["time_domain"][RIGHT]["loss"] == pytest.approx(375 / 5000)


def test_both_sides_of_a_run_are_two_recordings_of_one_run(write, percept):
    left, right = percept.time_domain(LEFT, percept.sine(20, amplitude=6)), percept.time_domain(RIGHT, percept.sine(20))
    both = percept.power(f"{LEFT},{RIGHT}", 39, left_ma=1.5)
    decoded = decode(write(percept.report(BrainSenseTimeDomain=[left, right], BrainSenseLfp=[both])))
    of_run = [r for r in decoded.recordings if r.run == 0]
    assert [r.hemisphere for r in of_run] == ["left", "right"]
    assert np.nanmedian(trace(of_run[0], "beta").values) == pytest.approx(6 / np.sqrt(2), rel=0.01)
    assert trace(of_run[0], "amplitude").values[0] == 1.5
    assert trace(of_run[1], "amplitude").values[0] == 2.0
    assert trace(of_run[0], "band_power").channel == LEFT
    assert of_run[1].limits == {"group B": {"right": {"lower_ma": 0.5, "upper_ma": 3.5}}}


def test_runs_are_paired_by_ticks_and_channel_and_dates_may_differ_by_a_second(write, percept):
    later = percept.first_tick + 250_000
    domains = [percept.time_domain(RIGHT, percept.sine(10)), percept.time_domain(RIGHT, percept.sine(10), first_tick=later)]
    domains[1]["FirstPacketDateTime"] = "2024-03-14T10:10:02.000Z"
    powers = [
        percept.power(RIGHT, 19, first_tick=later, when="2024-03-14T10:10:03.000Z", right_ma=1.0),
        percept.power(RIGHT, 19, when="2024-03-14T10:05:53.000Z", right_ma=3.0),
    ]
    decoded = decode(write(percept.report(BrainSenseTimeDomain=domains, BrainSenseLfp=powers)))
    assert [trace(of_side(decoded, "right", run), "amplitude").values[0] for run in (0, 1)] == [3.0, 1.0]


def test_power_whose_first_values_are_lost_stays_with_its_samples(write, percept):
    report = percept.one_run(seconds=60.0)
    report["BrainSenseLfp"] = [percept.power(RIGHT, 100, first_tick=percept.first_tick + 10_000, when="2024-03-14T10:06:02.000Z")]
    right = of_side(decode(write(report)), "right")
    assert trace(right, "beta").valid.all()
    assert trace(right, "amplitude").valid.tolist() == [False] * 5 + [True] * 25


def test_power_of_another_hour_is_not_paired_though_its_ticks_lie_within(write, percept):
    report = percept.one_run(seconds=60.0)
    report["BrainSenseLfp"] = [percept.power(RIGHT, 100, first_tick=percept.first_tick + 10_000, when="2024-03-14T12:06:02.000Z")]
    decoded = decode(write(report))
    assert {r.run for r in decoded.recordings if r.hemisphere == "right"} == {0, 1}


def test_power_of_another_channel_is_a_run_of_its_own(write, percept):
    decoded = decode(
        write(percept.report(BrainSenseTimeDomain=[percept.time_domain(RIGHT, percept.sine(10))], BrainSenseLfp=[percept.power(LEFT, 19)]))
    )
    assert [t.stream for t in of_side(decoded, "right", 0).traces] == ["beta", "beta_power"]
    assert "band_power" in [t.stream for t in of_side(decoded, "left", 1).traces]
    assert any("no amplitude was logged" in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize("ticks", ["", "a,b,c", None, [310250 + 10**9 * k for k in range(40)]])
def test_samples_without_usable_ticks_begin_with_their_power_and_that_is_said(write, percept, ticks):
    report = percept.one_run()
    report["BrainSenseTimeDomain"][0]["TicksInMses"] = ticks
    decoded = decode(write(report))
    right = of_side(decoded, "right")
    assert trace(right, "beta").valid.all()
    assert trace(right, "amplitude").values.tolist() == [2.0] * 10
    np.testing.assert_allclose(trace(right, "band_power").values[:2], [101.5, 105.5])
    assert any("lost samples cannot be seen" in text for text in decoded.reports[0].flagged)


def test_power_that_begins_a_packet_later_stays_at_its_ticks(write, percept):
    report = percept.one_run()
    report["BrainSenseLfp"] = [percept.power(RIGHT, 38, first_tick=percept.first_tick + 500)]
    band = trace(of_side(decode(write(report)), "right"), "band_power")
    # the first step holds three of its four values: 100, 101 and 102
    np.testing.assert_allclose(band.values[:2], [101.0, 104.5])


def test_a_section_of_one_may_be_the_object_itself_and_sections_may_be_missing(write, percept):
    domain, lfp = percept.time_domain(RIGHT, percept.sine(10)), percept.power(RIGHT, 19)
    decoded = decode(write({"BrainSenseTimeDomain": domain, "BrainSenseLfp": lfp}))
    assert [t.stream for t in of_side(decoded, "right").traces] == ["beta", "beta_power", "band_power", "amplitude"]
    assert of_side(decode(write({"BrainSenseLfp": lfp})), "right").duration_s == 9.5


def test_unknown_enumerations_and_channels_are_not_fatal_and_name_no_side(write, percept):
    domain = percept.time_domain("SIDE_OF_ADA", percept.sine(10))
    strange = percept.report(
        BrainSenseTimeDomain=[domain],
        Groups={"Final": [{"GroupId": "NewDef.GROUP_Z", "ActiveGroup": "perhaps", "ProgramSettings": []}]},
        LeadConfiguration="none",
        BatteryInformation=[1],
    )
    decoded = decode(write(strange))
    assert of_side(decoded, None).traces[0].channel == "channel 1"
    assert "ADA" not in repr(decoded)


def test_indefinite_streaming_gives_beta_but_no_session(write, percept):
    stream = [percept.time_domain(name, percept.sine(10)) for name in (RIGHT, "ZERO_TWO_RIGHT", LEFT)]
    decoded = decode(write(percept.report(IndefiniteStreaming=stream)))
    streamed = [r for r in decoded.recordings if r.traces]
    assert [(r.run, r.hemisphere, len(r.traces)) for r in streamed] == [(None, "left", 2), (None, "right", 4)]


def test_surveys_of_newer_reports_are_read_and_told_once(write, percept):
    old = {**percept.time_domain("ZERO_AND_THREE_LEFT_RING", percept.sine(20)), "TicksInMses": ""}
    new = {k: v for k, v in old.items() if k not in ("TimeDomainData", "TicksInMses")}
    new |= {"TimeDomainDatainMicroVolts": old["TimeDomainData"], "TicksInMs": ""}
    single = {**new, "Channel": "ELECTRODE_ONE_A", "Hemisphere": "HemisphereLocationDef.Right"}
    surveys = [
        {"SurveyMode": "ElectrodeSurvey", "ElectrodeSurvey": [new]},
        {"SurveyMode": "ElectrodeIdentifier", "ElectrodeIdentifier": [single]},
    ]
    picture = {"Hemisphere": "HemisphereLocationDef.Left", "LFPFrequencyinHertz": [0, 1], "LFPMagnitudeinMicroVoltPeak": [2, 3]}
    report = {"LfpMontageTimeDomain": old, "BrainSenseSurveysTimeDomain": surveys, "BrainSenseSurveys": [{"ElectrodeSurvey": [picture]}]}
    source = write(report)
    redact(source, source.with_name("r.json"), "percept", b"a key of the clinic's own")
    for path in (source, source.with_name("r.json")):
        (history,) = decode(path).recordings
        assert [s.channel.split()[:2] for s in history.spectra] == [
            ["ZERO_AND_THREE_LEFT_RING", "LfpMontageTimeDomain"],
            ["ELECTRODE_ONE_A", "BrainSenseSurveysTimeDomain"],
        ]
        assert history.settings["montage"][0]["magnitude"] == [2.0, 3.0]


def test_trends_are_sorted_and_each_time_counts_once(write):
    reads = {
        "2024-01-02T00:00:00Z": [{"DateTime": "2024-01-01T10:10:00Z", "LFP": 7, "AmplitudeInMilliAmps": 2.0}],
        "2024-01-01T12:00:00Z": [
            {"DateTime": "2024-01-01T10:10:00Z", "LFP": 5, "AmplitudeInMilliAmps": 2.0},
            {"DateTime": "2024-01-01T10:00:00Z", "LFP": 4, "AmplitudeInMilliAmps": 1.9},
        ],
    }
    for key, blocks in (("HemisphereLocationDef.Left", reads), ("HemisphereLocationDef_Left", reads)):
        (history,) = decode(write({"DiagnosticData": {"LFPTrendLogs": {key: blocks}}})).recordings
        assert history.settings["trends"]["left"] == {
            "unix_s": [1704103200.0, 1704103800.0],
            "power_device_units": [4.0, 7.0],
            "amplitude_ma": [1.9, 2.0],
        }


def test_snapshots_and_patient_events_are_kept_and_typed_names_are_not(write):
    spectrum = {"GroupId": "GroupIdDef.GROUP_C", "FFTBinData": [1.0, 2.0], "Frequency": [0.0, 0.98]}
    events = [
        {"DateTime": "2024-01-01T10:00:00Z", "EventID": 1, "EventName": "Dyskinesia", "LFP": True},
        {
            "DateTime": "2024-01-01T11:00:00Z",
            "EventID": 4,
            "EventName": "Call Ada",
            "LfpFrequencySnapshotEvents": {"HemisphereLocationDef.Right": spectrum},
        },
    ]
    (history,) = decode(write({"DiagnosticData": {"LfpFrequencySnapshotEvents": events}})).recordings
    assert [e.label for e in history.events] == ["dyskinesia", "event 4"]
    assert history.events[1].t_s == 3600.0
    assert history.settings["snapshots"][0]["spectra"]["right"]["magnitude"] == [1.0, 2.0]
    assert "Ada" not in repr(history)


def test_several_reports_in_a_zip_count_their_runs_on(pack, percept):
    later = percept.one_run()
    for section in ("BrainSenseTimeDomain", "BrainSenseLfp"):
        later[section][0]["FirstPacketDateTime"] = "2024-03-15T10:05:52.000Z"
    path = pack({"a.json": percept.one_run(), "b.json": later, "letter.txt": "Ada", "c.json": json.dumps(percept.one_run())[:5000]})
    assert sniff(path) == "percept"
    decoded = decode(path)
    assert [r.run for r in decoded.recordings if r.run is not None] == [0, 1]
    assert decoded.reports[2].problem is not None
    assert "1 file" in decoded.reports[0].ignored[0]


def test_enumerations_channels_and_sides_are_read_by_their_shape():
    assert word("GroupIdDef.GROUP_A") == word("GroupIdDef_GROUP_A") == "GROUP_A"
    assert word("Ada Lovelace") is None
    assert channel_names("ZERO_TWO_LEFT,ONE_THREE_RIGHT") == ["ZERO_TWO_LEFT", "ONE_THREE_RIGHT"]
    assert channel_names("SensingChannelDef.ONE_A_AND_TWO_A_LEFT_SEGMENT") == ["ONE_A_AND_TWO_A_LEFT_SEGMENT"]
    assert channel_names("ADA_LOVELACE") == []
    assert (side_of("ZERO_AND_THREE_LEFT_RING"), side_of("LEFT_RIGHT"), side_of(None)) == ("left", None, None)
    np.testing.assert_array_equal(packet_list("[1, 2]"), packet_list("1,2,"))


def test_a_stated_rate_that_the_ticks_contradict_voids_neither_power_nor_amplitude(write, percept):
    power = percept.power("ZERO_TWO_LEFT", 40, left_ma=2.0)
    power["SampleRateInHz"] = 250
    decoded = decode(write(percept.report(BrainSenseLfp=[power])))
    left = of_side(decoded, "left")
    assert trace(left, "band_power").valid.all()
    assert trace(left, "amplitude").values.tolist() == [2.0] * 10
    assert any("the ticks say every 500 ms" in text for text in decoded.reports[0].repaired)


def test_packets_in_pairs_keep_their_spectrum(write, percept):
    entry = percept.time_domain("ONE_THREE_RIGHT", percept.sine(20.0), spelling="list")
    sizes, ticks = [62, 63] * 40, [t for t in entry["TicksInMses"] for _ in range(2)]
    entry |= {"GlobalPacketSizes": sizes, "TicksInMses": ticks, "GlobalSequences": list(range(80))}
    (recording,) = decode(write(percept.report(BrainSenseTimeDomain=[entry]))).recordings[:1]
    (spectrum,) = recording.spectra
    assert spectrum.hz[np.argmax(spectrum.density)] == 20.0
    assert spectrum.seconds == 20.0


def test_the_programmers_offset_from_utc_stands_with_every_recording(write, percept):
    run = percept.time_domain("ONE_THREE_RIGHT", percept.sine(20.0))
    recordings = decode(write(percept.report(BrainSenseTimeDomain=[run]))).recordings
    assert recordings
    assert {r.settings["utc_offset_h"] for r in recordings} == {1.0}
    assert [utc_offset_h(text) for text in ("-07:30", "+05:45:00", "+15:00", "soon", None)] == [-7.5, 5.75, None, None, None]


def test_a_group_of_a_directional_lead_has_the_amplitude_of_its_cathodes():
    def electrode(name, sign, ma=None):
        state = {"Electrode": f"ElectrodeDef.{name}", "ElectrodeStateResult": f"ElectrodeStateDef.{sign}"}
        return state if ma is None else state | {"ElectrodeAmplitudeInMilliAmps": ma}

    states = [electrode("SenSight_1a", "Negative", 1.2), electrode("SenSight_1b", "Negative", 0.7), electrode("Case", "Positive", 1.9)]
    program = {"ProgramId": "ProgramIdDef.FIRST_LEFT", "ElectrodeState": states, "PulseWidthInMicroSecond": 60}
    group = {"GroupId": "GroupIdDef.GROUP_A", "ProgramSettings": {"LeftHemisphere": {"Programs": [program]}}}
    assert groups([group])[0]["programs"][0]["amplitude_ma"] == 1.9
    assert groups([json.loads(json.dumps(group).replace("ElectrodeAmplitudeInMilliAmps", "X"))])[0]["programs"][0]["amplitude_ma"] is None
    del states[1]["ElectrodeAmplitudeInMilliAmps"]
    assert groups([group])[0]["programs"][0]["amplitude_ma"] is None, "a part of the current is no amplitude"
    program["AmplitudeInMilliAmps"] = 2.0
    assert groups([group])[0]["programs"][0]["amplitude_ma"] == 2.0


def test_a_side_whose_first_packets_were_lost_stays_in_its_run(write, percept):
    left = percept.time_domain(LEFT, percept.sine(60.0))
    right = percept.time_domain(RIGHT, percept.sine(54.0, amplitude=5.0), first_tick=percept.first_tick + 6000)
    right["FirstPacketDateTime"] = "2024-03-14T10:05:58.000Z"
    power = percept.power(f"{LEFT},{RIGHT}", 119, left_ma=1.5)
    for order in ([left, right], [right, left]):
        decoded = decode(write(percept.report(BrainSenseTimeDomain=order, BrainSenseLfp=[power])))
        assert [(r.hemisphere, r.run) for r in decoded.recordings if r.run is not None] == [("left", 0), ("right", 0)]
        side = of_side(decoded, "right")
        assert side.started_at == datetime(2024, 3, 14, 10, 5, 52, tzinfo=UTC), "the run begins with the side that came first"
        assert trace(side, "beta").valid.tolist() == [False] * 3 + [True] * 27
        assert trace(side, "amplitude").valid.all()


def test_two_runs_one_after_the_other_are_not_taken_for_one(write, percept):
    first = percept.time_domain(LEFT, percept.sine(20.0))
    second = percept.time_domain(RIGHT, percept.sine(20.0), first_tick=percept.first_tick + 20_000)
    second["FirstPacketDateTime"] = "2024-03-14T10:06:12.000Z"
    decoded = decode(write(percept.report(BrainSenseTimeDomain=[first, second])))
    assert {(r.hemisphere, r.run) for r in decoded.recordings if r.run is not None} == {("left", 0), ("right", 1)}
