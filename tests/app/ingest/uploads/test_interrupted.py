"""A service that is stopped in the middle of an upload: what had come is resumed, and nothing is read while it is still coming."""

from __future__ import annotations

import errno
import io
import threading
import time
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.accounts.permissions import SYSTEM
from app.cli import app as command_line
from app.ingest import wording
from app.ingest.sessions import StatedSession
from app.ingest.uploads import reading, service
from app.ingest.uploads.in_progress import in_progress, interrupted
from app.ingest.uploads.interrupted import keep_resuming, resume
from app.ingest.uploads.receiving import LETHAL, Receiver
from app.ingest.uploads.service import Incoming
from app.platform.database import new_session
from app.settings import get_settings
from app.study import repository as study
from app.tables.sessions import Controller
from app.tables.uploads import Upload, UploadFile
from tests.app.ingest.conftest import Send, steady
from tests.app.ingest.uploads import readers


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
    client: TestClient, participant_code: str, db: Session, monkeypatch: pytest.MonkeyPatch, where: Any, name: str, nth: int, files: int
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
        assert "Reading this file was cut short" in repr(body["report"])
    if files == 2:
        assert client.get(f"/api/v1/uploads/{number}").json()["files"][1]["session_ids"] == [proposal["session"]["id"]]
    assert list(resume("test")) == []


