from __future__ import annotations

import json
import zipfile

import pytest

from ml.formats import UndecodableFile, decode, redact, sniff
from ml.formats.percept.enums import is_known
from ml.formats.redaction_record import pseudonym

KEY = b"a key of the clinic's own"
SECRETS = ("Ada", "Lovelace", "MRN4711", "NPX799999H", "LEAD4711", "Ockham", "2020-02-20", "1815", "4711", "1990-12-10")


@pytest.fixture
def secret(percept):
    """A report with a name in every place that holds text."""
    report = percept.one_run(lost=(4,))
    report |= {
        "PatientEvents": {"Initial": [{"EventName": "Call Ada", "EventID": 3, "DateTime": "2024-03-14T10:00:00Z"}]},
        "Groups": {"Final": [{"GroupId": "GroupIdDef.GROUP_A", "GroupName": "Ada's group", "ActiveGroup": True, "ProgramSettings": {}}]},
        "ClinicianNotes": "Lovelace, born 1815",
        "Ada Lovelace": 4711,
        "EventSummary": {
            "Note": "Ada",
            "Comment": "lives in Ockham",
            "Ada Lovelace": 1,
            "PatientWeight": 60,
            "MRN": 4711,
            "DOB": "1990-12-10",
        },
        "DiagnosticData": {"EventLogs": [{"DateTime": "2024-03-14T10:00:00Z", "SessionType": "SessionStateDef.SessionStart"}]},
    }
    report["BrainSenseTimeDomain"][0]["Pass"] = "Ada"
    return report


def test_nothing_of_a_name_survives_and_the_recordings_are_the_same(write, tmp_path, secret, same_recording):
    source, target = write(secret), tmp_path / "r.json"
    done = redact(source, target, "percept", KEY)
    text = target.read_text()
    assert [s for s in SECRETS if s in text or s in repr(done)] == []
    first, second = decode(source), decode(target)
    assert len(first.recordings) == len(second.recordings) > 1
    for before, after in zip(first.recordings, second.recordings, strict=True):
        assert same_recording(before, after)
        assert after.device_key == pseudonym("NPX799999H", KEY)
    assert not any(s in repr(second) for s in SECRETS)
    assert any("PatientInformation" in said for said in done.removed)


def test_the_real_report_decodes_to_the_same_recordings(recordings, tmp_path, same_recording):
    source, target = recordings / "percept/percept_session_report.zip", tmp_path / "r.zip"
    done = redact(source, target, "percept", KEY)
    assert sniff(target) == "percept"
    for before, after in zip(decode(source).recordings, decode(target).recordings, strict=True):
        assert same_recording(before, after)
    with zipfile.ZipFile(target) as archive:
        assert archive.namelist() == ["report-1.json"]
        text = archive.read("report-1.json").decode()
    assert not any(
        gone in text for gone in ("PatientGenderDef", "Diagnosis", "1900-01-01", "myName", "Automatic increase", "Europe centrale")
    )
    assert "names of files" in done.removed


def test_enumerations_that_could_hold_a_name_are_replaced_and_counted(write, tmp_path, percept):
    report = percept.one_run()
    report["Groups"] = {
        "Final": [
            {"GroupId": "GroupIdDef.ZZGROUP", "ActiveGroup": True, "ProgramSettings": {}},
            {"GroupId": "GroupIdDef.GROUP_B", "ActiveGroup": False, "ProgramSettings": {}},
        ]
    }
    report["DeviceInformation"]["Final"]["NeurostimulatorLocation"] = "InsLocation.ZZLOC"
    report["LeadConfiguration"]["Final"][0] |= {"LeadLocation": "LeadLocationDef.Anton", "Model": "ZZNameDef.LEAD_B33005"}
    target = tmp_path / "r.json"
    done = redact(write(report), target, "percept", KEY)
    text = target.read_text()
    assert [s for s in ("ZZ", "Anton") if s in text or s in repr(decode(target))] == []
    assert "GroupIdDef.GROUP_B" in text
    said = next(text for text in done.removed if text.startswith("words of enumerations that no report is known to have (4×"))
    assert all(shown in said for shown in ("GroupIdDef.…", "InsLocation.…", "LeadLocationDef.…", "…Def.LEAD_…"))
    again = tmp_path / "again.json"
    redact(target, again, "percept", KEY)
    assert json.loads(again.read_text())["Groups"] == json.loads(text)["Groups"]


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("GroupIdDef_GROUP_A", True),
        ("ElectrodeDef.SenSight_1a", True),
        ("SensingChannelDef.ONE_A_AND_TWO_A_LEFT_SEGMENT", True),
        ("SessionStateDef.SessionStart", True),
        ("LeadModelDef.LEAD_B33015", True),
        ("LeadModelDef.LEAD_4711", False),
        ("ElectrodeDef.19900101", False),
        ("GroupIdDef.A_D_A", False),
        ("GroupIdDef.GROUP_ADA", False),
        ("AdaDef.GROUP_A", False),
        ("GroupIdDef.", False),
    ],
)
def test_an_enumeration_is_known_by_its_type_and_its_words(text, known):
    assert is_known(text) is known


def test_every_enumeration_of_the_real_report_stays(recordings, tmp_path):
    done = redact(recordings / "percept/percept_session_report.zip", tmp_path / "r.zip", "percept", KEY)
    assert [said for said in done.removed if "enumerations" in said] == []


def test_group_history_alone_survives(recordings, tmp_path, same_recording):
    source, target = recordings / "percept/group_history.json", tmp_path / "r.json"
    redact(source, target, "percept", KEY)
    assert same_recording(decode(source).recordings[0], decode(target).recordings[0])


def test_the_same_bytes_in_give_the_same_bytes_out_and_redacting_twice_changes_nothing(write, tmp_path, secret):
    source = write(secret)
    for name, origin in (("a", source), ("b", source), ("c", tmp_path / "a")):
        redact(origin, tmp_path / name, "percept", KEY)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes() == (tmp_path / "c").read_bytes()


def test_what_cannot_be_parsed_is_not_written(write, tmp_path, secret):
    target = tmp_path / "r.json"
    with pytest.raises(UndecodableFile, match="ends in the middle"):
        redact(write(json.dumps(secret).encode()[:-40]), target, "percept", KEY)
    assert not target.exists()


def test_a_report_of_an_archive_that_cannot_be_read_is_named_for_quarantine(pack, tmp_path, secret):
    target = tmp_path / "r.zip"
    source = pack({"Ada.json": secret, "Lovelace.json": json.dumps(secret)[:3000], "Ada.pdf": b"Ada"})
    done = redact(source, target, "percept", KEY)
    assert done.unreadable == ["report 2: the JSON text ends in the middle"]
    with zipfile.ZipFile(target) as archive:
        assert archive.namelist() == ["report-1.json"]
    assert not any(s in repr(done) for s in SECRETS)


def test_a_short_key_is_refused_before_anything_is_read(write, tmp_path, secret):
    with pytest.raises(ValueError, match="16 bytes"):
        redact(write(secret), tmp_path / "r.json", "percept", b"short")


def test_deeply_nested_parts_are_cut_off(write, tmp_path, percept):
    report = percept.one_run()
    deep: dict = {}
    for _ in range(200):
        deep = {"Initial": deep}
    report["EventSummary"] = deep
    target = tmp_path / "r.json"
    done = redact(write(report), target, "percept", KEY)
    assert any("nested" in said for said in done.removed)
    assert target.read_text().count('{"Initial"') < 50
