"""Every route of the REST interface: who may call it, and that it keeps to its own description."""

from __future__ import annotations

from typing import Any

import pytest
import schemathesis
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, Phase, given, settings

METHODS = ("get", "post", "put", "patch", "delete")
WRITERS = {
    # path and method: roles that may, of viewer, clinician, engineer, admin
    ("post", "/api/v1/participants"): {"clinician", "engineer", "admin"},
    ("put", "/api/v1/participants/{code}/settings"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/participants/{code}/visits"): {"clinician", "engineer", "admin"},
    ("patch", "/api/v1/visits/{visit_id}"): {"clinician", "engineer", "admin"},
    ("patch", "/api/v1/sessions/{session_id}"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/sessions/{session_id}/outcomes"): {"clinician", "engineer", "admin"},
    ("put", "/api/v1/sessions/{session_id}/qoc"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/uploads"): {"clinician", "engineer", "admin"},
    ("patch", "/api/v1/proposals/{session_id}"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/proposals/{session_id}/confirm"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/proposals/{session_id}/split"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/proposals/{session_id}/discard"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/uploaded-files/{file_id}/session"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/uploaded-files/{file_id}/review"): {"clinician", "admin"},
    ("post", "/api/v1/uploaded-files/{file_id}/release"): {"clinician", "admin"},
    ("post", "/api/v1/uploaded-files/{file_id}/discard"): {"clinician", "admin"},
    ("post", "/api/v1/participants/{code}/policies"): {"engineer", "admin"},
    ("patch", "/api/v1/policies/{policy_id}"): {"engineer", "admin"},
    ("post", "/api/v1/participants/{code}/snapshots"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/participants/{code}/jobs"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/jobs/{job_id}/cancel"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/jobs/{job_id}/retry"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/visits/{visit_id}/plan"): {"clinician", "engineer", "admin"},
    ("post", "/api/v1/visits/{visit_id}/plan/approve"): {"clinician", "admin"},
    ("post", "/api/v1/participants/{code}/buffer-gate"): {"clinician", "admin"},
}
FORMS: dict[str, dict[str, Any]] = {
    "/api/v1/participants/{code}/buffer-gate": {"json": {"choice": "open", "reason": "agreed in the trial meeting"}},
    "/api/v1/policies/{policy_id}": {"json": {"retired_reason": "worn out"}},
    "/api/v1/participants": {"json": {"code": "Q1"}},
    "/api/v1/participants/{code}/settings": {"json": {"settings": {"gamma": 0.9}}},
    "/api/v1/participants/{code}/visits": {"json": {"number": 77}},
    "/api/v1/visits/{visit_id}": {"json": {"note": "tired", "reason": "forgotten"}},
    "/api/v1/sessions/{session_id}": {"json": {"reason": "none"}},
    "/api/v1/sessions/{session_id}/outcomes": {"json": {"name": "grasp_hz", "value": 2.0}},
    "/api/v1/sessions/{session_id}/qoc": {"json": {"rating": 5}},
    "/api/v1/proposals/{session_id}": {"json": {"version": 1}},
    "/api/v1/proposals/{session_id}/confirm": {"json": {"version": 1}},
    "/api/v1/proposals/{session_id}/split": {"json": {"version": 1, "parts": [{"start_s": 0, "stop_s": 4}]}},
    "/api/v1/proposals/{session_id}/discard": {"json": {"version": 1, "reason": "none"}},
    "/api/v1/uploaded-files/{file_id}/session": {"json": {"session_id": 1}},
    "/api/v1/uploaded-files/{file_id}/release": {"json": {"how": "as_is", "reason": "none"}},
    "/api/v1/uploaded-files/{file_id}/discard": {"json": {"reason": "none"}},
    "/api/v1/participants/{code}/jobs": {"json": {"kind": "pipeline"}},
    "/api/v1/visits/{visit_id}/plan": {"json": {"policy_ids": [1]}},
}
TABLE = b"t_s,beta,amplitude_fraction\n0,1,1\n2,1,1\n4,1,1\n"


def routes(app: Any) -> list[tuple[str, str]]:
    """(method, path) of every route in the OpenAPI document."""
    return [(m, path) for path, entry in app.openapi()["paths"].items() for m in entry if m in METHODS]


def call(client: TestClient, method: str, path: str, ids: dict[str, Any]) -> Any:
    """A well-formed call of a route."""
    extra = dict(FORMS.get(path, {})) if method != "get" else {}
    if path == "/api/v1/uploads":
        extra = {"data": {"participant": "P1", "visit": "1", "controller": "cdbs"}, "files": {"file": ("other.csv", TABLE + b"6,1,1\n")}}
    if path.endswith("/policies") and method == "post":
        extra = {"data": {"name": "x"}, "files": {"file": ("x.onnx", b"no onnx")}}
    return client.request(method, path.format(**ids), **extra)


@pytest.fixture
def ids(client: TestClient, enrolled: str) -> dict[str, Any]:
    """Numbers that exist: a participant, a visit, a session, an upload."""
    fields = {"participant": enrolled, "visit": "1", "controller": "random"}
    upload = client.post("/api/v1/uploads", data=fields, files={"file": ("s.csv", TABLE)}).json()
    session = upload["sessions"][0]
    return {
        "code": enrolled,
        "visit_id": session["visit_id"],
        "session_id": session["id"],
        "upload_id": upload["id"],
        "file_id": upload["files"][0]["id"],
        "policy_id": 1,
        "job_id": "00000000-0000-0000-0000-000000000000",
        "snapshot_id": 1,
        "sweep_id": 1,
        "evaluation_id": 1,
    }


def test_the_contract_has_every_route_others_rely_on(service_app: Any) -> None:
    paths = set(service_app.openapi()["paths"])
    promised = {
        "/participants", "/participants/{code}", "/participants/{code}/visits", "/visits/{visit_id}/sessions", "/sessions/{session_id}",
        "/sessions/{session_id}/trace", "/sessions/{session_id}/qoc", "/uploads", "/participants/{code}/policies", "/policies/{policy_id}",
        "/policies/{policy_id}/bundle", "/participants/{code}/jobs", "/jobs/{job_id}", "/jobs/{job_id}/events",
        "/participants/{code}/ranking", "/participants/{code}/analyses", "/visits/{visit_id}/plan",
    }  # fmt: skip
    assert {f"/api/v1{p}" for p in promised} | {"/healthz"} <= paths


def test_without_a_token_no_route_answers(service_app: Any, client: TestClient, ids: dict[str, Any]) -> None:
    bare = TestClient(service_app)
    answers = {(m, p): call(bare, m, p, ids).status_code for m, p in routes(service_app) if p != "/healthz"}
    assert set(answers.values()) == {401}, answers


@pytest.mark.parametrize("role", ["viewer", "clinician", "engineer"])
def test_every_route_against_every_role(service_app: Any, client: TestClient, client_as: Any, ids: dict[str, Any], role: str) -> None:
    caller = client_as(role)
    unlisted = [r for r in routes(service_app) if r[0] != "get" and r not in WRITERS]
    assert unlisted == [], "say in WRITERS who may call these"
    for method, path in routes(service_app):
        status = call(caller, method, path, ids).status_code
        allowed = role in WRITERS.get((method, path), {"viewer", "clinician", "engineer", "admin"})
        # a role without the right is told so (or that there is no such record); with it, anything but 403
        assert (status in (403, 404)) if not allowed else (status not in (401, 403)), (method, path, status)
        assert status < 500, (method, path)


def test_a_caller_of_another_study_sees_nothing(service_app: Any, client: TestClient, ids: dict[str, Any], fresh_database: str) -> None:
    from app.accounts import service
    from app.accounts.models import Role, Site, Study
    from app.platform.database import transaction

    with transaction("test") as db:
        study = Study(code="other", name="Other study")
        db.add(study)
        db.flush()
        db.add(Site(study_id=study.id, code="other", name="Other site"))
        service.add_user(db, "bob@other.example", Role.ADMIN, "a long password", study_code="other")
        token = service.create_token(db, "bob@other.example", "t")
    stranger = TestClient(service_app, headers={"Authorization": f"Bearer {token}"})
    assert stranger.get("/api/v1/participants").json()["total"] == 0
    own = {"/api/v1/participants", "/healthz", "/api/v1/bundle-key"}  # the key that every bundle is verified with is public
    answers = {(m, p): call(stranger, m, p, ids).status_code for m, p in routes(service_app) if p not in own}
    assert set(answers.values()) <= {404}, {k: v for k, v in answers.items() if v != 404}


CHECKS = (
    schemathesis.checks.not_a_server_error,
    schemathesis.checks.status_code_conformance,
    schemathesis.checks.content_type_conformance,
    schemathesis.checks.response_schema_conformance,
)


def test_the_interface_keeps_to_its_own_description(service_app: Any, client: TestClient, ids: dict[str, Any]) -> None:
    """Generated input, good and bad: no server error, and every answer fits the OpenAPI document."""
    schema = schemathesis.openapi.from_asgi("/api/v1/openapi.json", service_app)
    tried = 0
    # the event stream of a job has no end of its own
    for found in schema.exclude(path_regex="events$").get_all_operations():
        conforms(found.ok(), client.headers["authorization"])
        tried += 1
    assert tried >= 20


def conforms(operation: Any, token: str) -> None:
    """Run a handful of generated cases of one operation."""

    @given(case=operation.as_strategy())
    @settings(
        max_examples=6, deadline=None, derandomize=True, phases=[Phase.generate], suppress_health_check=list(HealthCheck), database=None
    )
    def run(case: Any) -> None:
        case.call_and_validate(headers={"Authorization": token}, checks=CHECKS)

    run()
