"""A file that ends the process reading it is tried twice and then put aside. Numbers in a file cannot request memory without a limit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.ingest.uploads import reading
from app.ingest.uploads.interrupted import resume
from app.platform.errors import Invalid
from app.platform.jobs.children import limited
from app.settings import get_settings
from app.study import repository as study
from app.study.traces import MOST_STEPS, step_table
from app.tables.participants import SettingsVersion
from app.tables.recordings import Recording
from app.tables.sessions import StudySession
from app.tables.uploads import Upload, UploadFile
from ml import formats
from ml.formats import archive
from tests.app.ingest.conftest import Send, device_zip, steady, table
from tests.app.ingest.uploads import readers

ROOT = Path(__file__).resolve().parents[4]
LETHAL = """
import io, os, signal, sys
from app.accounts.permissions import SYSTEM
from app.ingest.uploads import service
from app.ingest.uploads import reading
from app.ingest.uploads.interrupted import resume
from app.ingest.sessions import StatedSession
from app.platform.database import new_session
from app.study.repository import participant_by_code

if sys.argv[2] == "slowly":
    reading.DECODE = "tests.app.ingest.uploads.readers:sleep"
else:
    where = {"decode": reading, "make_sessions": service}[sys.argv[2]]
    setattr(where, sys.argv[2], lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL))
if sys.argv[1] == "send":
    with new_session() as db:
        one = service.Incoming("t.csv", io.BytesIO(sys.argv[3].encode()))
        service.receive(db, participant_by_code(db, "P1", SYSTEM), StatedSession(), [one], SYSTEM)
else:
    list(resume("test"))
