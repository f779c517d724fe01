"""A withdrawal: nothing is deleted, nothing new is taken, what runs is stopped, and it can be taken back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app import cli
from app.platform.errors import Invalid
from app.tables.audit import AuditEvent

Upload = Callable[..., int]


def withdraw(client: TestClient, status: str = "withdrawn"):  # type: ignore[no-untyped-def]
    return client.patch("/api/v1/participants/P1", json={"status": status, "reason": "wishes to stop"})


def test_a_withdrawal_keeps_the_record_and_takes_nothing_new(client: TestClient, upload: Upload) -> None:
    session = upload("cdbs")
    assert withdraw(client).json()["status"] == "withdrawn"
    assert client.get(f"/api/v1/sessions/{session}").status_code == 200
    assert client.get("/participants/P1/export.zip").status_code == 200
    with pytest.raises(AssertionError, match="has withdrawn from the study"):
        upload("cdbs")
    job = client.post("/api/v1/participants/P1/jobs", json={"kind": "evaluate"})
    plan = client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0}, "reason": "x"})
    assert [job.status_code, plan.status_code] == [409, 409]
    assert client.patch(f"/api/v1/sessions/{session}", json={"excluded_reason": "cable", "reason": "x"}).status_code == 200, "a correction"
    assert "wishes to stop" in client.get("/audit?entity=participant").text


def test_it_is_no_longer_listed_first_and_can_be_taken_back(client: TestClient, upload: Upload) -> None:
    link = 'href="/participants/P1"'
    assert link in client.get("/").text
    withdraw(client)
    assert link not in client.get("/").text
    assert link in client.get("/?withdrawn=yes").text
    assert withdraw(client, "active").status_code == 200
    assert link in client.get("/").text
    upload("cdbs")


def test_its_jobs_are_cancelled(client: TestClient, upload: Upload) -> None:
    for _ in range(3):
        upload("random")
    upload("cdbs")
    client.put("/api/v1/participants/P1/settings", json={"settings": {"xi_beta": 1.0}, "reason": "x"})
    job = client.post("/api/v1/participants/P1/jobs", json={"kind": "train", "preset": "quick", "count": 1, "updates": 40})
    assert job.status_code in (201, 202), job.text
    withdraw(client)
    assert client.get(f"/api/v1/jobs/{job.json()['id']}").json()["status"] == "cancelled"


def test_the_page_asks_for_a_reason(client: TestClient, participant_code: str) -> None:
    assert "Taking part" in client.get("/participants/P1/settings").text
    bare = client.post("/participants/P1/status", data={"status": "withdrawn", "status_reason": ""})
    assert bare.status_code == 422
    done = client.post("/participants/P1/status", data={"status": "completed", "status_reason": "last visit held"}, follow_redirects=False)
    assert done.status_code == 303
    assert client.get("/api/v1/participants/P1").json()["status"] == "completed"


def test_who_only_reads_changes_nothing(client: TestClient, participant_code: str, client_as: Callable[[str], TestClient]) -> None:
    assert withdraw(client_as("viewer")).status_code == 403


def test_the_command_line_does_the_same_with_a_reason(client: TestClient, upload: Upload, db: Session) -> None:
    def run(*words: str) -> Any:
        return CliRunner().invoke(cli.app, ["participant", "status", "P1", *words])

    upload("cdbs")
    assert run("withdrawn").exit_code == 2, "without a reason"
    assert isinstance(run("asleep", "--reason", "x").exception, Invalid)
    done = run("withdrawn", "--reason", "moved away", "--json")
    assert (done.exit_code, done.output) == (0, '{"participant": "P1", "status": "withdrawn"}\n')
    with pytest.raises(AssertionError, match="has withdrawn from the study"):
        upload("cdbs")
    assert run("active", "--reason", "mistaken").exit_code == 0
    told = db.query(AuditEvent).filter(AuditEvent.entity == "participant", AuditEvent.action == "update").order_by(AuditEvent.id)
    assert [(e.actor, e.reason) for e in told] == [("command line", "moved away"), ("command line", "mistaken")]
