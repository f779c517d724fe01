"""Quarantine keeps unreadable files encrypted until a person releases or discards them; every decision is on record."""

from __future__ import annotations

import io
import re
import zipfile
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.ingest.quarantine.serializers import problem_of
from app.ingest.uploads import reading
from app.ingest.uploads.reading import Cleaned
from app.platform import files
from app.tables.audit import AuditEvent
from app.tables.uploads import StoredFile, UploadFile
from ml.formats.recording import UndecodableFile
from tests.app.ingest.conftest import device_zip, steady

SECRET = b"\x00\x01 Jane Example, born 1950 " * 10


@pytest.fixture
def held(send: Any) -> dict[str, Any]:
    """A file that no decoder reads."""
    answer = send(("noise.bin", SECRET), ("t.csv", steady(1)), visit=1).json()
    return next(f for f in answer["files"] if f["quarantined"])


def decide(client: TestClient, file: dict[str, Any], what: str, **body: Any) -> Any:
    return client.post(f"/api/v1/uploaded-files/{file['id']}/{what}", json=body)


def events(db: Session, file: dict[str, Any]) -> list[AuditEvent]:
    query = select(AuditEvent).where(AuditEvent.entity == "upload_file", AuditEvent.entity_id == str(file["id"]))
    return list(db.scalars(query.order_by(AuditEvent.id)))


def test_the_quarantine_lists_what_is_held_and_why(held: dict[str, Any], client: TestClient) -> None:
    (row,) = client.get("/api/v1/participants/P1/quarantine").json()
    assert (row["id"], row["held"], row["status"]) == (held["id"], True, "failed")
    assert "no format this service reads" in row["problem"]
    assert "Jane" not in str(row)


def test_a_review_gives_the_bytes_and_leaves_a_trace(held: dict[str, Any], client: TestClient, db: Session) -> None:
    answer = decide(client, held, "review")
    assert answer.content == SECRET
    assert answer.headers["content-disposition"].startswith("attachment")
    looked, taken = events(db, held)[-2:]
    assert looked.after is not None
    assert (looked.actor, looked.after["reviewed_by"]) == ("admin@clinic.example", "admin@clinic.example")
    assert (taken.actor, taken.action) == ("admin@clinic.example", "export")


def test_a_discarded_file_loses_its_bytes_and_keeps_its_row(held: dict[str, Any], client: TestClient, db: Session) -> None:
    sealed = held["stored_sha256"]
    assert files.path_of(sealed).exists()
    assert decide(client, held, "discard", reason="").status_code == 422
    assert decide(client, held, "discard", reason="a holiday picture").json()["status"] == "discarded"
    assert not files.path_of(sealed).exists()
    row = db.get_one(UploadFile, held["id"])
    assert (row.stored_sha256, row.quarantine_sha256, row.original_sha256) == (None, None, held["sha256"])
    assert db.get(StoredFile, sealed) is None
    assert (row.decided_by, row.decision_reason) == ("admin@clinic.example", "a holiday picture")
    assert "a holiday picture" in [e.reason for e in events(db, held)]
    assert decide(client, held, "discard", reason="again").status_code == 409


def test_a_file_is_released_as_it_is_only_after_somebody_looked(held: dict[str, Any], client: TestClient, db: Session) -> None:
    refused = decide(client, held, "release", how="as_is", reason="a calibration without names")
    assert refused.status_code == 409
    assert "No person has looked" in refused.json()["detail"]
    decide(client, held, "review")
    assert decide(client, held, "release", how="as_is", reason="a calibration without names").json()["status"] == "released"
    row = db.get_one(UploadFile, held["id"])
    assert row.released_sha256 == held["sha256"]
    assert files.read(held["sha256"]) == SECRET
    assert not files.path_of(held["stored_sha256"]).exists()


