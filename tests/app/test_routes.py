"""Every route of the REST interface: who may call it, and that it keeps to its own description."""

from __future__ import annotations

from typing import Any

import pytest
import schemathesis
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, Phase, given, settings

from app.accounts import service as accounts
from app.platform.database import transaction
from app.tables.accounts import Role, Scope, Site, Study
from tests.app.every_route import TABLE, World, routes, token_of
from tests.app.pages.page_calls import browser
from tests.app.route_roles import BROWSER, may_call


def success(app: Any, method: str, path: str) -> int:
    """Return the status that a route's description promises where all is right."""
    return min(int(status) for status in app.openapi()["paths"][path][method]["responses"])


def test_without_a_token_no_route_answers(world: World) -> None:
    bare = world.calling(None)
    answers = {(m, p): world.call(bare, m, p) for m, p in routes(world.app) if p not in {"/healthz", "/readyz"}}
    assert {route: status for route, status in answers.items() if status != 401} == {}


@pytest.mark.parametrize("role", list(Role))
def test_every_route_against_every_role(world: World, role: Role) -> None:
    """Roles with access to a route get what it promises; all others are refused, with rows that exist in both cases."""
    caller = world.admin if role is Role.ADMIN else world.calling(token_of(role))
    assert wrong_answers(world, caller, role, Scope.FULL) == {}


@pytest.mark.parametrize("scope", [Scope.READ, Scope.UPLOAD, Scope.JOBS])
def test_every_route_against_every_scope(world: World, scope: Scope) -> None:
    """A token of an administrator does what its scope names, and nothing else."""
    with transaction("test") as db:
        caller = world.calling(accounts.create_token(db, "admin@clinic.example", scope, scope))
    assert wrong_answers(world, caller, Role.ADMIN, scope) == {}


def test_a_token_for_figures_calls_no_route(world: World) -> None:
    with transaction("test") as db:
        caller = world.calling(accounts.create_token(db, "admin@clinic.example", "figures", Scope.METRICS))
    answers = {(m, p): world.call(caller, m, p) for m, p in routes(world.app) if p not in {"/healthz", "/readyz"}}
    assert {route: status for route, status in answers.items() if status != 403} == {}


@pytest.mark.parametrize("role", list(Role))
def test_what_no_token_may_is_open_to_who_has_signed_in(world: World, role: Role) -> None:
    assert set(routes(world.app)) >= BROWSER
    assert wrong_answers(world, browser(world.app, role), role, None, sorted(BROWSER, reverse=True)) == {}


def wrong_answers(
    world: World, caller: TestClient, role: Role, scope: Scope | None, only: list[tuple[str, str]] | None = None
) -> dict[tuple[str, str], str]:
    """List routes that answer otherwise than the table says, each with its answer and the right one."""
    found = {}
    for method, path in only or routes(world.app):
        right = success(world.app, method, path) if may_call(role, method, path, scope) else 403
        status = world.call(caller, method, path)
        if status != right:
            found[method, path] = f"{status}, not {right}"
    return found


def test_a_caller_of_another_study_sees_nothing(world: World) -> None:
    with transaction("test") as db:
        study = Study(code="other", name="Other study")
        db.add(study)
        db.flush()
        db.add(Site(study_id=study.id, code="other", name="Other site"))
    stranger = world.calling(token_of("admin", "other"))
    assert stranger.get("/api/v1/participants").json()["total"] == 0
    # the key that bundles are verified with and the list of withdrawals, which names no participant, are for every tablet
    own = {
        "/api/v1/participants",
        "/api/v1/studies",
        "/api/v1/analyses",
        "/healthz",
        "/readyz",
        "/api/v1/bundle-key",
        "/api/v1/bundle-withdrawals",
    }
    answers = {(m, p): world.call(stranger, m, p) for m, p in routes(world.app) if p not in own}
    assert {route: status for route, status in answers.items() if status != 404} == {}


ANSWER_S = 120.0
"""Longest time of a call: a machine with much else to do is slow and not at fault, and ten seconds were too few."""

CHECKS = (
    schemathesis.checks.not_a_server_error,
    schemathesis.checks.status_code_conformance,
    schemathesis.checks.content_type_conformance,
    schemathesis.checks.response_schema_conformance,
)


def test_the_interface_keeps_to_its_own_description(service_app: Any, client: TestClient, participant_code: str) -> None:
    """Generated input, good and bad: no server error, and every answer fits the OpenAPI document."""
    fields = {"participant": participant_code, "visit": "1", "controller": "random"}
    assert client.post("/api/v1/uploads", data=fields, files={"file": ("s.csv", TABLE)}).status_code == 201
    schema = schemathesis.openapi.from_asgi("/api/v1/openapi.json", service_app, headers=dict(client.headers))
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
        case.call_and_validate(headers={"Authorization": token}, checks=CHECKS, timeout=ANSWER_S)

    run()
