"""Loose and packed files: RC+S files are known by their content, and gzip and tar give the same session as a zip."""

from __future__ import annotations

import gzip
import io
import json
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import pytest

from app.ingest.uploads.incoming import Incoming, arrange
from app.platform import files
from tests.app.ingest.conftest import device_zip, loose, steady

INFO = {"DeviceId": "NPC1", "SessionId": "1700000000000"}


def made(stem: str, **info: str) -> tuple[str, bytes]:
    """Build a loose file of one record that names its implant and session."""
    body = {
        "RawDataPower": {"PowerDomainData": []},
        "TimeSync": {"TimeSyncData": []},
        "DeviceSettings": {"UtcOffset": -7, "GeneralData": {}},
        "StimLog": {"therapyStatusData": {"therapyStatus": 1}},
    }[stem]
    return f"{stem}.json", json.dumps([{"RecordInfo": INFO | info, **body}]).encode()


def bundles(*parts: tuple[str, bytes]) -> tuple[list[set[str]], list[str]]:
    """Return the members of each bundle, and the remarks on them."""
    arranged = arrange([Incoming(name, io.BytesIO(content)) for name, content in parts])
    held = []
    for one in arranged.incoming:
        with zipfile.ZipFile(one.stream) as archive:
            held.append({f"{n} {json.loads(archive.read(n))[0]['RecordInfo']['DeviceId']}" for n in archive.namelist()})
    return held, [s for aside in arranged.asides for s in (*aside.flagged, *aside.ignored)]


@pytest.mark.parametrize("other", [{"DeviceId": "NPC2"}, {"SessionId": "1700000900000"}])
@pytest.mark.usefixtures("data_folder")
def test_files_of_two_implants_or_sessions_become_two_recordings_and_that_is_said(other: dict[str, str]) -> None:
    device = other.get("DeviceId", "NPC1")
    held, said = bundles(made("RawDataPower"), made("TimeSync"), made("DeviceSettings", **other), made("StimLog", **other))
    assert sorted(map(sorted, held)) == sorted(
        [["RawDataPower.json NPC1", "TimeSync.json NPC1"], [f"DeviceSettings.json {device}", f"StimLog.json {device}"]]
    )
    assert len(said) == 1
    assert "2 implants or sessions" in said[0]


@pytest.mark.usefixtures("data_folder")
def test_a_file_that_names_its_implant_alone_joins_the_only_recording_of_it() -> None:
    name, content = made("StimLog")
    alone = json.loads(content)
    del alone[0]["RecordInfo"]["SessionId"]
    held, _ = bundles(made("RawDataPower"), (name, json.dumps(alone).encode()), made("TimeSync", DeviceId="NPC2"))
    assert sorted(map(len, held)) == [1, 2]


@pytest.mark.usefixtures("data_folder")
def test_an_empty_file_among_two_recordings_is_left_out_and_said() -> None:
    held, said = bundles(made("RawDataPower"), made("TimeSync", DeviceId="NPC2"), ("ErrorLog.json", b"[]"))
    assert sorted(map(len, held)) == [1, 1]
    assert any("does not say which of the recordings" in s for s in said)


@pytest.mark.parametrize("name", ["RawDataPower (1).json", "power of the left side.json", "RawDataPower_copy.txt"])
@pytest.mark.usefixtures("data_folder")
def test_a_loose_file_is_known_by_its_content_whatever_its_name(name: str) -> None:
    held, said = bundles((name, made("RawDataPower")[1]), made("StimLog"))
    assert held == [{"RawDataPower.json NPC1", "StimLog.json NPC1"}]
    assert said == []


@pytest.mark.usefixtures("data_folder")
def test_the_same_bytes_under_two_names_are_one_file() -> None:
    held, said = bundles(made("RawDataPower"), ("RawDataPower (1).json", made("RawDataPower")[1]))
    assert held == [{"RawDataPower.json NPC1"}]
    assert said == ["the same bytes came twice in this upload; counted once"]


def test_two_implants_in_one_heap_of_loose_files_are_two_recordings(send: Any) -> None:
    answer = send(*loose(device_zip()), *loose(device_zip(who="P2", minute=20, seed=9)))
    assert answer.status_code == 201
    assert sorted(f["name"] for f in answer.json()["files"]) == ["RC+S files 1 (9 files together)", "RC+S files 2 (9 files together)"]
    assert len(answer.json()["proposals"]) == 2
    assert any("never mixed" in s for r in answer.json()["report"] for s in r["flagged"])


def test_a_damaged_real_file_under_another_name_is_decoded_by_itself(send: Any, recordings: Path) -> None:
    path = recordings / "rcs" / "malformed" / "RawDataTD_INF_token.json"
    answer = send((path.name, path.read_bytes()))
    assert answer.status_code == 201
    assert answer.json()["files"][0]["kind"] == "rcs"
    assert any("INF" in s for r in answer.json()["report"] for s in r["repaired"])


def test_a_folder_of_an_archive_with_two_implants_is_stored_as_two_recordings_and_that_is_said(send: Any) -> None:
    mine, other = dict(loose(device_zip())), dict(loose(device_zip(who="P2", seed=9)))
    mixed = io.BytesIO()
    with zipfile.ZipFile(mixed, "w") as archive:
        for name, content in mine.items():
            archive.writestr(f"Device/{name}", other[name] if name in ("DeviceSettings.json", "StimLog.json") else content)
    answer = send(("mixed.zip", mixed.getvalue()))
    assert answer.status_code == 201
    body = answer.json()
    assert any("2 implants or sessions" in s for s in body["report"][0]["repaired"])
    with zipfile.ZipFile(files.path_of(body["files"][0]["stored_sha256"])) as archive:
        folders = {n.rsplit("/", 1)[0] for n in archive.namelist()}
    assert len(folders) == 2


def as_tar(archive: bytes, mode: str) -> bytes:
    """Pack the files of a zip as a tar."""
    sink = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as zipped, tarfile.open(fileobj=sink, mode=mode) as tar:  # type: ignore[call-overload]
        for name in zipped.namelist():
            info = tarfile.TarInfo(name)
            info.size = zipped.getinfo(name).file_size
            tar.addfile(info, io.BytesIO(zipped.read(name)))
    return sink.getvalue()


@pytest.mark.parametrize("mode", ["w", "w:gz"])
def test_a_tar_of_a_session_gives_the_session_of_its_zip(send: Any, mode: str) -> None:
    packed = send(("session.tar.gz", as_tar(device_zip(), mode)), visit=1, controller="random")
    assert packed.status_code == 201, packed.text
    assert "a tar archive was unpacked" in packed.text
    zipped = send(("session.zip", device_zip()), visit=1, controller="random")
    assert zipped.json()["sessions"] == packed.json()["sessions"]


def test_a_table_in_gzip_is_the_table(send: Any) -> None:
    answer = send(("t.csv.gz", gzip.compress(steady(1.0))), visit=1, controller="cdbs")
    assert answer.status_code == 201, answer.text
    assert len(answer.json()["sessions"]) == 1


def test_a_7z_archive_is_explained(send: Any) -> None:
    answer = send(("session.7z", b"7z\xbc\xaf\x27\x1c\0\x04" + bytes(24)))
    assert answer.status_code == 422
    assert "this is a 7-Zip archive" in answer.text
    assert "zip the session's folder" in answer.text
