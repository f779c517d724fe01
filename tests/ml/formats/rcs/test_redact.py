from __future__ import annotations

import dataclasses
import io
import json
import re
import zipfile

import numpy as np
import pytest

from ml.formats import UndecodableFile, decode
from ml.formats.rcs.redact import redact_rcs_zip
from ml.formats.redaction_record import pseudonym
from ml.formats.writers import RcsWorld, write_rcs

KEY = b"a key of the clinic's own"
REAL = ["stim_sweep", "embedded_adaptive", "montage_packet_loss", "empty_streams"]
REAL_SECRETS = [
    "NPC700",
    "SUBJ",
    "RCS0",
    "NLD0",
    "NLF0",
    "NKW0",
    "R STN",
    "R GPi",
    "Dystonia",
    "opened his eyes",
    "[78,80,67",
    "[78, 80, 67",
]


def unpacked(path):
    with zipfile.ZipFile(path) as archive:
        return "\n".join([name + "\n" + archive.read(name).decode() for name in archive.namelist()])


def assert_same_recording(first, second):
    for field in dataclasses.fields(first):
        a, b = getattr(first, field.name), getattr(second, field.name)
        if field.name in ("traces", "spectra"):
            assert len(a) == len(b)
            assert all(x.same_as(y) for x, y in zip(a, b, strict=True))
        elif field.name == "spectra":
            assert [s.channel for s in a] == [s.channel for s in b]
            assert all(np.array_equal(x.density, y.density) for x, y in zip(a, b, strict=True))
        elif field.name != "device_key":
            assert a == b, field.name


@pytest.mark.parametrize("name", REAL)
def test_a_redacted_recording_is_the_same_recording_without_identity(recordings, tmp_path, name):
    source, target = recordings / f"rcs/{name}.zip", tmp_path / "r.zip"
    original = unpacked(source)
    done = redact_rcs_zip(source, target, KEY)
    text = unpacked(target)
    assert any(secret in original for secret in REAL_SECRETS)
    assert [secret for secret in REAL_SECRETS if secret in text] == []
    (before,), (after,) = decode(source).recordings, decode(target).recordings
    assert_same_recording(before, after)
    assert after.device_key == pseudonym(before.device_key, KEY)
    assert any("SubjectInfo" in said for said in done.removed)
    assert before.device_key not in repr(done)


def secret_session(rcs):
    folder = "Ada Lovelace/Session1700000000000/DeviceNPC799999H/"
    settings = rcs.settings()
    settings[0]["Ada Lovelace"] = 1
    settings[0]["Comment"] = "Ada Lovelace, Ockham"
    settings[0]["FactorySettings"] = [
        {"name": "cfg_config_data.dev.HT_sns_amp1_gain250_trim", "actualValue": [236]},
        {"name": "cfg_config_data.core.HT_tel_m_id.tel_m_id", "actualValue": [64, 0, 84, 195, 207, 182]},
    ]
    td = rcs.time_domain(np.full(5000, 0.01))
    td[0]["TimeDomainData"][4]["Units"] = "millivolts of Ada Lovelace"
    return {
        folder + "DeviceSettings.json": settings,
        folder + "RawDataTD.json": td,
        folder + "StimLog.json": rcs.stim((-4, {"therapyStatusData": {"therapyStatus": 1, "activeGroup": 0}, **rcs.program(1.0)})),
        folder + "EventLog.json": [rcs.note(1.0, "Start Stim Run. Ada Lovelace at 2.0 mA")],
        folder + "ErrorLog.json": [{"RecordInfo": {"DeviceId": rcs.serial}, "Error": {"Descriptor": "Ada Lovelace"}}],
        "letter to Ada Lovelace.pdf": b"Ada Lovelace",
    }


def test_nothing_of_a_name_survives_in_bytes_names_or_report(rcs, pack, tmp_path):
    source, target = pack(secret_session(rcs)), tmp_path / "r.zip"
    done = redact_rcs_zip(source, target, KEY)
    for text in (unpacked(target), repr(done)):
        for secret in ("Lovelace", "Ockham", rcs.serial, "NPC799999H", "78, 80", "78,80", "195"):
            assert secret not in text
    assert_same_recording(decode(source).recordings[0], decode(target).recordings[0])
    assert done.ignored == ["1 file not of an RC+S session"]
    assert '"actualValue":[236]' in unpacked(target)


