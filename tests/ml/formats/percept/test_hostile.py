from __future__ import annotations

import json
import zipfile
from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ml.formats import UndecodableFile, decode, redact, sniff

RIGHT = "ONE_THREE_RIGHT"


def trace(recording, stream):
    return next(t for t in recording.traces if t.stream == stream)


def of_side(decoded, side, run=0):
    return next(r for r in decoded.recordings if r.hemisphere == side and r.run == run)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b'{"SessionDate": "2024-01-01T', "ends in the middle"),
        (b'{"SessionDate": 1, "Groups": {]}', "damaged"),
        (b'{"SessionDate": ' + b"[" * 200_000, "nested deeper|damaged|ends in the middle"),
        (b'{"SessionDate": ' + b'{"a":' * 100_000 + b"1" + b"}" * 100_000 + b"}", "nested deeper"),
        (b'{"SessionDate": ' + b"9" * 10_000 + b"}", "damaged"),
    ],
)
def test_a_report_that_is_no_whole_json_is_refused_with_a_reason(write, content, what):
    path = write(content)
    assert sniff(path) == "percept"
    with pytest.raises(UndecodableFile, match=what) as caught:
        decode(path)
    assert caught.value.hint


def test_a_single_json_of_something_else_is_no_report(write):
    for other in (b'{"hello": 1}', b'[{"RecordInfo": {}}]', b'{"Groups": []}'):
        with pytest.raises(UndecodableFile, match="single JSON file"):
            sniff(write(other))


@pytest.mark.parametrize("encode", [lambda t: b"\xef\xbb\xbf" + t, lambda t: t.decode().encode("utf-16"), lambda t: b"\n\n " + t])
def test_marks_and_encodings_of_spreadsheets_and_shells_are_read(write, encode, percept):
    path = write(encode(json.dumps(percept.one_run()).encode()), "table.csv")
    assert sniff(path) == "percept"
    assert of_side(decode(path), "right").duration_s == 20.0


def test_tokens_that_are_no_numbers_become_gaps(write, percept):
    report = percept.one_run()
    report["BrainSenseTimeDomain"][0]["TimeDomainData"][600:603] = [float("nan"), float("inf"), None]
    text = json.dumps(report).replace("Infinity", "INF")
    text = text.replace('"mA": 2.0', '"mA": -INF', 4).replace('"LFP": 105', '"LFP": 1e999').replace('"LFP": 106', '"LFP": ' + "9" * 400)
    decoded = decode(write(text.encode()))
    right = of_side(decoded, "right")
    assert np.isfinite(trace(right, "beta").values[trace(right, "beta").valid]).all()
    assert trace(right, "amplitude").valid.tolist() == [False, *[True] * 9]
    assert not trace(right, "band_power").valid[1]
    assert any("INF" in text for text in decoded.reports[0].repaired)


@pytest.mark.parametrize(
    "harm",
    [
        {"TicksInMses": "310250,1e300," + ",".join(["5"] * 38)},
        {"TicksInMses": [310250 + 10**9 * k for k in range(40)]},
        {"TicksInMses": "a,b,c"},
        {"TicksInMses": {"a": 1}},
        {"GlobalPacketSizes": "-125," * 40},
        {"GlobalPacketSizes": [1e300] * 40},
        {"GlobalPacketSizes": None},
        {"GlobalSequences": 7},
        {"SampleRateInHz": 0},
        {"SampleRateInHz": "NaN"},
        {"FirstPacketDateTime": "99999-01-01"},
        {"TimeDomainData": {"a": 1}},
        {"TimeDomainData": [[1, 2], [3]]},
        {"TimeDomainData": []},
        {"Channel": ["a"] * 1000},
        {"Channel": None},
    ],
)
def test_nonsense_in_a_field_never_stops_the_rest(write, harm, percept):
    report = percept.one_run()
    report["BrainSenseTimeDomain"][0].update(harm)
    decoded = decode(write(report))
    assert any(t.stream == "amplitude" for r in decoded.recordings for t in r.traces)
    assert all(t.values.size < 1000 for r in decoded.recordings for t in r.traces)


JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**20), 10**20),
    st.floats(),
    st.text(max_size=8),
    st.just([]),
    st.just({}),
    st.just([[[]]]),
    st.just({"a": {"b": 1}}),
    st.lists(st.one_of(st.none(), st.floats(), st.text(max_size=3)), max_size=4),
)
WHOLE = json.dumps(
    {
        "DeviceInformation": {"Final": {"NeurostimulatorSerialNumber": "N1"}, "Initial": {"DeviceDateTime": "2024-03-14T09:51:07Z"}},
        "LeadConfiguration": {"Final": [{"Hemisphere": "HemisphereLocationDef.Right"}]},
        "BatteryInformation": {"BatteryPercentage": 74},
        "Groups": {
            "Final": [
                {
                    "GroupId": "GroupIdDef.GROUP_A",
                    "ProgramSettings": {
                        "LeftHemisphere": {
                            "Programs": [{"AmplitudeInMilliAmps": 3.1, "ElectrodeState": [{"Electrode": "ElectrodeDef.Case"}]}]
                        },
                        "SensingChannel": [{"HemisphereLocation": "HemisphereLocationDef.Left", "SensingSetup": {"FrequencyInHertz": 20}}],
                    },
                }
            ]
        },
        "GroupHistory": [{"SessionDate": "2024-03-14T09:27:22Z", "Groups": [{"GroupId": "GroupIdDef.GROUP_A"}]}],
        "Impedance": [
            {"Hemisphere": [{"Hemisphere": "HemisphereLocationDef.Left", "SessionImpedance": {"Monopolar": [{"ResultValue": 1}]}}]}
        ],
        "LFPMontage": [{"Hemisphere": "HemisphereLocationDef.Left", "LFPFrequency": [0, 1], "LFPMagnitude": [1, 2]}],
        "PatientEvents": {"Initial": [{"EventName": "Tremor", "EventID": 1, "DateTime": "2024-03-14T09:27:22Z"}]},
        "BrainSenseTimeDomain": [
            {
                "Channel": RIGHT,
                "SampleRateInHz": 250,
                "FirstPacketDateTime": "2024-03-14T10:05:52.000Z",
                "GlobalSequences": "0,1",
                "GlobalPacketSizes": "125,125",
                "TicksInMses": "500,1000",
                "TimeDomainData": [1.0] * 250,
            }
        ],
        "BrainSenseLfp": [
            {
                "Channel": RIGHT,
                "SampleRateInHz": 2,
                "TherapySnapshot": {"ActiveGroup": "GroupIdDef.GROUP_B", "Right": {"FrequencyInHertz": 20}},
                "LfpData": [{"TicksInMs": 500, "Right": {"LFP": 1, "mA": 1}}, {"TicksInMs": 1000, "Right": {"LFP": 1, "mA": 1}}],
            }
        ],
        "DiagnosticData": {
            "LFPTrendLogs": {"HemisphereLocationDef.Left": {"2024-01-01T00:00:00Z": [{"DateTime": "2024-01-01T10:00:00Z", "LFP": 4}]}},
            "EventLogs": [{"DateTime": "2022-09-12T12:36:49Z", "SessionType": "SessionStateDef.SessionStart"}],
            "LfpFrequencySnapshotEvents": [
                {
                    "DateTime": "2024-01-01T10:00:00Z",
                    "LfpFrequencySnapshotEvents": {"HemisphereLocationDef.Left": {"Frequency": [0, 1], "FFTBinData": [1, 2]}},
                }
            ],
        },
    }
)


def places(node, path=()):
    yield path
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, inner in items:
        if path[-1:] != ("TimeDomainData",):
            yield from places(inner, (*path, key))


def there(node, key):
    return (isinstance(node, dict) and key in node) or (isinstance(node, list) and isinstance(key, int) and key < len(node))


PLACES = [p for p in places(json.loads(WHOLE)) if p]


@given(harm=st.lists(st.tuples(st.sampled_from(PLACES), JUNK), min_size=1, max_size=4))
@settings(max_examples=120, deadline=None)
def test_whatever_stands_at_any_place_of_a_report_the_rest_is_read_and_redacts_to_the_same(tmp_path_factory, harm):
    report = json.loads(WHOLE)
    for path, junk in harm:
        node = report
        for key in path[:-1]:
            node = node[key] if there(node, key) else {}
        if there(node, path[-1]):
            node[path[-1]] = deepcopy(junk)  # the strategies give one object many times
    folder = tmp_path_factory.mktemp("t")
    (folder / "s.json").write_text(json.dumps(report))
    before = decode(folder / "s.json", "percept")
    redact(folder / "s.json", folder / "t.json", "percept", b"a key of the clinic's own")
    after = decode(folder / "t.json", "percept")
    assert [r.fingerprint for r in before.recordings] == [r.fingerprint for r in after.recordings]


def test_a_damaged_member_is_told_and_the_other_reports_are_read(tmp_path):
    path = tmp_path / "two.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("good.json", WHOLE)
        archive.writestr("bad.json", WHOLE)
    damaged = bytearray(path.read_bytes())
    begin = zipfile.ZipFile(path).getinfo("bad.json").header_offset + 30 + len("bad.json")
    damaged[begin : begin + 200] = b"\xff" * 200
    path.write_bytes(bytes(damaged))
    decoded = decode(path)
    (problem,) = [r.problem for r in decoded.reports if r.problem]
    assert problem.what
    alone = tmp_path / "good.json"
    alone.write_text(WHOLE)
    assert [r.fingerprint for r in decoded.recordings] == [r.fingerprint for r in decode(alone).recordings]
    done = redact(path, tmp_path / "clean.zip", "percept", b"a key of the clinic's own")
    assert len(done.unreadable) == 1
    assert zipfile.ZipFile(tmp_path / "clean.zip").namelist() == ["report-2.json"]  # bad.json comes first by name


def test_samples_without_a_number_or_beyond_any_electrode_are_gaps_and_told(write, percept):
    report = percept.one_run()
    report["BrainSenseTimeDomain"][0]["TimeDomainData"][100:110] = [None, "NaN", 1e7, -1e7, None] * 2
    decoded = decode(write(report))
    beta = trace(of_side(decoded, "right"), "beta")
    assert beta.values[0] == pytest.approx(beta.values[4], rel=0.02)
    assert any("10 samples hold no number, or one beyond 100 mV" in text for text in decoded.reports[0].flagged)
    assert not any("samples hold no number" in text for text in decode(write(percept.one_run())).reports[0].flagged)