def test_a_file_that_still_cannot_be_read_stays_and_the_answer_says_why(held: dict[str, Any], client: TestClient) -> None:
    answer = decide(client, held, "release", how="read", reason="the new version")
    assert answer.status_code == 422
    assert "still cannot be read" in answer.json()["detail"]
    assert files.path_of(held["stored_sha256"]).exists()


def test_a_better_decoder_reads_what_was_held(
    send: Any, client: TestClient, db: Session, monkeypatch: pytest.MonkeyPatch, proposals: Any
) -> None:
    content, real = device_zip(), reading.clean
    too_old = UndecodableFile("no format this service reads", "first bytes", "Wait for an update.")
    monkeypatch.setattr(reading, "clean", lambda *_: Cleaned("unreadable", problem=too_old))
    file = send(("s.zip", content)).json()
    assert file["report"][0]["problem"]["what"] == "no format this service reads"
    monkeypatch.setattr(reading, "clean", real)
    held = client.get("/api/v1/participants/P1/quarantine").json()[0]
    answer = decide(client, held, "release", how="read", reason="decoder of version 3")
    assert answer.status_code == 200, answer.text
    assert (answer.json()["status"], answer.json()["held"], answer.json()["kind"]) == ("decoded", False, "rcs")
    row = db.get_one(UploadFile, held["id"])
    assert row.stored_sha256 is not None
    with zipfile.ZipFile(io.BytesIO(files.read(row.stored_sha256))) as archive:
        assert not any("SYN000001H" in n or b"SYN000001H" in archive.read(n) for n in archive.namelist())
    assert len(proposals()) == 1
    again = send(("s.zip", content)).json()
    assert again["duplicate"] is True
    assert [p["session"]["id"] for p in again["proposals"]] == [proposals()[0]["session"]["id"]]


@pytest.mark.parametrize("over", ["site", "study", "withdrawn"])
def test_nothing_new_is_read_for_whom_it_is_over(
    send: Any, client: TestClient, monkeypatch: pytest.MonkeyPatch, proposals: Any, over: str
) -> None:
    """Bytes that came before are discarded or stored as they came where a site has ended, or a participant has withdrawn."""
    real = reading.clean
    monkeypatch.setattr(reading, "clean", lambda *_: Cleaned("unreadable", problem=UndecodableFile("too new", "file", "Wait.")))
    send(("s.zip", device_zip()))
    monkeypatch.setattr(reading, "clean", real)
    (held,) = client.get("/api/v1/participants/P1/quarantine").json()
    why = {"reason": "the last visit was held"}
    ends = {"site": "/api/v1/studies/main/sites/main/end", "study": "/api/v1/studies/main/end"}
    if over == "withdrawn":
        assert client.patch("/api/v1/participants/P1", json={"status": "withdrawn", **why}).status_code == 200
    else:
        assert client.post(ends[over], json=why).status_code == 200
    answer = decide(client, held, "release", how="read", reason="decoder of version 3")
    assert (answer.status_code, proposals()) == (403 if over == "study" else 409, [])
    assert re.search("has ended|has withdrawn", answer.text)
    page = client.get("/participants/P1/quarantine").text
    assert ('value="read"' in page, 'value="discard"' in page) == (False, over != "study")
    assert decide(client, held, "discard", reason="not needed").status_code == (403 if over == "study" else 200)


