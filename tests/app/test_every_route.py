"""Every route is in the table that says who may call it, and every route that others rely on is there."""

from __future__ import annotations

from typing import Any

from tests.app.every_route import METHODS, routes
from tests.app.route_roles import NEEDS


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
