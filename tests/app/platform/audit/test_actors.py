"""Actors in the audit trail: a person for what came in a request of theirs, the worker for what a job stored."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts import service
from app.platform.database import new_session, transaction
from app.platform.jobs.ledger import acting_for
from app.tables.accounts import Role
from tests.app.every_route import World

APP = Path(__file__).resolve().parents[4] / "app"
EMAIL, PASSWORD = "ada@clinic.example", "correct horse battery"
OF_A_REQUEST = {"caller.label", "self.caller.label", "user.email"}
"""Persons who have shown who they are: they signed in before, or just now."""
NO_PERSON = {"ACTOR", "_ACTOR", "ENGINEER", "actor", "actor['label']", "acting_for(self.created_by)"}


def named_actors() -> Iterator[tuple[str, str]]:
    """Yield where the service names an actor, and by what expression."""
    for path in sorted(APP.rglob("*.py")):
        for call in ast.walk(ast.parse(path.read_text())):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in ("set_actor", "transaction"):
                given = call.args[1:2] if call.func.id == "set_actor" else call.args[:1]
                yield from (
                    (f"{path.relative_to(APP)}:{call.lineno}", ast.unparse(one)) for one in given if not isinstance(one, ast.Constant)
                )


def test_no_place_names_as_actor_a_person_who_only_asked_or_was_typed() -> None:
    found = list(named_actors())
    assert len(found) > 20
    assert {(where, what) for where, what in found if what not in OF_A_REQUEST | NO_PERSON} == set()


def test_jobs_write_as_the_worker_for_whom_asked(world: World) -> None:
    with new_session() as db:
        rows = db.execute(text("select e.actor, e.entity, e.action from audit_event e join job j on j.id = e.request_id")).all()
        asked = db.scalars(text("select distinct actor from audit_event where entity = 'job' and action = 'insert'")).all()
    assert {actor for actor, _, _ in rows} == {acting_for("admin@clinic.example")}
    assert {entity for _, entity, _ in rows} >= {"job", "policy", "evaluation"}
    assert set(asked) == {"admin@clinic.example"}


def test_an_address_that_somebody_types_has_done_nothing(service_app, db: Session) -> None:  # type: ignore[no-untyped-def]
    with transaction("test") as other:
        service.add_user(other, EMAIL, Role.CLINICIAN, PASSWORD)
    client = TestClient(service_app, headers={"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}, follow_redirects=False)
    assert client.post("/sign-in", data={"email": EMAIL, "password": "a wrong guess"}).status_code == 401
    assert client.post("/sign-in", data={"email": EMAIL, "password": PASSWORD}).status_code == 303
    rows = db.execute(text("select action, actor from audit_event where entity = 'sign_in' order by id")).all()
    assert Counter(map(tuple, rows)) == {("refuse", "unknown"): 1, ("insert", EMAIL): 1}


@pytest.mark.parametrize("address", ["ada@clinic.example", "a" * 240 + "@clinic.example"])
def test_a_workers_name_fits_the_trail(address: str) -> None:
    assert acting_for(address).startswith("worker for a")
    assert len(acting_for(address)) <= 254
