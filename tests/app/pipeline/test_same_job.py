"""A request for a job that is sent twice, by a double click or a script that tries again, starts one job."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.accounts.permissions import SYSTEM
from app.cli import app
from app.learning.policies import constant_onnx
from app.learning.snapshots import take_snapshot
from app.pipeline.stages import PLAN, snapshot_facts
from app.platform.database import now
from app.platform.jobs import registry
from app.study.repository import participant_by_code
from app.tables.jobs import Job, JobStatus, JobStep

Upload = Callable[..., int]
JOBS = "/api/v1/participants/P1/jobs"
ASKED = {"kind": "train", "preset": "quick"}
AT_ONCE = 4


def begin(db: Session, job_id: str) -> None:
    """Leave the job as a worker does after its first step: it has read its data."""
    snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    job = db.get_one(Job, job_id)
    job.status = JobStatus.RUNNING
    done = {"status": JobStatus.SUCCEEDED, "finished_at": now(), "result": {"snapshot": snapshot_facts(db, snapshot)}}
    db.add(JobStep(job_id=job_id, key=PLAN, title="Take a buffer snapshot", position=0, **done))
    db.commit()


def test_a_waiting_job_is_given_to_who_asks_for_the_same(client: TestClient, upload: Upload) -> None:
    upload("random")
    first = client.post(JOBS, json=ASKED)
    assert first.status_code == 202
    for same in (ASKED, ASKED | {"seed": 0}, ASKED | {"again": False}):
        answer = client.post(JOBS, json=same)
        assert (answer.status_code, answer.json()) == (200, first.json())
    other = client.post(JOBS, json=ASKED | {"seed": 7})
    another = client.post(JOBS, json=ASKED | {"again": True})
    assert [a.status_code for a in (other, another)] == [202, 202]
    assert len({a.json()["id"] for a in (first, other, another)}) == 3
    assert "again" not in another.json()["params"], "it is no setting of the job"
    assert client.get(JOBS).json()["total"] == 3


def test_a_job_that_is_being_stopped_is_given_to_nobody(client: TestClient, upload: Upload, db: Session) -> None:
    upload("random")
    first = client.post(JOBS, json=ASKED).json()["id"]
    begin(db, first)
    db.get_one(Job, first).cancel_requested_at = now()
    db.commit()
    assert client.post(JOBS, json=ASKED).status_code == 202


def test_a_running_job_is_given_until_the_data_are_others(client: TestClient, upload: Upload, db: Session) -> None:
    session = upload("random")
    first = client.post(JOBS, json=ASKED).json()["id"]
    begin(db, first)
    assert client.post(JOBS, json=ASKED).json()["id"] == first
    assert client.put(f"/api/v1/sessions/{session}/qoc", json={"grasp_hz": 1.5}).status_code == 200
    later = client.post(JOBS, json=ASKED)
    assert later.status_code == 202, "the running one knows nothing of the new outcome"
    begin(db, later.json()["id"])
    assert client.post(JOBS, json=ASKED).json()["id"] == later.json()["id"]


def test_a_running_evaluation_is_given_until_another_policy_is_there(client: TestClient, upload: Upload, db: Session) -> None:
    upload("random")

    def add(name: str) -> None:
        sent = client.post("/api/v1/participants/P1/policies", data={"name": name}, files={"file": ("p.onnx", constant_onnx(0.6, 10))})
        assert sent.status_code == 201

    add("first")
    asked = {"kind": "evaluate", "preset": "quick"}
    job = client.post(JOBS, json=asked).json()["id"]
    begin(db, job)
    assert client.post(JOBS, json=asked).json()["id"] == job
    add("second")
    assert client.post(JOBS, json=asked).status_code == 202


def test_one_job_is_started_by_requests_at_the_same_moment(client: TestClient, upload: Upload, monkeypatch: pytest.MonkeyPatch) -> None:
    upload("random")
    gate, look = Barrier(AT_ONCE, timeout=20), registry.kind

    def together(name: str) -> Any:
        if not gate.broken and len(arrived) < AT_ONCE:
            arrived.append(name)
            gate.wait()
        return look(name)

    arrived: list[str] = []
    monkeypatch.setattr("app.pipeline.service.registry.kind", together)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        answers = list(pool.map(lambda _: client.post(JOBS, json=ASKED), range(AT_ONCE)))
    assert sorted(a.status_code for a in answers) == [200] * (AT_ONCE - 1) + [202], [a.text for a in answers]
    assert len({a.json()["id"] for a in answers}) == 1
    assert client.get(JOBS).json()["total"] == 1


def test_the_page_says_that_no_second_job_was_started_and_starts_one_on_purpose(client: TestClient, upload: Upload) -> None:
    upload("random")

    def send(**more: str) -> Any:
        return client.post("/participants/P1/jobs", data={"kind": "train", "preset": "quick", **more}, follow_redirects=True)

    first, second = send(), send()
    assert first.url.path == second.url.path
    assert "no second one was started" in second.text
    assert "no second one" not in first.text
    another = send(again="true")
    assert another.url.path != first.url.path
    assert "Job started." in another.text
    refused = send(again="true", count="many")
    assert refused.status_code == 422
    assert 'name="again" value="true" checked' in refused.text


def test_the_command_says_that_no_second_job_was_started(client: TestClient, upload: Upload) -> None:
    upload("random")

    def run(*more: str) -> Any:
        done = CliRunner().invoke(app, ["pipeline", "P1", "--preset", "quick", "--no-wait", *more])
        assert done.exit_code == 0, done.output
        return done.stderr

    assert "no second one" not in run()
    assert "no second one was started" in run()
    assert client.get(JOBS).json()["total"] == 1
    assert "no second one" not in run("--again")
    assert client.get(JOBS).json()["total"] == 2