"""


def killed(action: str, where: str) -> None:
    done = subprocess.run([sys.executable, "-c", LETHAL, action, where, steady(1).decode()], cwd=ROOT, capture_output=True)
    assert done.returncode == -9, done.stderr.decode()[-2000:]


def test_a_file_that_ends_the_service_twice_is_put_aside_and_can_be_read(client: TestClient, participant_code: str, db: Session) -> None:
    killed("send", "decode")
    killed("resume", "decode")
    (taken,) = resume("test")
    assert taken.done, taken.message
    (file,) = db.scalars(select(UploadFile))
    assert (file.status, file.quarantine_sha256 is not None) == ("failed", True)
    (row,) = client.get("/api/v1/participants/P1/quarantine").json()
    assert "reading this file was cut short 2 times" in row["problem"]
    assert list(resume("test")) == [], "it is not resumed again"
    assert client.post(f"/api/v1/uploaded-files/{file.id}/review").status_code == 200
    released = client.post(f"/api/v1/uploaded-files/{file.id}/release", json={"how": "read", "reason": "the service was repaired"})
    assert released.status_code == 200, released.text
    assert (released.json()["status"], released.json()["held"]) == ("decoded", False)
    assert len(client.get("/api/v1/participants/P1/proposals").json()) == 1


def test_a_file_whose_reading_ended_the_service_once_is_resumed(client: TestClient, participant_code: str) -> None:
    killed("send", "decode")
    assert [t.done for t in resume("test")] == [True]
    assert len(client.get("/api/v1/participants/P1/proposals").json()) == 1


@pytest.mark.slow
def test_sessions_that_end_the_service_twice_are_not_made_a_third_time(client: TestClient, participant_code: str, db: Session) -> None:
    killed("send", "make_sessions")
    killed("resume", "make_sessions")
    assert [t.done for t in resume("test")] == [True]
    (upload,) = db.scalars(select(Upload))
    assert upload.status == "decoded"
    assert "The service ended 2 times while it made sessions" in repr(client.get(f"/api/v1/uploads/{upload.id}").json()["report"])
    assert client.get("/api/v1/participants/P1/proposals").json() == []
    assert list(resume("test")) == []


@pytest.mark.parametrize(
    ("reader", "said"),
    [
        ("kill", "the process that read it was ended"),
        ("outgrow", "reading it takes more memory than the 2048 MiB that one file may have"),
        ("spin", "reading it takes longer than the 1 s of processor time that one file may have"),
    ],
)
@pytest.mark.parametrize("step", ["CLEAN", "DECODE"])
def test_a_file_that_ends_its_reader_twice_is_put_aside_with_the_reason_and_the_service_lives(
    send: Send, client: TestClient, db: Session, monkeypatch: pytest.MonkeyPatch, step: str, reader: str, said: str
) -> None:
    monkeypatch.setattr(get_settings(), "decode_seconds", 1)
    good, real = ("good.csv", steady(1, beta=2.0)), getattr(reading, step)
    with monkeypatch.context() as patch:
        patch.setattr(reading, step, f"{readers.__name__}:{reader}")
        lethal = send(("t.csv", steady(1)), visit=1, controller="cdbs")
    assert lethal.status_code == 422, lethal.text
    problem = lethal.json()["report"][0]["problem"]
    assert (problem["what"], "BETALOOP_DECODE_MEMORY_MB" in problem["hint"]) == (said, True)
    assert send(good, visit=1, controller="cdbs").status_code == 201, "the service takes the next file"
    assert list(resume("test")) == [], "it is not tried again at the next start"
    (row,) = client.get("/api/v1/participants/P1/quarantine").json()
    assert (row["status"], row["held"]) == ("failed", True)
    assert said in row["problem"]
    released = client.post(f"/api/v1/uploaded-files/{row['id']}/release", json={"how": "read", "reason": "more memory"})
    assert (released.status_code, getattr(reading, step)) == (200, real), released.text
    assert (released.json()["status"], released.json()["held"]) == ("decoded", False)


def test_a_file_whose_reader_was_ended_once_is_read_again_at_once(send: Send, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "DECODE", f"{readers.__name__}:kill_once")
    answer = send(("t.csv", steady(1)), visit=1, controller="cdbs")
    assert answer.status_code == 201, answer.text
    assert answer.json()["files"][0]["status"] == "decoded"
    assert client.get("/api/v1/participants/P1/quarantine").json() == []


def test_when_the_process_that_forks_readers_is_killed_the_next_file_starts_another(send: Send) -> None:
    assert send(("a.csv", steady(1)), visit=1, controller="cdbs").status_code == 201
    first = limited.server_pid()
    assert first is not None
    os.kill(first, signal.SIGKILL)
    assert send(("b.csv", steady(1, beta=2.0)), visit=1, controller="cdbs").status_code == 201
    assert limited.server_pid() != first


@pytest.mark.slow
def test_readers_die_with_the_service(participant_code: str) -> None:
    with subprocess.Popen([sys.executable, "-c", LETHAL, "send", "slowly", steady(1).decode()], cwd=ROOT) as service:
        try:
            mine = _descendants(service.pid, 2)
        finally:
            service.kill()
    gone, alive = psutil.wait_procs(mine, timeout=10)
    assert (len(gone), alive) == (2, [])


def _descendants(pid: int, count: int) -> list[psutil.Process]:
    """Return the process that forks readers, and a reader, once both are there."""
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        found = psutil.Process(pid).children(recursive=True)
        if len(found) >= count:
            return found
        time.sleep(0.1)
    raise AssertionError("no reader was started")


def test_the_web_process_never_reads_a_file_itself(send: Send, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> Any:
        raise AssertionError("read in the web process")

    for name in ("sniff", "redact", "decode"):
        monkeypatch.setattr(formats, name, never)
    monkeypatch.setattr(archive, "ZipFiles", never)
    noise, grasps = b"PK\x03\x04 no archive", b"t_s,hand\n1,L\n1.5,L\n2,L\n"
    answer = send(("s.zip", device_zip()), ("t.csv", steady(1)), ("g.csv", grasps), ("n.zip", noise), visit=1, controller="cdbs")
    assert answer.status_code == 201, answer.text
    assert [f["status"] for f in answer.json()["files"]] == ["decoded", "decoded", "decoded", "failed"]


@pytest.mark.parametrize(
    ("factor", "unit"), [(1, "seconds"), (1000, "milliseconds"), (10**6, "microseconds"), (10**9, "nanoseconds")]
)  # fmt: skip
def test_unix_times_are_refused_with_what_to_do(send: Send, factor: int, unit: str) -> None:
    start = 1_772_445_600  # 2026-03-02 10:00 UTC
    answer = send(("t.csv", table([(factor * (start + 2 * k), 1.0, 1.0) for k in range(30)])), visit=1, controller="cdbs")
    assert answer.status_code == 422, answer.text
    problem = answer.json()["report"][0]["problem"] if "report" in answer.json() else answer.json()
    assert f"the times are Unix {unit}" in repr(problem)
    assert "2026-03-02 10:00:00 UTC" in repr(problem)
    assert "Give t_s in seconds from the session's start" in repr(problem)


@pytest.mark.parametrize("first", [-1e6, 1e6, 2e11, 1e300])
def test_times_far_from_the_start_are_refused(send: Send, first: float) -> None:
    rows: list[Any] = sorted([(first, 1.0, 1.0), (2.0, 1.0, 1.0)])
    answer = send(("t.csv", table(rows)), visit=1, controller="cdbs")
    assert answer.status_code == 422, answer.text
    assert "a week from the session's start" in answer.text


def test_a_stored_session_of_fifty_years_allocates_nothing_and_its_pages_open(client: TestClient, send: Send, db: Session) -> None:
    session_id = send(("t.csv", steady(1)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    session = db.get_one(StudySession, session_id)
    session.duration_s = 1.7e9
    for recording in db.scalars(select(Recording)):
        recording.duration_s = 1.7e9
    db.commit()
    settings = db.scalars(select(SettingsVersion)).one()
    with pytest.raises(Invalid, match=f"850000000 steps of 2 s, where {MOST_STEPS} are the most"):
        step_table(db, study.session(db, session_id, SYSTEM), settings)
    pages = (f"/sessions/{session_id}", "/participants/P1", "/participants/P1/analyses", f"/visits/{session.visit_id}", "/", "/trial-time")
    for page in (*pages, "/participants/P1/settings", "/participants/P1/jobs", "/participants/P1/proposals", "/participants/P1/ranking"):
        assert client.get(page, headers={"Accept": "text/html"}).status_code == 200, page