def test_bytes_that_were_read_meanwhile_are_not_read_twice(send: Any, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    content, real = device_zip(), reading.clean
    monkeypatch.setattr(reading, "clean", lambda *_: Cleaned("unreadable", problem=UndecodableFile("too new", "file", "Wait.")))
    send(("s.zip", content))
    monkeypatch.setattr(reading, "clean", real)
    assert send(("s.zip", content)).status_code == 201
    held = next(f for f in client.get("/api/v1/participants/P1/quarantine").json() if f["held"])
    answer = decide(client, held, "release", how="read", reason="now")
    assert answer.status_code == 409
    assert "Discard this copy" in answer.json()["hint"]


def test_tampered_bytes_are_refused_in_words(held: dict[str, Any], client: TestClient) -> None:
    path = files.path_of(held["stored_sha256"])
    sealed = path.read_bytes()
    path.write_bytes(sealed[:-40])
    assert decide(client, held, "review").status_code == 409
    # each part opens with the installation's key; together they are not what came
    for exchanged in (b"", sealed + sealed):
        path.write_bytes(exchanged)
        assert decide(client, held, "review").status_code == 409
    path.write_bytes(sealed)
    assert decide(client, held, "review").status_code == 200
    path.unlink()
    assert "missing or damaged" in decide(client, held, "review").json()["detail"]


def with_a_broken_part(content: bytes) -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as target:
        for name in source.namelist():
            target.writestr(name, b"\xff\xfe not json" if name.endswith("EventLog.json") else source.read(name))
    return sink.getvalue()


def test_a_part_that_could_not_be_read_is_decided_on_without_touching_the_rest(send: Any, client: TestClient) -> None:
    (file,) = send(("s.zip", with_a_broken_part(device_zip()))).json()["files"]
    assert (file["status"], file["quarantined"]) == ("decoded", True)
    assert decide(client, file, "discard", reason="the log is broken").json()["status"] == "decoded"
    assert files.path_of(file["stored_sha256"]).exists()


def test_a_part_that_still_cannot_be_read_leaves_what_was_read_as_it_was(send: Any, client: TestClient, proposals: Any) -> None:
    (file,) = send(("s.zip", with_a_broken_part(device_zip()))).json()["files"]
    (before,) = proposals()
    answer = decide(client, file, "release", how="read", reason="a newer decoder").json()
    assert (answer["status"], answer["held"]) == ("decoded", True)
    assert [p["session"]["id"] for p in proposals()] == [before["session"]["id"]]


def test_only_a_clinician_or_an_administrator_decides(held: dict[str, Any], client_as: Any) -> None:
    for role, status in (("viewer", 403), ("engineer", 403), ("clinician", 200)):
        caller = client_as(role)
        assert decide(caller, held, "review").status_code == status, role
    assert decide(caller, held, "discard", reason="done").status_code == 200


def test_the_page_explains_once_and_gives_every_file_its_own_decision(send: Any, client: TestClient) -> None:
    send(*((f"n{i}.bin", SECRET + bytes([i])) for i in range(5)))
    page = client.get("/participants/P1/quarantine", headers={"Accept": "text/html"}).text
    numbers = [row["id"] for row in client.get("/api/v1/participants/P1/quarantine").json()]
    assert len(numbers) == 5
    assert page.count("hands a file to the present decoder") == 1
    assert page.count("no format this service reads") == 1
    assert all(page.count(f'action="/uploaded-files/{i}/decision"') == 1 and f'id="file-{i}"' in page for i in numbers)


def test_the_report_tells_files_of_one_name_apart_and_puts_what_is_of_use_first(send: Any, client: TestClient) -> None:
    answer = send(("a.bin", SECRET), ("b.bin", SECRET + b"1"), ("t.csv", steady(1)), visit=1).json()
    page = client.get(f"/uploads/{answer['id']}", headers={"Accept": "text/html"}).text
    places = {f["name"]: page.index(f">file {f['id']}<") for f in answer["files"]}
    assert places["t.csv"] < min(p for n, p in places.items() if n != "t.csv")
    assert len(set(places.values())) == 3


def test_why_members_could_not_be_read_is_stored_beside_the_sentences() -> None:
    lists = {name: [] for name in ("understood", "repaired", "ignored", "removed")}
    report = {"name": "rcs.zip", **lists, "flagged": ["other words"], "problem": None}
    row = UploadFile(report={"reports": [report], "unreadable": ["StimLog.json: damaged"]})
    assert problem_of(row) == "kept encrypted, because it could not be read: StimLog.json: damaged"
