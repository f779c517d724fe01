"""Every route is in the table that says who may call it, and every route that others rely on is there. Workers of a run share a study."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import make_url

from app.platform.database import database_url
from app.platform.embedded.server import EmbeddedPostgres
from tests.app.every_route import METHODS, TABLE, routes
from tests.app.route_roles import NEEDS
from tests.between_workers import give, one_at_a_time, take
from tests.conftest import own_database


def test_the_contract_has_every_route_others_rely_on(service_app: Any) -> None:
    paths = set(service_app.openapi()["paths"])
    promised = {
        "/participants", "/participants/{code}", "/participants/{code}/visits", "/visits/{visit_id}/sessions", "/sessions/{session_id}",
        "/sessions/{session_id}/trace", "/sessions/{session_id}/qoc", "/uploads", "/participants/{code}/policies", "/policies/{policy_id}",
        "/policies/{policy_id}/bundle", "/participants/{code}/jobs", "/jobs/{job_id}", "/jobs/{job_id}/events",
        "/participants/{code}/ranking", "/participants/{code}/analyses", "/visits/{visit_id}/plan",
    }  # fmt: skip
    assert {f"/api/v1{p}" for p in promised} | {"/healthz", "/readyz"} <= paths


def test_the_table_of_roles_has_every_route_and_no_other(service_app: Any) -> None:
    described = {(m, path) for path, entry in service_app.openapi()["paths"].items() for m in entry if m in METHODS}
    assert described == set(routes(service_app))
    assert set(NEEDS) == described, "say in NEEDS which permission each route needs"


def test_what_one_worker_made_comes_to_the_database_of_another_as_it_is(
    participant_code: str, client: TestClient, server: EmbeddedPostgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = ("/api/v1/participants", "/api/v1/participants/P1/visits", "/api/v1/uploads/1")
    sent = {"file": ("s.csv", TABLE)}
    assert client.post("/api/v1/uploads", data={"participant": "P1", "visit": 1}, files=sent).status_code == 201
    answers = [client.get(path).json() for path in asked]
    folder = tmp_path / "given"
    with one_at_a_time(folder):
        give(server, str(make_url(database_url()).database), tmp_path / "data", "what is known", folder)
    with own_database(server, tmp_path / "other", monkeypatch, "betaloop") as url:
        assert take(server, str(make_url(url).database), tmp_path / "nowhere", tmp_path) is None, "nothing was given there"
        assert take(server, str(make_url(url).database), tmp_path / "other", folder) == "what is known"
        assert [client.get(path).json() for path in asked] == answers
        again = client.post("/api/v1/uploads", data={"participant": "P1", "visit": 1}, files=sent).json()
        assert again["duplicate"]
        assert again["id"] > 1, "sequences go on"
