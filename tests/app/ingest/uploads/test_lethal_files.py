"""A file that ends the process which reads it is tried twice and then put aside; numbers in a file ask for no memory without a limit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.ingest.models import Upload, UploadFile
from app.ingest.uploads.interrupted import resume
from app.platform.errors import Invalid
from app.study import repository as study
from app.study.models import Recording, SettingsVersion, StudySession
from app.study.traces import MOST_STEPS, step_table
from tests.app.ingest.conftest import Send, steady, table

ROOT = Path(__file__).resolve().parents[4]
LETHAL = """
import io, os, signal, sys
from app.accounts.permissions import SYSTEM
from app.ingest.uploads import service
from ml import formats
from app.ingest.uploads.interrupted import resume
from app.ingest.sessions import StatedSession
from app.platform.database import new_session
from app.platform.tables import load_tables
from app.study.repository import participant_by_code

load_tables()
setattr({"decode": formats, "make_sessions": service}[sys.argv[2]], sys.argv[2], lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL))
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


def test_a_file_that_ends_the_service_twice_is_put_aside_and_can_be_read(client: TestClient, enrolled: str, db: Session) -> None:
    killed("send", "decode")
    killed("take up", "decode")
    (taken,) = resume("test")
    assert taken.done, taken.said
    (file,) = db.scalars(select(UploadFile))
    assert (file.status, file.quarantine_sha256 is not None) == ("failed", True)
    (row,) = client.get("/api/v1/participants/P1/quarantine").json()
    assert "the service ended 2 times while it read this file" in row["problem"]
    assert list(resume("test")) == [], "it is not taken up again"
    assert client.post(f"/api/v1/uploaded-files/{file.id}/review").status_code == 200
    released = client.post(f"/api/v1/uploaded-files/{file.id}/release", json={"how": "read", "reason": "the service was mended"})
    assert released.status_code == 200, released.text
    assert (released.json()["status"], released.json()["held"]) == ("decoded", False)
    assert len(client.get("/api/v1/participants/P1/proposals").json()) == 1


def test_a_file_whose_reading_ended_the_service_once_is_taken_up(client: TestClient, enrolled: str) -> None:
    killed("send", "decode")
    assert [t.done for t in resume("test")] == [True]
    assert len(client.get("/api/v1/participants/P1/proposals").json()) == 1


def test_sessions_that_end_the_service_twice_are_not_made_a_third_time(client: TestClient, enrolled: str, db: Session) -> None:
    killed("send", "make_sessions")
    killed("take up", "make_sessions")
    assert [t.done for t in resume("test")] == [True]
    (upload,) = db.scalars(select(Upload))
    assert upload.status == "decoded"
    assert "The service ended 2 times while it made sessions" in repr(client.get(f"/api/v1/uploads/{upload.id}").json()["report"])
    assert client.get("/api/v1/participants/P1/proposals").json() == []
    assert list(resume("test")) == []


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
