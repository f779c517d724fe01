"""Identity stays outside: names of persons are searched for wherever anything of an uploaded file is kept or shown."""

from __future__ import annotations

import io
import json
import logging
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import inspect, text
from sqlalchemy.orm import Session

from app.ingest.uploads import reading, service
from app.learning.policies import constant_onnx
from app.platform.embedded.server import EmbeddedPostgres
from app.settings import get_settings
from tests.app.ingest.conftest import Send
from tests.app.ingest.safety import planted
from tests.app.ingest.safety.planted import NAME, NOTE, TOKENS, WHO
from tests.app.ingest.uploads import readers

PAGE = {"Accept": "text/html"}


def found(content: str | bytes) -> list[str]:
    """List the planted words in a text or in bytes, in either case, as text or hexadecimal digits."""
    raw = (content.encode(errors="replace") if isinstance(content, str) else content).lower()
    return [token for token in TOKENS if token.lower().encode() in raw or token.encode().hex().encode() in raw]


def in_tables(db: Session) -> dict[str, list[str]]:
    """List planted words by table, in whatever column."""
    hits: dict[str, list[str]] = {}
    names = inspect(db.connection()).get_table_names()
    assert {"upload", "upload_file", "recording", "trace", "audit_event", "policy"} <= set(names)
    for table in names:
        rows = "\n".join(db.scalars(text(f'select row_to_json(t)::text || t::text from "{table}" t')))
        if hit := found(rows):
            hits[table] = hit
    return hits


def in_files(folder: Path) -> dict[str, list[str]]:
    """List planted words by file below a folder, in its name, its bytes and, for an archive, its members."""
    return {str(path): hit for path in folder.rglob("*") if path.is_file() and (hit := [h for part in _parts(path) for h in found(part)])}


def _parts(path: Path) -> Iterator[str | bytes]:
    yield str(path.name)
    content = path.read_bytes()
    yield content
    if zipfile.is_zipfile(io.BytesIO(content)):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            yield archive.comment
            for name in archive.namelist():
                yield name
                yield archive.read(name)


def in_pages(client: TestClient, numbers: list[int]) -> dict[str, list[str]]:
    """List planted words by address, on every page and answer about uploads, and on error pages."""
    sessions = [p["session"]["id"] for p in client.get("/api/v1/participants/P1/proposals").json()]
    places = ["/participants/P1", *(f"/participants/P1/{p}" for p in ("upload", "proposals", "quarantine", "policies", "upload/progress"))]
    places += [f"/uploads/{n}" for n in numbers] + [f"/sessions/{n}" for n in sessions]
    places += [f"/api/v1/uploads/{n}" for n in numbers] + ["/api/v1/participants/P1/proposals", "/api/v1/participants/P1/quarantine"]
    places += [f"/api/v1/proposals/{n}" for n in sessions] + [f"/api/v1/sessions/{n}/trace" for n in sessions]
    places += ["/", "/api/v1/uploads/999999", "/uploads/999999", "/metrics", "/audit"]
    answers = {place: client.get(place, headers=PAGE if not place.startswith("/api") else {}) for place in places}
    assert sum(a.status_code == 200 for a in answers.values()) > 12
    return {place: hit for place, answer in answers.items() if (hit := found(answer.text))}


def outside_the_senders_words(answer: Any) -> list[str]:
    """List planted words in the answer to a sender, besides the names of files and the cells that are quoted only to that sender."""
    body = answer.json()
    for report in body.get("report", []):
        report["name"] = report["problem"] = None
    for file in body.get("files", []):
        file["name"] = None
    for name in ("detail", "file", "where", "title"):
        body.pop(name, None)
    return found(json.dumps(body))


def _waiting(answer: Any) -> list[int]:
    """List numbers of the tables that wait for a column mapping, in the answer to an upload or in its problem document."""
    listed = [f["id"] for f in answer.get("files", []) if f["waits_for_mapping"]]
    return [*listed, *answer.get("waits_for_mapping", [])]


