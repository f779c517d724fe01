"""The same bytes again, of use or not: stored once, and reported as what they are."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.ingest.uploads import reading
from app.settings import get_settings
from app.tables.uploads import StoredFile, UploadFile
from ml.formats.recording import UndecodableFile
from tests.app.ingest.conftest import steady
from tests.app.ingest.proposals.test_proposals import correct, post

NOISE = ("noise.bin", b"\x00\x01 Jane Example " * 10)


def kept_files() -> int:
    """Count files stored by their content; drafts and their locks are none."""
    return sum(p.is_file() and len(p.name) == 64 for p in get_settings().files_dir.rglob("*"))


def test_unreadable_bytes_sent_again_are_kept_once_and_read_again_each_time(send: Any, client: TestClient, db: Session) -> None:
    assert send(NOISE).status_code == 422
    kept = kept_files()
    again = send(NOISE, ("t.csv", steady(1)), NOISE, visit=1).json()
    assert len(list(db.scalars(select(UploadFile).where(UploadFile.status == "failed")))) == 1
    assert len(client.get("/api/v1/participants/P1/quarantine").json()) == 1
    assert kept_files() == kept + 1
    assert len(list(db.scalars(select(StoredFile)))) == kept + 1
    copies = [r for r in again["report"] if r["name"] == "noise.bin"]
    assert len(copies) == 2
    assert all("they are kept once" in r["understood"][0] and r["problem"] for r in copies)


def test_a_cleaned_file_that_cannot_be_decoded_is_kept_once(send: Any, db: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise UndecodableFile("the decoder knows no such table", "file", "Send another one.")

    monkeypatch.setattr(reading, "decode", refuse)
    for _ in range(3):
        assert send(("t.csv", steady(1))).status_code == 422
    assert len(list(db.scalars(select(UploadFile)))) == 1


def test_discarded_bytes_that_come_again_are_a_new_decision(send: Any, client: TestClient) -> None:
    send(NOISE)
    (row,) = client.get("/api/v1/participants/P1/quarantine").json()
    assert client.post(f"/api/v1/uploaded-files/{row['id']}/discard", json={"reason": "a picture"}).status_code == 200
    send(NOISE)
    assert [r["held"] for r in client.get("/api/v1/participants/P1/quarantine").json()] == [True, False]


def test_an_empty_file_is_told_and_neither_stored_nor_in_quarantine(send: Any, client: TestClient) -> None:
    answer = send(("empty.csv", b""), ("t.csv", steady(1)), visit=1).json()
    file = next(f for f in answer["files"] if f["name"] == "empty.csv")
    assert (file["status"], file["quarantined"], file["stored_sha256"]) == ("failed", False, None)
    assert "the file is empty" in repr(answer["report"])
    assert client.get("/api/v1/participants/P1/quarantine").json() == []


def test_copies_in_one_upload_are_told_as_copies(send: Any, recordings: Path) -> None:
    sweep = (recordings / "rcs" / "stim_sweep.zip").read_bytes()
    with zipfile.ZipFile(io.BytesIO(sweep)) as z:
        sink = io.BytesIO()
        with zipfile.ZipFile(sink, "w") as other:
            for name in z.namelist():
                other.writestr(name, z.read(name))
    answer = send(("a.zip", sweep), ("b.zip", sweep), ("c.zip", sink.getvalue()), visit=1).json()
    (proposal,) = answer["proposals"]
    number = proposal["session"]["id"]
    reports = [next(r for r in answer["report"] if r["name"] == f"{name}.zip") for name in "abc"]
    told = ["Proposed session" in " ".join(r["understood"]) for r in reports]
    assert told == [True, False, False]
    copies = [" ".join(r["understood"]) for r in reports[1:]]
    assert all(f"The same recording as in another file of this upload; it is session {number}." in s for s in copies)
    assert [f["session_ids"] for f in answer["files"]] == [[number]] * 3


def test_a_dropped_proposal_that_comes_back_is_not_told_as_nothing_changed(send: Any, client: TestClient) -> None:
    content = ("t.csv", steady(1))
    (proposal,) = send(content, visit=1).json()["proposals"]
    said = " ".join(send(content, visit=1).json()["report"][0]["understood"])
    assert "Nothing was changed." in said
    assert post(client, proposal, "discard", reason="a test").status_code == 204
    again = " ".join(send(content, visit=1).json()["report"][0]["understood"])
    assert "it is proposed anew" in again
    assert "Proposed session" in again
    assert "changed" not in again


def test_the_end_of_a_recording_as_the_form_shows_it_is_the_end(send: Any, client: TestClient, recordings: Path) -> None:
    report = ("r.zip", (recordings / "percept" / "percept_session_report.zip").read_bytes())
    (first, *_) = send(report, visit=1).json()["proposals"]
    assert first["session"]["duration_s"] == 205.5
    shorter = correct(client, first, stop_s=100).json()
    assert shorter["session"]["duration_s"] == 100
    assert correct(client, shorter, stop_s=205).json()["session"]["duration_s"] == 205.5


def test_what_was_left_out_of_an_archive_is_told_though_nothing_in_it_could_be_used(send: Any) -> None:
    answer = send(("nested.zip", archive_with({"DeviceX/inner.zip": b"PK\x03\x04", "../../x/RawDataTD.json": b"[]"})))
    assert answer.status_code == 422
    (report,) = answer.json()["report"]
    said = " ".join([*report["ignored"], *report["repaired"], *report["flagged"]])
    assert "archive" in said
    assert "outside" in said


def archive_with(members: dict[str, bytes]) -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return sink.getvalue()


def test_a_refusal_of_loose_files_of_two_recordings_says_what_they_have_in_common(send: Any) -> None:
    answer = send(("RawDataTD.json", b"{"), ("RawDataTD.json", b"["))
    assert answer.status_code == 422
    assert "came more than once" in answer.json()["detail"]
