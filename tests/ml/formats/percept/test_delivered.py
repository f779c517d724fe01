"""The delivered amplitude and its time: siblings of faults that public reports have, made here, each with its true value."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from ml.formats import decode, redact
from ml.formats.percept.streams import TURN_MS

RIGHT, LEFT = "ONE_THREE_RIGHT", "ZERO_TWO_LEFT"
BEGIN = datetime(2026, 3, 5, 15, 0, tzinfo=UTC)
KEY = b"a key of the clinic's own"


@pytest.fixture
def read(tmp_path):
    """Decodes a report; its redacted form must give the same recordings and, but for what was removed, the same sentences."""

    def both(report):
        path, clean = tmp_path / "report.json", tmp_path / "clean.json"
        path.write_text(json.dumps(report))
        redact(path, clean, "percept", KEY)
        first, second = decode(path), decode(clean)
        assert [(r.started_at, r.settings, r.events, r.fingerprint) for r in first.recordings] == [
            (r.started_at, r.settings, r.events, r.fingerprint) for r in second.recordings
        ]
        return second

    return both


def trace(recording, stream):
    return next((t for t in recording.traces if t.stream == stream), None)


def with_clocks(report, ahead_s=0.0, ahead_at_end_s=None, minutes=40):
    """Give a report the programmer's dates and the implant's, which are ahead."""
    end = BEGIN + timedelta(minutes=minutes)
    at_end = ahead_s if ahead_at_end_s is None else ahead_at_end_s
    report |= {"SessionDate": BEGIN.isoformat(), "SessionEndDate": end.isoformat()}
    report["DeviceInformation"]["Initial"]["DeviceDateTime"] = (BEGIN + timedelta(seconds=ahead_s)).isoformat()
    report["DeviceInformation"]["Final"]["DeviceDateTime"] = (end + timedelta(seconds=at_end)).isoformat()
    return report


def run(percept, begin_s, tick, seconds=20, ma=2.0, power_tick=None, power_s=None, ahead_s=0.0):
    """Make one run: its samples, and its power, which may count otherwise."""

    def date_at(s):
        return (BEGIN + timedelta(seconds=s + ahead_s)).isoformat()

    domain = percept.time_domain(RIGHT, percept.sine(seconds), first_tick=int(tick))
    domain["FirstPacketDateTime"] = date_at(begin_s)
    power_tick = tick if power_tick is None else power_tick
    power = percept.power(RIGHT, 2 * seconds - 1, int(power_tick), date_at(begin_s if power_s is None else power_s), right_ma=ma)
    return domain, power


def report_of(percept, *runs, ahead_s=0.0, ahead_at_end_s=None, **sections):
    made = percept.report(BrainSenseTimeDomain=[r[0] for r in runs], BrainSenseLfp=[r[1] for r in runs], **sections)
    return with_clocks(made, ahead_s, ahead_at_end_s)


def amplitudes(result):
    """List the amplitudes of each run with samples, mA."""
    sensed = [r for r in result.recordings if r.run is not None and trace(r, "beta") is not None]
    return [None if (a := trace(r, "amplitude")) is None else sorted(set(np.round(a.values[a.valid], 3).tolist())) for r in sensed]


@pytest.mark.parametrize("turns", [1, 2, 5])
@pytest.mark.parametrize("which", ["power", "samples", "both"])
def test_ticks_that_turn_in_one_series_or_in_both_keep_the_amplitude(percept, read, turns, which):
    true = turns * TURN_MS + 175_600
    tick = true % TURN_MS if which in ("samples", "both") else true
    power_tick = true % TURN_MS if which in ("power", "both") else true
    decoded = read(report_of(percept, run(percept, 600, tick, power_tick=power_tick + 250)))
    assert amplitudes(decoded) == [[2.0]]
    assert not any("amplitude" in text for text in decoded.reports[0].flagged)


def test_a_turn_within_a_run_keeps_the_amplitude(percept, read):
    domain, power = run(percept, 600, TURN_MS - 10_000)
    for row in power["LfpData"]:
        row["TicksInMs"] %= TURN_MS
    decoded = read(report_of(percept, (domain, power)))
    assert amplitudes(decoded) == [[2.0]]
    assert trace(decoded.recordings[0], "amplitude").valid.sum() == 10


def test_two_sides_of_which_one_turned_are_one_run(percept, read):
    domain, power = run(percept, 600, TURN_MS + 50_000)
    left = percept.time_domain(LEFT, percept.sine(20), first_tick=50_000)
    left["FirstPacketDateTime"] = domain["FirstPacketDateTime"]
    decoded = read(with_clocks(percept.report(BrainSenseTimeDomain=[domain, left], BrainSenseLfp=[power])))
    assert {r.run for r in decoded.recordings if r.run is not None} == {0}
    assert {r.duration_s for r in decoded.recordings if r.run is not None} == {20.0}


def test_of_two_runs_a_turn_apart_the_date_decides(percept, read):
    early, late = run(percept, 60, 500_000, ma=1.0), run(percept, 60 + TURN_MS / 1000, TURN_MS + 500_000, power_tick=500_000, ma=3.0)
    made = with_clocks(percept.report(BrainSenseTimeDomain=[early[0], late[0]], BrainSenseLfp=[late[1], early[1]]), minutes=90)
    assert amplitudes(read(made)) == [[1.0], [3.0]]


def test_where_ticks_fit_two_runs_and_no_date_decides_the_amplitude_is_unknown_and_told(percept, read):
    runs = [run(percept, 60, 500_000, ma=1.0), run(percept, 60 + TURN_MS / 1000, TURN_MS + 500_000, power_tick=500_000, ma=3.0)]
    for domain, power in runs:
        domain["FirstPacketDateTime"] = power["FirstPacketDateTime"] = ""
    decoded = read(report_of(percept, *runs))
    assert amplitudes(decoded)[0] is None
    assert any("fits several runs and a date is missing" in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize("apart_s", [10, 1800, -600])
def test_power_that_is_dated_apart_is_no_part_of_the_run_with_equal_ticks(percept, read, apart_s):
    decoded = read(report_of(percept, run(percept, 900, 500_000, power_s=900 + apart_s)))
    assert amplitudes(decoded) == [None]
    assert any(f"dates them {abs(apart_s)} s apart: they are two runs" in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize("sentinel", [2**32 - 1, 2**31 - 1, 65_535, -1, None, "NaN"])
def test_a_power_that_is_no_reading_is_a_gap(percept, read, sentinel):
    domain, power = run(percept, 600, 500_000)
    for k in range(8, 12):
        power["LfpData"][k]["Right"]["LFP"] = sentinel
    trend = [{"DateTime": BEGIN.isoformat(), "LFP": sentinel, "AmplitudeInMilliAmps": sentinel}]
    diagnostic = {"LFPTrendLogs": {"HemisphereLocationDef.Right": {BEGIN.isoformat(): trend}}}
    decoded = read(report_of(percept, (domain, power), DiagnosticData=diagnostic))
    band = trace(decoded.recordings[0], "band_power")
    assert band.values[band.valid].max() < 140
    assert band.valid.sum() == 9
    assert decoded.recordings[-1].settings["trends"]["right"]["power_device_units"] == [None]
    assert decoded.recordings[-1].settings["trends"]["right"]["amplitude_ma"] == [None]
    number = isinstance(sentinel, int)
    assert any("4 values of LFP are the device's sign" in text for text in decoded.reports[0].flagged) is number
    assert any("trends: 2 values" in text for text in decoded.reports[0].flagged) is number


@pytest.mark.parametrize("sentinel", [25.5, 65_535, 2**32 - 1, -1])
def test_an_amplitude_that_is_no_reading_is_a_gap(percept, read, sentinel):
    domain, power = run(percept, 600, 500_000)
    for row in power["LfpData"]:
        row["Right"]["mA"] = sentinel
    assert amplitudes(read(report_of(percept, (domain, power)))) in ([None], [[]])


@pytest.mark.parametrize("ahead_s", [2254, 956, 5, 0, -700, -5 * 3600])
def test_a_clock_ahead_or_behind_is_corrected_everywhere_and_told(percept, read, ahead_s):
    at = (BEGIN + timedelta(seconds=605 + ahead_s)).isoformat()
    held = {
        "EventLogs": [
            {"DateTime": at, "ParameterTrendId": "ParameterTrendIdDef.TherapyStatus", "TherapyStatus": "TherapyChangeStatusDef.OFF"}
        ]
    }
    trend = [{"DateTime": at, "LFP": 100, "AmplitudeInMilliAmps": 1}]
    held["LFPTrendLogs"] = {"HemisphereLocationDef.Right": {at: trend}}
    decoded = read(report_of(percept, run(percept, 600, 500_000, ahead_s=ahead_s), ahead_s=ahead_s, DiagnosticData=held))
    first, history = decoded.recordings[0], decoded.recordings[-1]
    assert first.started_at == BEGIN + timedelta(seconds=600)
    assert first.settings["clock"]["ahead_s"] == ahead_s
    assert 0 < first.settings["clock"]["uncertainty_s"] <= 60
    assert history.started_at == BEGIN
    assert [(e.t_s, e.label) for e in history.events] == [(605.0, "therapy off")]
    assert history.settings["trends"]["right"]["unix_s"] == [(BEGIN + timedelta(seconds=605)).timestamp()]
    told = [*decoded.reports[0].flagged, *decoded.reports[0].understood]
    assert any("the implant's clock is" in text and "corrected" in text for text in told)


def test_numbers_that_are_written_as_text_are_the_same_numbers(percept, read):
    plain = report_of(percept, run(percept, 300, 100_000, ma=1.5))
    written = json.loads(json.dumps(plain))
    for row in written["BrainSenseLfp"][0]["LfpData"]:
        row["TicksInMs"] = str(row["TicksInMs"])
        for side in ("Left", "Right"):
            row[side] = {name: str(value) for name, value in row[side].items()}
    domain = written["BrainSenseTimeDomain"][0]
    domain |= {"SampleRateInHz": "250", "TimeDomainData": [str(round(v, 6)) for v in domain["TimeDomainData"]]}
    for stream in ("amplitude", "band_power", "beta"):
        one, other = (trace(read(report).recordings[0], stream).values for report in (plain, written))
        np.testing.assert_allclose(one, other, atol=1e-4)


def test_the_spectra_of_a_survey_are_named_by_their_time_in_utc(percept, read):
    survey = percept.time_domain(RIGHT, percept.sine(20))
    survey["FirstPacketDateTime"] = (BEGIN + timedelta(seconds=2254 + 60)).isoformat()
    result = read(report_of(percept, run(percept, 300, 100_000, ahead_s=2254.0), ahead_s=2254.0, LfpMontageTimeDomain=[survey]))
    (spectrum,) = result.recordings[-1].spectra
    assert spectrum.channel == f"{RIGHT} LfpMontageTimeDomain 15:01:00"


def test_a_clock_that_drifts_within_the_session_is_followed(percept, read):
    decoded = read(report_of(percept, run(percept, 1200, 500_000, ahead_s=945), ahead_s=900, ahead_at_end_s=990))
    assert abs((decoded.recordings[0].started_at - BEGIN).total_seconds() - 1200) < 2
    assert decoded.recordings[0].settings["clock"]["uncertainty_s"] == 90
    assert any("15 min ahead of UTC at the begin, 16 min 30 s ahead of at the end" in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize(
    ("missing", "why"),
    [
        (["SessionDate", "SessionEndDate"], "the report has no SessionDate"),
        (["DeviceDateTime"], "the report has no DeviceDateTime"),
        (["SessionDate", "SessionEndDate", "DeviceDateTime"], "no DeviceDateTime and no SessionDate"),
    ],
)
def test_a_report_that_cannot_show_its_clock_says_that_it_is_unknown(percept, read, missing, why):
    made = report_of(percept, run(percept, 600, 500_000, ahead_s=2254), ahead_s=2254)
    for name in missing:
        made.pop(name, None)
        for part in made["DeviceInformation"].values():
            part.pop(name, None)
    decoded = read(made)
    assert decoded.recordings[0].settings["clock"]["known"] is False
    assert any("the implant's clock is unknown" in text and why in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize("date", ["", "1900-01-01T00:00:00Z", "2000-01-01T00:00:00Z", "2026-03-05T00:00:00Z"])
@pytest.mark.parametrize("field", ["SessionDate", "DeviceDateTime", "both"])
def test_blackened_dates_give_no_clock(percept, read, date, field):
    made = report_of(percept, run(percept, 600, 500_000, ahead_s=956), ahead_s=956)
    if field in ("SessionDate", "both"):
        made |= {"SessionDate": date, "SessionEndDate": date}
    if field in ("DeviceDateTime", "both"):
        for part in made["DeviceInformation"].values():
            part["DeviceDateTime"] = date
    assert read(made).recordings[0].settings["clock"]["known"] is False


def test_a_session_date_with_an_offset_is_converted(percept, read):
    made = report_of(percept, run(percept, 600, 500_000, ahead_s=956), ahead_s=956)
    made["SessionDate"], made["SessionEndDate"] = "2026-03-05T10:00:00-05:00", "2026-03-05T16:40:00+01:00"
    assert read(made).recordings[0].started_at == BEGIN + timedelta(seconds=600)


def test_one_pair_of_dates_is_enough_and_its_uncertainty_is_larger(percept, read):
    made = report_of(percept, run(percept, 600, 500_000, ahead_s=956), ahead_s=956)
    del made["SessionEndDate"]
    first = read(made).recordings[0]
    assert (first.started_at, first.settings["clock"]["uncertainty_s"]) == (BEGIN + timedelta(seconds=600), 60.0)


def groups(letter="B", cycling=None, active=True):
    return {"Final": [{"GroupId": f"GroupIdDef.GROUP_{letter}", "ActiveGroup": active, "GroupSettings": {"Cycling": cycling}}]}


@pytest.mark.parametrize(
    "cycling",
    [
        {"Enabled": True, "OnDurationInSeconds": 60, "OffDurationInSeconds": 60},
        {"Enabled": True, "OnDurationInMilliSeconds": 60_000, "OffDurationInMilliSeconds": 60_000},
        {"CyclingStatus": "CyclingStatusDef.ENABLED", "CycleOnDurationInSeconds": 60, "CycleOffDurationInSeconds": 60},
    ],
)
def test_cycling_is_told_and_the_amplitude_is_unknown(percept, read, cycling):
    decoded = read(report_of(percept, run(percept, 600, 500_000), Groups=groups(cycling=cycling)))
    assert amplitudes(decoded) == [[]]
    assert any("group B cycles its stimulation (60 s on, 60 s off)" in text for text in decoded.reports[0].flagged)
    assert decoded.recordings[0].settings["cycling"] == {"enabled": True, "on_s": 60.0, "off_s": 60.0}


@pytest.mark.parametrize("therapy", [groups(cycling={"Enabled": False}), groups("A", {"Enabled": True}), groups(cycling=None), {}])
def test_a_group_that_does_not_cycle_keeps_its_amplitude(percept, read, therapy):
    decoded = read(report_of(percept, run(percept, 600, 500_000), Groups=therapy))
    assert amplitudes(decoded) == [[2.0]]
    assert not any("cycles" in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize("section", ["IndefiniteStreaming", "LfpMontageTimeDomain", "SenseChannelTests", "CalibrationTests"])
def test_loss_is_told_in_every_section_of_samples(percept, read, section):
    domains = [percept.time_domain(name, percept.sine(30), lost=tuple(range(20, 40))) for name in (RIGHT, LEFT)]
    flagged = read(with_clocks(percept.report(**{section: domains}))).reports[0].flagged
    assert [f"{section}, {c}: 33.3 % of the samples are missing (2500)" in flagged for c in (RIGHT, LEFT)] == [True, True]


def test_the_devices_log_shows_what_it_knows_and_names_what_it_does_not(percept, read):
    entries = [
        {"RechargeSessionType": "RechargeSessionStateDef.SessionEnd"},
        {"ParameterTrendId": "ParameterTrendIdDef.ActiveGroup", "NewGroupId": "GroupIdDef.GROUP_C", "OldGroupId": "GroupIdDef.GROUP_A"},
        {"TherapyStatus": "TherapyChangeStatusDef.SuspendedByZebra"},
        {"SensingStatus": "SensingStatusDef.DISABLED"},
        {"ZebraStatus": "ZebraStatusDef.ON"},
        {"ImpedanceStatus": "ImpedanceStateDef.POOR"},
    ]
    log = [{"DateTime": (BEGIN + timedelta(seconds=k)).isoformat(), **entry} for k, entry in enumerate(entries)]
    decoded = read(report_of(percept, run(percept, 600, 500_000), DiagnosticData={"EventLogs": log}))
    labels = [e.label for e in decoded.recordings[-1].events]
    assert labels == [
        "recharge ended",
        "active group A to C",
        "therapy suspended…",
        "sensing disabled",
        "… status ON",
        "impedance status POOR",
    ]
    named = next(text for text in decoded.reports[0].flagged if "names that this version does not know" in text)
    assert "therapy status: TherapyChangeStatusDef.Suspended…" in named
    assert "Zebra" not in repr(decoded)


@pytest.mark.parametrize(("spelling", "target"), [("Stn", "STN"), ("STN", "STN"), ("Gpi", "GPi"), ("GPI", "GPi"), ("Vim", "VIM")])
def test_the_target_of_a_side_is_known_in_any_spelling(percept, read, spelling, target):
    made = report_of(percept, run(percept, 600, 500_000))
    made["LeadConfiguration"] = {"Final": [{"Hemisphere": "HemisphereLocationDef.Right", "LeadLocation": f"LeadLocationDef.{spelling}"}]}
    assert read(made).recordings[0].settings["leads"] == [f"right {target}"]
