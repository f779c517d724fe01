"""Reach of a stolen database password of the service: read and write rows, and nothing to the audit trail or the tables themselves."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient
from psycopg.errors import InsufficientPrivilege
from sqlalchemy import text
from sqlalchemy.exc import ProgrammingError
from sqlalchemy.orm import Session

from app.platform import service_role
from app.platform.audit import AUDITED
from app.platform.audit.chain import verify
from app.platform.database import new_session, owner_url
from app.platform.upkeep.doctor import examine
from app.platform.upkeep.migrate import migrate
from app.settings import get_settings

FORGED = "insert into audit_event (actor, action, entity, entity_id) values ('ada@clinic.example', 'update', 'qoc', '1')"


REFUSED = (
    "alter table qoc disable trigger audit",
    "alter table audit_event disable trigger all",
    "alter table audit_event owner to betaloop_service",
    "drop trigger audit on qoc",
    "drop table qoc",
    "drop table audit_event",
    "drop function audit_row() cascade",
    "create or replace function audit_row() returns trigger language plpgsql as 'begin return null; end'",
    "update audit_event set actor = 'nobody'",
    "delete from audit_event",
    "truncate audit_event",
    FORGED,
    "select audit_note('update', 'qoc', '1', null)",
    "update audit_link set digest = sha256('x')",
    "delete from audit_link",
    "insert into audit_link values (1000000, 1000000, sha256('x'))",
    "update audit_seal set position = position + 1",
    "delete from audit_seal",
    "truncate audit_seal",
    "delete from qoc",
    "delete from participant",
    "delete from dose",
    "delete from cdbs_amplitude",
    "delete from tremor_series",
    "delete from grasp_test",
    "delete from recording",
    "delete from signature",
    "delete from day_entry",
    "truncate session cascade",
    "delete from alembic_version",
    "set role betaloop",
    "set role postgres",
    "set session authorization betaloop",
    "set session_replication_role = replica",
    "create table mine (n int)",
    "create schema mine",
    "create role mine superuser",
    "alter role betaloop_service superuser",
)


def test_the_services_role_is_refused(fresh_database: str) -> None:
    with new_session() as db:
        for statement in REFUSED:
            with pytest.raises(ProgrammingError) as refused:
                db.execute(text(statement))
            assert isinstance(refused.value.orig, InsufficientPrivilege), statement
            db.rollback()
        db.execute(text("grant all on audit_event to betaloop_service"))  # a warning to PostgreSQL, and nothing given
        with pytest.raises(ProgrammingError, match="permission denied"):
            db.execute(text(FORGED))


def test_a_temporary_table_does_not_catch_what_the_trail_gets(fresh_database: str) -> None:
    with new_session() as db:
        before = db.scalar(text("select count(*) from public.audit_event"))
        db.execute(text("create temporary table audit_event (like public.audit_event)"))
        db.execute(text("insert into study (code, name) values ('S2', 'A second study')"))
        assert db.scalar(text("select count(*) from pg_temp.audit_event")) == 0
        assert db.scalar(text("select count(*) from public.audit_event")) == before + 1


def test_no_trigger_of_the_services_own_writes_the_trail(fresh_database: str) -> None:
    with new_session() as db:
        db.execute(text("create temporary table qoc (id int, rating int)"))
        with pytest.raises(ProgrammingError, match="permission denied for function audit_row"):
            db.execute(text("create trigger forged after insert on qoc for each row execute function audit_row('', 'id')"))


def test_an_owner_who_is_named_as_the_service_keeps_the_rights_that_the_trail_needs(owner_db: Session) -> None:
    assert service_role.grant(owner_db.connection(), "betaloop", None) == 0
    owner_db.execute(text("insert into study (code, name) values ('S2', 'A second study')"))
    assert owner_db.scalar(text("select count(*) from audit_event where entity = 'study' and after ->> 'code' = 'S2'")) == 1


def test_the_service_has_the_rights_it_needs_and_no_other(client: TestClient, participant_code: str, db: Session) -> None:
    rows = db.execute(
        text(
            "select n.nspname, c.relname, array_agg(a.privilege_type) from pg_class c join pg_namespace n on n.oid = c.relnamespace,"
            " lateral aclexplode(c.relacl) a where a.grantee in (0, 'betaloop_service'::regrole) and c.relkind in ('r', 'p', 'v')"
            " and n.nspname = any(:schemas) group by 1, 2"
        ),
        {"schemas": list(service_role.SCHEMAS)},
    ).all()
    assert {(s, t): frozenset(p) for s, t, p in rows} == {(s, t): service_role.wanted(s, t) for s, t, _ in rows}
    assert {t for s, t, _ in rows if s == "public"} >= set(AUDITED)
    assert service_role.excess(db.connection()) == []
    assert verify(db).whole  # what the service wrote reached the trail and its chain all the same


def test_a_role_that_owns_the_tables_is_found(fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [f.detail for f in examine() if f.name == "database role"] == ["betaloop_service owns nothing and cannot change the audit trail"]
    monkeypatch.setenv("BETALOOP_DATABASE_URL", owner_url())
    get_settings.cache_clear()
    (found,) = [f for f in examine() if not f.ok]
    assert found.name == "database role"
    assert "owns" in found.detail
    assert "may change the audit trail" in found.detail


def test_a_right_to_add_rows_to_the_trail_is_found(owner_db: Session, db: Session) -> None:
    owner_db.execute(text("grant insert on audit_event to public"))
    owner_db.commit()
    assert service_role.excess(db.connection()) == ["may change the audit trail"]


def test_the_service_alone_cannot_migrate_and_says_what_to_do(
    fresh_database: str, owner_db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("BETALOOP_OWNER_URL")
    get_settings.cache_clear()
    migrate()  # nothing is missing: the service starts
    owner_db.execute(text("delete from alembic_version"))
    owner_db.commit()
    with pytest.raises(RuntimeError, match="BETALOOP_OWNER_URL"):
        migrate()


def test_a_table_of_a_later_migration_gets_its_rights(fresh_database: str, owner_db: Session) -> None:
    owner_db.execute(text("create table later (n int)"))
    owner_db.execute(text("grant all on later to public"))
    owner_db.commit()
    migrate()
    with new_session() as db:
        db.execute(text("insert into later values (1)"))
        with pytest.raises(ProgrammingError, match="permission denied"):
            db.execute(text("truncate later"))


def test_a_role_that_is_missing_is_asked_for(owner_db: Session) -> None:
    with pytest.raises(RuntimeError, match="create role nobody_yet login"):
        service_role.grant(owner_db.connection(), "nobody_yet", "secret")
