"""The end of studies and sites: in pages, interface and commands, with its reason in the audit trail; and opening them again."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app import cli
from app.accounts.permissions import SYSTEM
from app.pipeline.service import start_job
from app.platform.errors import Conflict
from app.study import repository as study
from app.tables.audit import AuditEvent
from app.tables.jobs import Job, JobStatus
from tests.app.conftest import table
from tests.conftest import PASSWORD

WHY = {"reason": "last visit held"}
STUDY, SITE = "/api/v1/studies/main", "/api/v1/studies/main/sites/main"
Clients = Callable[[str], TestClient]


def send_file(client: TestClient, rng: Any) -> int:
    content = table(rng.uniform(0.3, 1.0, 30), rng).encode()
    fields = {"participant": "P1", "visit": "1", "controller": "random"}
    return client.post("/api/v1/uploads", data=fields, files={"file": ("s.csv", content)}).status_code


def test_a_study_that_has_ended_is_read_and_nothing_in_it_changes(
    client: TestClient, participant_code: str, client_as: Clients, db: Session, rng: Any
) -> None:
    clinician = client_as("clinician")
    visit = client.get(f"/api/v1/participants/{participant_code}/visits").json()["items"][0]["id"]
    ended = client.post(f"{STUDY}/end", json=WHY)
    assert (ended.status_code, ended.json()["ended_at"] is not None) == (200, True), ended.text
    assert client.post(f"{STUDY}/end", json=WHY).status_code == 409
    for who in (client, clinician):
        changes = [
            who.post("/api/v1/participants", json={"code": "P2"}),
            who.patch(f"/api/v1/visits/{visit}", json={"note": "late", "reason": "x"}),
            who.put("/api/v1/participants/P1/settings", json={"settings": {"gamma": 0.9}, "reason": "x"}),
            who.patch("/api/v1/participants/P1", json={"status": "completed", "reason": "x"}),
            who.post("/api/v1/participants/P1/jobs", json={"kind": "pipeline"}),
            who.post(f"/api/v1/visits/{visit}/lock", json={"reason": "x", "password": PASSWORD}),
        ]
        assert [c.status_code for c in changes] == [403] * len(changes)
        assert "The study has ended" in changes[0].text
        assert send_file(who, rng) == 403
        reads = ["/api/v1/participants", "/api/v1/participants/P1", f"/api/v1/visits/{visit}", "/participants/P1", "/audit"]
        assert [who.get(path).status_code for path in (*reads, "/participants/P1/export.zip")] == [200] * 6
    assert client.post(f"{STUDY}/reopen", json={"reason": "one more visit"}).json()["ended_at"] is None
    assert client.patch(f"/api/v1/visits/{visit}", json={"note": "late", "reason": "x"}).status_code == 200
    events = db.query(AuditEvent).filter(AuditEvent.entity == "study", AuditEvent.action == "update").order_by(AuditEvent.id)
    assert [(e.actor, e.reason) for e in events] == [("admin@clinic.example", why) for why in ("last visit held", "one more visit")]
    trail = client.get("/audit?entity=study").text
    assert "ended the study main" in trail
    assert "opened again the study main" in trail


def test_today_leaves_an_ended_study_out_until_it_is_asked_for(client: TestClient, participant_code: str) -> None:
    link = f'href="/participants/{participant_code}"'
    assert link in client.get("/").text
    assert client.post(f"{STUDY}/end", json=WHY).status_code == 200
    # also where no participant is left to show, the page says where they are
    alone = " ".join(client.get("/").text.split())
    assert link not in alone
    assert "No participant is enrolled that you may see" in alone
    assert '<a href="/?withdrawn=yes">Include withdrawn participants and closed studies' in alone
    assert link in client.get("/?withdrawn=yes").text
    assert "the study has ended" in client.get(f"/participants/{participant_code}").text


def test_jobs_of_an_ended_study_are_cancelled(client: TestClient, participant_code: str, rng: Any, db: Session) -> None:
    assert send_file(client, rng) == 201
    started = client.post(f"/api/v1/participants/{participant_code}/jobs", json={"kind": "pipeline", "preset": "quick"})
    assert started.status_code in (201, 202), started.text
    assert client.post(f"{STUDY}/end", json=WHY).status_code == 200
    assert db.get_one(Job, started.json()["id"]).status == JobStatus.CANCELLED


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [("post", f"{STUDY}/end", WHY), ("patch", "/api/v1/participants/P1", {"status": "withdrawn", "reason": "moved away"})],
)
def test_a_job_of_a_request_that_was_judged_before_the_end_is_refused(
    client: TestClient, participant_code: str, rng: Any, db: Session, method: str, path: str, body: dict[str, str]
) -> None:
    assert send_file(client, rng) == 201
    judged = study.participant_by_code(db, participant_code, SYSTEM)
    assert judged.site.study.ended_at is None
    assert client.request(method, path, json=body).status_code == 200
    with pytest.raises(Conflict, match=r"has (ended|withdrawn)"):
        start_job(db, judged, "pipeline", {"preset": "quick"}, SYSTEM)
    db.rollback()
    assert db.query(Job).count() == 0


def test_who_ends_a_study_waits_for_a_job_that_is_asked_for_and_cancels_it(
    client: TestClient, participant_code: str, rng: Any, db: Session
) -> None:
    assert send_file(client, rng) == 201
    job = start_job(db, study.participant_by_code(db, participant_code, SYSTEM), "pipeline", {"preset": "quick"}, SYSTEM).job
    with ThreadPoolExecutor(1) as other:
        ending = other.submit(client.post, f"{STUDY}/end", json=WHY)
        with pytest.raises(TimeoutError):
            ending.result(timeout=1)
        db.commit()
        assert ending.result(timeout=20).status_code == 200
    db.refresh(job)
    assert job.status == JobStatus.CANCELLED


def test_an_ended_site_takes_neither_enrolments_nor_uploads_and_all_else_goes_on(
    client: TestClient, participant_code: str, db: Session, rng: Any
) -> None:
    assert client.post(f"{STUDY}/sites", json={"code": "south", "name": "South"}).status_code == 201
    assert client.post(f"{SITE}/end", json=WHY).json()["ended_at"] is not None
    refused = client.post("/api/v1/participants", json={"code": "P2", "site": "main"})
    assert (refused.status_code, "has ended" in refused.text) == (409, True)
    assert send_file(client, rng) == 409
    assert client.patch("/api/v1/participants/P1", json={"status": "completed", "reason": "x"}).status_code == 200
    assert client.post("/api/v1/participants", json={"code": "P2"}).json()["site"] == "south", "the one site that is open"
    assert client.post(f"{SITE}/reopen", json={"reason": "a late visit"}).json()["ended_at"] is None
    assert send_file(client, rng) == 201
    events = db.query(AuditEvent).filter(AuditEvent.entity == "site", AuditEvent.action == "update").order_by(AuditEvent.id)
    assert [e.reason for e in events] == ["last visit held", "a late visit"]


@pytest.mark.parametrize("role", ["viewer", "monitor", "coordinator", "clinician", "engineer"])
def test_nobody_but_an_administrator_ends_anything(client: TestClient, client_as: Clients, role: str) -> None:
    person = client_as(role)
    answers = [person.post(f"{place}/{what}", json=WHY).status_code for place in (STUDY, SITE) for what in ("end", "reopen")]
    assert answers == [403] * 4
    assert client.get("/api/v1/studies").json()[0]["ended_at"] is None


def test_the_page_renames_ends_and_opens_again_with_a_reason(client: TestClient, db: Session) -> None:
    admin = TestClient(client.app, base_url="http://testserver", follow_redirects=False)
    assert admin.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 303
    study, site = "/studies/main", "/studies/main/sites/main"
    assert admin.post(f"{study}/end", data={"reason": " "}).status_code == 422
    assert admin.post(study, data={"name": "", "reason": "x"}).status_code == 422
    sent = [
        (study, {"name": "Adaptive DBS", "reason": "protocol 2"}, "changed"),
        (site, {"name": "Main clinic", "reason": "moved"}, "changed"),
        (f"{site}/end", WHY, "site-ended"),
        (f"{site}/reopen", WHY, "reopened"),
        (f"{study}/end", WHY, "study-ended"),
    ]
    for path, data, done in sent:
        assert admin.post(path, data=data).headers["location"] == f"/studies?done={done}"
    page = admin.get("/studies").text
    assert all(words in page for words in ("Adaptive DBS", "Main clinic", "Open the study again", "nothing in it changes"))
    assert admin.post(f"{study}/reopen", data=WHY).status_code == 303
    assert "Open the study again" not in admin.get("/studies").text
    reasons = [e.reason for e in db.query(AuditEvent).filter(AuditEvent.entity.in_(("study", "site")), AuditEvent.action == "update")]
    assert sorted(reasons) == sorted(["protocol 2", "moved", *["last visit held"] * 4])


def test_the_command_line_renames_ends_and_opens_again(client: TestClient, participant_code: str) -> None:
    def run(*words: str) -> Any:
        return CliRunner().invoke(cli.app, ["study", *words])

    assert run("rename", "main", "--name", "Main study", "--reason", "protocol 2").output == "Study main is called Main study now.\n"
    assert run("rename", "main", "--site", "main", "--name", "Clinic", "--reason", "moved").exit_code == 0
    assert run("end", "main", "--site", "main", "--reason", "closed").output == "Site main of study main has ended.\n"
    assert run("reopen", "main", "--site", "main", "--reason", "late visit").exit_code == 0
    assert run("end", "main", "--reason", " ").exit_code == 2, "without a reason"
    assert run("end", "main", "--reason", "done").output == "Study main has ended.\n"
    status = CliRunner().invoke(cli.app, ["participant", "status", participant_code, "completed", "--reason", "x"])
    assert isinstance(status.exception, Conflict), "the command line is held to it too"
    (study,) = client.get("/api/v1/studies").json()
    assert (study["name"], study["sites"][0]["name"], study["ended_at"] is None) == ("Main study", "Clinic", False)
    assert run("reopen", "main", "--reason", "one more visit").exit_code == 0
