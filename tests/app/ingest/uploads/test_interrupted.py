"""A service that is stopped in the middle of an upload: what had come is resumed, and nothing is read while it is still coming."""

from __future__ import annotations

import io
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.accounts.permissions import SYSTEM
from app.cli import app as command_line
from app.ingest.models import Upload, UploadFile
from app.ingest.sessions import StatedSession
from app.ingest.uploads import reading, service
from app.ingest.uploads.in_progress import in_progress, interrupted
from app.ingest.uploads.interrupted import resume
from app.ingest.uploads.receiving import Receiver
from app.ingest.uploads.service import Incoming
from app.platform.database import new_session
from app.study import repository as study
from app.study.models import Controller
from tests.app.ingest.conftest import steady


class Stopped(BaseException):
    """The process ends here."""


def cut_short(db: Session, monkeypatch: pytest.MonkeyPatch, where: Any, name: str, nth: int = 1, **stated: Any) -> int:
    """Send a table and a grasp test, and stop the process at the nth call of a function; number of the upload."""
    participant = study.participant_by_code(db, "P1", SYSTEM)
    real, calls = getattr(where, name), iter(range(1, 100))

    def stop(*args: Any, **named: Any) -> Any:
        if next(calls) == nth:
            raise Stopped
        return real(*args, **named)

    with monkeypatch.context() as patch, new_session() as dying:
        patch.setattr(where, name, stop)
        files = [Incoming("t.csv", io.BytesIO(steady(1))), Incoming("grasp.csv", io.BytesIO(b"t_s,hand\n1,L\n1.5,L\n2,L\n"))]
        mine = study.participant_by_code(dying, "P1", SYSTEM)
        with pytest.raises(Stopped):
            service.receive(dying, mine, StatedSession(**stated), files, SYSTEM)
    return int(db.scalars(select(Upload.id).where(Upload.participant_id == participant.id).order_by(Upload.id.desc())).first() or 0)


@pytest.mark.parametrize(
    ("where", "name", "nth", "files"),
    [(reading, "decode", 1, 1), (Receiver, "decode", 2, 2), (service, "make_sessions", 1, 2)],
    ids=["while the first file is decoded", "before the second file is decoded", "before the sessions are made"],
)
def test_an_upload_that_was_cut_short_is_taken_up(
    client: TestClient, enrolled: str, db: Session, monkeypatch: pytest.MonkeyPatch, where: Any, name: str, nth: int, files: int
) -> None:
    number = cut_short(db, monkeypatch, where, name, nth)
    assert client.get(f"/api/v1/uploads/{number}").json()["status"] == "received"
    (taken,) = resume("test")
    assert (taken.upload_id, taken.done) == (number, True)
    body = client.get(f"/api/v1/uploads/{number}").json()
    assert body["status"] == "decoded"
    assert [f["status"] for f in body["files"]] == ["decoded"] * files
    (proposal,) = client.get("/api/v1/participants/P1/proposals").json()
    assert proposal["session"]["controller"] == "cdbs"
    assert body["files"][0]["session_ids"] == [proposal["session"]["id"]]
    if name == "decode":
        assert "The service was stopped while it read this file" in repr(body["report"])
    if files == 2:
        assert client.get(f"/api/v1/uploads/{number}").json()["files"][1]["session_ids"] == [proposal["session"]["id"]]
    assert list(resume("test")) == []


def test_what_the_sender_had_stated_holds_when_it_is_taken_up(
    client: TestClient, enrolled: str, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    visit = study.visit_by_number(db, study.participant_by_code(db, "P1", SYSTEM).id, 1)
    cut_short(db, monkeypatch, service, "make_sessions", visit=visit, controller=Controller.RANDOM)
    assert [t.done for t in resume("test")] == [True]
    (session,) = client.get("/api/v1/visits/1/sessions").json()["items"]
    assert (session["controller"], session["status"]) == ("random", "confirmed")


def test_an_upload_that_is_still_coming_is_left_alone(enrolled: str, db: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    number = cut_short(db, monkeypatch, reading, "decode")
    with in_progress(number):
        assert interrupted(db) == []
        assert list(resume("test")) == []
    db.rollback()
    assert interrupted(db) == [number]


def test_the_command_takes_up_what_was_cut_short(enrolled: str, db: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    number = cut_short(db, monkeypatch, reading, "decode")
    result = CliRunner().invoke(command_line, ["ingest", "resume"])
    assert (result.exit_code, result.output) == (0, f"Upload {number}: files: 1, sessions: 1\n")
    assert CliRunner().invoke(command_line, ["ingest", "resume"]).output == "No upload was cut short.\n"


def test_bytes_that_nobody_can_read_are_told_when_they_are_taken_up(
    client: TestClient, enrolled: str, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, new_session() as dying:
        patch.setattr(Receiver, "decode", lambda *_: (_ for _ in ()).throw(Stopped()))
        noise, mine = Incoming("noise.bin", io.BytesIO(b"\x00\x01noise" * 20)), study.participant_by_code(dying, "P1", SYSTEM)
        with pytest.raises(Stopped):
            service.receive(dying, mine, StatedSession(), [noise], SYSTEM)
    assert [t.done for t in resume("test")] == [True]
    (file,) = db.scalars(select(UploadFile))
    assert (file.status, file.quarantine_sha256 is not None) == ("failed", True)
    (row,) = client.get("/api/v1/participants/P1/quarantine").json()
    assert "the service was stopped while it took this file" in row["problem"]
