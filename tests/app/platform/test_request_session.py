"""The session of a request: it commits once, when the endpoint has returned and before the answer leaves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.responses import RedirectResponse, Response, StreamingResponse
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.orm import Session
from starlette.background import BackgroundTask

from app import main
from app.platform.audit import record
from app.platform.database import Db, get_engine, new_session, set_actor
from app.platform.errors import Conflict
from app.tables.accounts import Study
from app.tables.audit import AuditEvent

FAILS_AT_THE_COMMIT = "create temp table seen_once (number int unique deferrable initially deferred) on commit drop"


@pytest.fixture
def service(fresh_database: str) -> FastAPI:
    return main.create_app()


def browser(service: FastAPI) -> TestClient:
    return TestClient(service, raise_server_exceptions=False, follow_redirects=False)


def add_study(db: Session, code: str = "S2") -> None:
    set_actor(db, "test")
    db.add(Study(code=code, name="Second"))


def studies() -> list[str]:
    """Read the codes of studies as another connection sees them."""
    with new_session() as other:
        return list(other.scalars(select(Study.code).where(Study.code == "S2")))


def test_what_an_endpoint_changes_is_there_before_its_answer_leaves(service: FastAPI) -> None:
    def pieces() -> Iterator[str]:
        yield ",".join(studies())

    @service.post("/change")
    def change(db: Db) -> Response:
        add_study(db)
        return StreamingResponse(pieces())

    @service.post("/redirect")
    def redirect(db: Db) -> Response:
        record(db, "export", "results", "redirect")
        return RedirectResponse("/there", 303, background=BackgroundTask(seen.extend, studies()))

    seen: list[str] = []
    assert browser(service).post("/change").text == "S2"
    assert browser(service).post("/redirect").status_code == 303
    assert seen == ["S2"]
    with new_session() as other:
        assert other.scalar(select(AuditEvent.entity_id).where(AuditEvent.action == "export")) == "redirect"
    assert get_engine().pool.checkedout() == 0  # type: ignore[attr-defined]


def test_a_commit_that_fails_gives_an_error_and_changes_nothing(service: FastAPI) -> None:
    @service.post("/change")
    def change(db: Db) -> dict[str, Any]:
        add_study(db)
        db.execute(text(FAILS_AT_THE_COMMIT))
        db.execute(text("insert into seen_once values (1), (1)"))
        return {"answer": "as planned"}

    answer = browser(service).post("/change")
    assert answer.status_code == 409
    assert "as planned" not in answer.text
    assert studies() == []
    assert get_engine().pool.checkedout() == 0  # type: ignore[attr-defined]


@pytest.mark.parametrize("error", [Conflict("No.", "Stop."), ZeroDivisionError()])
def test_an_error_takes_back_what_the_endpoint_changed(service: FastAPI, error: Exception) -> None:
    @service.post("/change")
    def change(db: Db) -> None:
        add_study(db)
        db.flush()
        raise error

    assert browser(service).post("/change").status_code == (409 if isinstance(error, Conflict) else 500)
    assert studies() == []


@pytest.mark.parametrize("statement", ["add", "insert", "text", "savepoint", "connection"])
def test_a_change_is_noticed_however_it_is_made(service: FastAPI, statement: str) -> None:
    @service.post("/change")
    def change(db: Db) -> None:
        set_actor(db, "test")
        if statement == "add":
            add_study(db)
        elif statement == "insert":
            db.execute(Study.__table__.insert().values(code="S2", name="Second"))  # type: ignore[attr-defined]
        elif statement == "connection":
            db.connection().execute(text("insert into study (code, name) values ('S2', 'Second')"))
        elif statement == "savepoint":
            with db.begin_nested():
                add_study(db)
        else:
            db.execute(text("insert into study (code, name) values ('S2', 'Second')"))

    assert browser(service).post("/change").status_code == 200
    assert studies() == ["S2"]


def test_a_newer_schema_is_served_where_it_can_be_and_refused_in_words_where_not(
    client: TestClient, participant_code: str, owner_db: Session
) -> None:
    owner_db.execute(text("alter table visit add column room text not null default ''"))
    owner_db.execute(text("alter table visit alter column room drop default"))
    owner_db.execute(text("update alembic_version set version_num = 'newer'"))
    owner_db.commit()
    assert client.get(f"/participants/{participant_code}").status_code == 200
    answer = client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 7})
    assert answer.status_code == 503
    assert "has schema newer, and this version needs first_" in answer.json()["detail"]
    assert int(answer.headers["Retry-After"]) > 0
    owner_db.rollback()
    assert owner_db.scalar(text("select count(*) from visit where number = 7")) == 0