def test_what_the_sender_had_stated_holds_when_it_is_taken_up(
    client: TestClient, participant_code: str, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    visit = study.visit_by_number(db, study.participant_by_code(db, "P1", SYSTEM).id, 1)
    cut_short(db, monkeypatch, service, "make_sessions", visit=visit, controller=Controller.RANDOM)
    assert [t.done for t in resume("test")] == [True]
    (session,) = client.get("/api/v1/visits/1/sessions").json()["items"]
    assert (session["controller"], session["status"]) == ("random", "confirmed")


@pytest.mark.parametrize(
    ("ending", "undoing", "why"),
    [
        ("update participant set status = 'withdrawn'", "update participant set status = 'active'", "P1 has withdrawn"),
        ("update site set ended_at = now()", "update site set ended_at = null", "Site &#39;main&#39; has ended"),
        ("update study set ended_at = now()", "update study set ended_at = null", "Study &#39;main&#39; has ended"),
    ],
)
def test_what_was_cut_short_waits_while_nothing_new_is_taken(
    client: TestClient, participant_code: str, db: Session, monkeypatch: pytest.MonkeyPatch, ending: str, undoing: str, why: str
) -> None:
    number = cut_short(db, monkeypatch, service, "make_sessions")
    db.execute(text(ending))
    db.commit()
    (taken,) = resume("test")
    assert (taken.done, taken.left) == (False, True)
    assert client.get(f"/api/v1/uploads/{number}").json()["status"] == "received"
    assert client.get("/api/v1/participants/P1/proposals").json() == []
    page = client.get(f"/uploads/{number}", headers={"Accept": "text/html"}).text
    assert "is left as it is" in page
    assert why in page
    listed = client.get("/participants/P1/upload", headers={"Accept": "text/html"})
    assert wording.LEFT in listed.text or listed.status_code != 200
    assert (listed.status_code == 200) == ("site" in ending), "who may upload no more has no such page"
    assert CliRunner().invoke(command_line, ["ingest", "resume"]).exit_code == 0, "it is no fault"
    db.execute(text(undoing))
    db.commit()
    assert [t.done for t in resume("test")] == [True]


def test_an_upload_that_is_still_coming_is_left_alone(
    client: TestClient, participant_code: str, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    number = cut_short(db, monkeypatch, reading, "decode")
    page = lambda: client.get("/participants/P1/upload", headers={"Accept": "text/html"}).text  # noqa: E731
    assert (wording.WAITS in page(), wording.COMING in page()) == (True, False)
    with in_progress(number):
        assert (wording.WAITS in page(), wording.COMING in page()) == (False, True), "as by another web service"
        assert interrupted(db) == []
        assert list(resume("test")) == []
    db.rollback()
    assert interrupted(db) == [number]


def test_the_command_takes_up_what_was_cut_short(participant_code: str, db: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    number = cut_short(db, monkeypatch, reading, "decode")
    result = CliRunner().invoke(command_line, ["ingest", "resume"])
    assert (result.exit_code, result.output) == (0, f"Upload {number}: files: 1, sessions: 1\n")
    assert CliRunner().invoke(command_line, ["ingest", "resume"]).output == "No upload was cut short.\n"


def test_bytes_that_nobody_can_read_are_told_when_they_are_taken_up(
    client: TestClient, participant_code: str, db: Session, monkeypatch: pytest.MonkeyPatch
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


def until(found: Any, seconds: float = 60.0) -> Any:
    """Wait until a question has an answer, and return it."""
    deadline = time.monotonic() + seconds
    while not (answer := found()):
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.05)
    return answer


NO_ROOM = OSError(errno.ENOSPC, "No space left on device")
GONE = OperationalError("commit", {}, Exception("server closed the connection unexpectedly"))
KEPT = "Upload 1 was cut short: the bytes of 2 of its 2 files are kept."
READ = "What is kept is read by itself within some minutes"
THERE = "its report will be on /uploads/1."
CUT = {
    "full": (NO_ROOM, 507, f"There is no room left on the disk. {KEPT}", f"Ask your administrator to make room. {READ} of that: {THERE}"),
    "away": (GONE, 503, f"The database does not answer for the moment. {KEPT}", f"{READ} of its coming back: {THERE}"),
    "ours": (ZeroDivisionError("ours"), 500, KEPT, f"{READ}: {THERE}"),
}
TWO = (("t.csv", steady(1)), ("grasp.csv", b"t_s,hand\n1,L\n1.5,L\n2,L\n"))


def failing(fault: Exception) -> Any:
    """Return a function that a fault befalls."""

    def fails(*_: Any, **__: Any) -> None:
        raise fault

    return fails


@pytest.mark.parametrize(("fault", "status", "detail", "hint"), CUT.values(), ids=CUT.keys())
def test_a_fault_after_the_bytes_are_safe_tells_so_and_is_mended_without_a_restart(
    send: Send, client: TestClient, monkeypatch: pytest.MonkeyPatch, fault: Exception, status: int, detail: str, hint: str
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(service, "make_sessions", failing(fault))
        answer = send(*TWO, visit=1, controller="cdbs")
    body = answer.json()
    assert (answer.status_code, body["status"], body["detail"], body["hint"]) == (status, status, detail, hint)
    assert answer.headers.get("retry-after") == ("5" if status == 503 else None)
    assert client.get("/api/v1/uploads/1").json()["status"] == "received"
    stop = threading.Event()
    keeper = threading.Thread(target=keep_resuming, args=("test", stop, 0.1))
    keeper.start()
    try:
        upload = until(lambda: (u := client.get("/api/v1/uploads/1").json())["status"] == "decoded" and u)
    finally:
        stop.set()
        keeper.join(30)
    assert [f["status"] for f in upload["files"]] == ["decoded", "decoded"]
    assert upload["sessions"][0]["controller"] == "cdbs"


@pytest.mark.parametrize("where", ["the reader", "the sessions"])
def test_a_disk_that_stays_full_is_no_fault_of_the_file(
    send: Send, client: TestClient, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    with monkeypatch.context() as patch:
        if where == "the reader":
            patch.setattr(reading, "DECODE", f"{readers.__name__}:full")
        else:
            patch.setattr(service.making, "make_sessions", failing(NO_ROOM))
        answer = send(("t.csv", steady(1)), visit=1, controller="cdbs")
        assert (answer.status_code, "the bytes of 1 of its 1 file are kept" in answer.json()["detail"]) == (507, True)
        for _ in range(LETHAL + 1):
            assert [t.done for t in resume("test")] == [False]
    assert [t.done for t in resume("test")] == [True]
    upload = client.get("/api/v1/uploads/1").json()
    assert (upload["files"][0]["status"], [s["controller"] for s in upload["sessions"]]) == ("decoded", ["cdbs"])
    assert not client.get("/api/v1/participants/P1/quarantine").json()


def test_a_disk_that_fills_while_identity_is_taken_out_keeps_nothing(
    send: Send, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(reading, "CLEAN", f"{readers.__name__}:full")
        answer = send(("t.csv", steady(1)), visit=1, controller="cdbs")
    assert (answer.status_code, answer.json()["detail"]) == (507, "There is no room left on the disk.")
    assert not client.get("/api/v1/participants/P1/quarantine").json()
    assert send(("t.csv", steady(1)), visit=1, controller="cdbs").status_code == 201


def test_the_page_of_an_upload_that_a_full_disk_cut_short_says_what_is_kept(
    client: TestClient, participant_code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "make_sessions", failing(NO_ROOM))
    answer = client.post(
        f"/participants/{participant_code}/upload",
        data={"visit": "1", "controller": "cdbs"},
        files={"file": ("t.csv", steady(1))},
        headers={"accept": "text/html"},
    )
    assert answer.status_code == 507
    assert "There is no room left on the disk. Upload 1 was cut short: the bytes of 1 of its 1 file are kept." in answer.text


def test_a_database_that_dies_during_an_upload_does_not_hide_what_is_kept(
    client: TestClient, participant_code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(db: Session, *_: Any) -> None:
        mine = "datname = current_database() and pid <> pg_backend_pid()"
        db.execute(text(f"select pg_terminate_backend(pid) from pg_stat_activity where {mine} and usename = current_user"))
        db.execute(text("select pg_terminate_backend(pg_backend_pid())"))

    monkeypatch.setattr(service, "make_sessions", dies)
    stated = {"participant": participant_code, "visit": "1", "controller": "cdbs"}
    answer = client.post("/api/v1/uploads", data=stated, files=[("file", ("t.csv", steady(1)))])
    assert (answer.status_code, answer.headers.get("retry-after")) == (503, "5")
    assert "the bytes of 1 of its 1 file are kept" in answer.json()["detail"]


def test_a_fault_between_two_files_says_how_many_are_kept(send: Send, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Receiver.receive

    def second_fails(self: Receiver, one: Incoming) -> Any:
        if one.name == "b.csv":
            raise NO_ROOM
        return real(self, one)

    monkeypatch.setattr(Receiver, "receive", second_fails)
    answer = send(("a.csv", steady(1)), ("b.csv", steady(1, beta=2.0)), visit=1, controller="cdbs")
    assert (answer.status_code, "the bytes of 1 of its 2 files are kept" in answer.json()["detail"]) == (507, True)
    assert "Send the others again" in answer.json()["hint"]


def test_the_reading_of_a_file_is_told_while_it_lasts(
    service_app: Any, make_token: Any, participant_code: str, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "DECODE", f"{readers.__name__}:hold")
    stated = {"participant": participant_code, "visit": "1", "controller": "cdbs"}

    def send_one() -> None:
        client.post("/api/v1/uploads", data=stated, files=[("file", ("a.csv", steady(1)))])

    sender = threading.Thread(target=send_one)
    sender.start()
    try:
        (row,) = until(lambda: [p for p in client.get("/participants/P1/upload/progress").json() if p["share"]])
        assert (row["share"], row["text"]) == (0.25, "decoding, 25 %")
        assert "decoding, 25 %" in client.get("/participants/P1/upload", headers={"Accept": "text/html"}).text
    finally:
        for folder in get_settings().files_dir.iterdir():
            (folder / "go").touch()
        sender.join(60)
    assert client.get("/participants/P1/upload/progress").json() == []