def test_fields_that_no_rcs_file_has_go_with_their_numbers_and_the_report_counts_them(rcs, pack, tmp_path):
    folder = "DeviceNPC799999H/"
    settings, td = rcs.settings(), rcs.time_domain(np.full(5000, 0.01))
    settings[0]["MRN"] = 987654321987
    settings[0]["GeneralData"]["HospitalNumber"] = [55, 56, 19450508]
    settings[0]["RecordInfo"]["ZZKEYJohn"] = {"Born": 19450509}
    for place, (key, value) in ((td[0]["TimeDomainData"][4], ("MRN", 987654321988)), (td[0], ("ZZKEYJohn", 987654321989))):
        place[key] = value
    td[0]["TimeDomainData"][7]["Header"]["MRN"] = 987654321990
    td[0]["TimeDomainData"][9]["ChannelSamples"][0]["MRN"] = 987654321991
    source = pack({folder + "DeviceSettings.json": settings, folder + "RawDataTD.json": td})
    target = tmp_path / "r.zip"
    done = redact_rcs_zip(source, target, KEY)
    text = unpacked(target)
    assert [s for s in ("MRN", "HospitalNumber", "ZZKEYJohn", "98765432", "1945", "Born") if s in text or s in repr(done)] == []
    assert "fields that no RC+S file is known to have, with their numbers (7×)" in done.removed
    assert_same_recording(decode(source).recordings[0], decode(target).recordings[0])


@pytest.mark.parametrize("name", REAL)
def test_no_field_of_a_real_recording_counts_as_unknown(recordings, tmp_path, name):
    done = redact_rcs_zip(recordings / f"rcs/{name}.zip", tmp_path / "r.zip", KEY)
    assert [said for said in done.removed if "no RC+S file is known to have" in said] == []


def test_the_same_bytes_in_give_the_same_bytes_out_and_redacting_twice_changes_nothing(rcs, pack, tmp_path):
    source = pack(secret_session(rcs))
    for name in ("a.zip", "b.zip"):
        redact_rcs_zip(source, tmp_path / name, KEY)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    redact_rcs_zip(tmp_path / "a.zip", tmp_path / "c.zip", KEY)
    assert unpacked(tmp_path / "c.zip") == unpacked(tmp_path / "a.zip")


def test_another_key_gives_another_name_and_a_short_key_is_refused(rcs, pack, tmp_path):
    assert pseudonym("NPC1", KEY) != pseudonym("NPC1", KEY[::-1])
    assert pseudonym(" npc1", KEY) == pseudonym("NPC1", KEY)
    with pytest.raises(ValueError, match="16 bytes"):
        redact_rcs_zip(pack(secret_session(rcs)), tmp_path / "r.zip", b"short")


def test_defects_are_said_and_what_cannot_be_read_is_named(rcs, pack, tmp_path):
    files = secret_session(rcs)
    folder = next(iter(files)).rsplit("/", 1)[0]
    files[f"{folder}/RawDataTD.json"] = json.dumps(files[f"{folder}/RawDataTD.json"])[:-300]
    files[f"{folder}/EventLog.json"] = "Ada Lovelace was here"
    target = tmp_path / "r.zip"
    done = redact_rcs_zip(pack(files), target, KEY)
    assert any(text.startswith("RawDataTD.json") and "is cut" in text for text in done.repaired)
    assert any(text.startswith("EventLog.json") for text in done.unreadable)
    assert "Lovelace" not in unpacked(target)
    assert decode(target).recordings[0].quality["time_domain"]["packets"] == 99


def test_two_devices_stay_two_devices(rcs, pack, tmp_path):
    files = {f"DeviceX{side}/StimLog.json": rcs.stim((0.25 * i, rcs.program(1.0))) for i, side in enumerate("LR")}
    target = tmp_path / "r.zip"
    redact_rcs_zip(pack(files), target, KEY)
    assert len(decode(target).recordings) == 2


def test_what_is_no_session_is_not_redacted_and_nothing_is_written(pack, tmp_path):
    target = tmp_path / "r.zip"
    with pytest.raises(UndecodableFile):
        redact_rcs_zip(pack({"x.txt": "Ada"}), target, KEY)
    assert not target.exists()


def test_amplitudes_that_are_written_as_text_are_kept(tmp_path):
    world = RcsWorld(began_ms=1_767_600_000_000, seconds=20, changes=((-1.0, 0, 1.5), (10.0, 0, 2.5)))
    content, _ = write_rcs(world)
    values = []
    for text in (False, True):
        source, target = tmp_path / f"{text}.zip", tmp_path / f"clean {text}.zip"
        with zipfile.ZipFile(io.BytesIO(content)) as plain, zipfile.ZipFile(source, "w") as written:
            for name in plain.namelist():
                changed = plain.read(name).decode()
                if text:
                    changed = re.sub(r'("(?:AmplitudeInMilliamps|amplitudeInMilliamps|therapyStatus)": )([\d.]+)', r'\1"\2"', changed)
                written.writestr(name, changed)
        redact_rcs_zip(source, target, KEY)
        (recording,) = decode(target).recordings
        values.append(next(t for t in recording.traces if t.stream == "amplitude").values)
    np.testing.assert_allclose(values[0], values[1])
    np.testing.assert_allclose(values[1][[1, -1]], [1.5, 2.5], atol=1e-6)