def test_nothing_that_says_who_somebody_is_is_kept_or_said_anywhere(
    client: TestClient,
    send: Send,
    db: Session,
    server: EmbeddedPostgres,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    files = planted.every_file()
    together = send(*files, visit=1)
    assert together.status_code == 201, together.text
    answers = [together, *(send(one, visit=1, controller="cdbs") for one in files)]
    states = {f["status"] for f in together.json()["files"]}
    kinds = {f["kind"] for f in together.json()["files"]}
    assert (states, kinds) == ({"decoded", "failed"}, {"rcs", "percept", "csv", "parquet", "tremor", "grasp", "unreadable"})
    with monkeypatch.context() as patch:  # faults of ours, which quote what they met
        patch.setattr(reading, "CLEAN", f"{readers.__name__}:fault_of_cleaning")
        answers.append(send((f"{WHO}.zip", planted.rcs_zip() + b"\0"), visit=1))
    with monkeypatch.context() as patch:
        patch.setattr(reading, "DECODE", f"{readers.__name__}:fault_that_quotes")
        answers.append(send((f"{WHO}.csv", planted.steps(5.0).encode()), visit=1))
        assert "fault_that_quotes" in capfd.readouterr().err, "the fault stands in the log"

    def failing(*_: Any) -> None:
        raise ValueError(f"{WHO} {NOTE}")

    with monkeypatch.context() as patch:
        patch.setattr(service, "finish", failing)
        broken = send((f"{WHO}.csv", planted.steps(6.0).encode()), visit=1)
        page = client.post("/participants/P1/upload", files=[("file", (f"{WHO}.csv", planted.steps(7.0).encode()))], headers=PAGE)
    assert (broken.status_code, page.status_code) == (500, 500)
    assert (found(broken.text), found(page.text)) == ([], [])
    waiting = sorted({n for answer in answers for n in _waiting(answer.json())})
    assert waiting, "a table is previewed"
    places = [f"/uploaded-files/{n}/mapping" for n in waiting] + [f"/api/v1/uploaded-files/{n}/preview" for n in waiting]
    shown = {place: client.get(place, headers=PAGE if not place.startswith("/api") else {}) for place in places}
    assert {a.status_code for a in shown.values()} == {200}
    assert {place: hit for place, a in shown.items() if (hit := found(a.text))} == {}
    mapped = [client.put(f"/api/v1/uploaded-files/{n}/mapping", json=planted.MAPPING) for n in waiting]
    assert 200 in {a.status_code for a in mapped}, [a.text for a in mapped]
    answers += [a for a in mapped if a.status_code == 200]
    study = db.scalar(text("select code from study order by id"))
    assert found(client.get(f"/studies/{study}/column-mappings", headers=PAGE).text) == []
    for content in (constant_onnx(0.6, 10), b"not a network"):
        client.post("/api/v1/participants/P1/policies", data={"name": "theirs"}, files={"file": (f"{WHO}.onnx", content)})

    assert [hit for answer in answers if (hit := outside_the_senders_words(answer))] == []
    numbers = list(db.scalars(text("select id from upload order by id")))
    assert in_pages(client, numbers) == {}
    assert in_tables(db) == {}
    assert in_files(get_settings().data_dir) == {}
    assert found((server.data / "server.log").read_bytes()) == []
    captured = capfd.readouterr()
    assert (found(captured.out), found(captured.err), found(caplog.text)) == ([], [], [])


@pytest.mark.parametrize("place", ["table", "file", "page"])
def test_the_search_finds_what_is_kept(client: TestClient, send: Send, db: Session, place: str) -> None:
    number = send(("t.csv", planted.steps().encode()), visit=1).json()["id"]
    if place == "file":
        (get_settings().files_dir / "left").write_bytes(NAME.encode())
        assert list(in_files(get_settings().data_dir).values()) == [[NAME]]
        return
    db.execute(text("update upload_file set name = :name"), {"name": NAME})
    db.commit()
    assert in_tables(db) == {"upload_file": [NAME], "audit_event": [NAME]}
    if place == "page":
        assert f"/uploads/{number}" in in_pages(client, [number])
