"""Migrations: they make what the models say, they lead back, and every audited table keeps its trail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from fastapi.testclient import TestClient
from sqlalchemy import Connection, text
from sqlalchemy.orm import Session

from app.learning.policies.baselines import constant_onnx
from app.platform.audit import AUDITED
from app.platform.audit.chain import verify
from app.platform.database import Base
from app.platform.tables import load_tables

ROOT = Path(__file__).resolve().parents[3]


def differences(connection: Connection) -> list[Any]:
    """What a new migration would have to do; tables of the job engine's own schema are not ours."""
    load_tables()
    context = MigrationContext.configure(connection, opts={"compare_server_default": False})
    return list(compare_metadata(context, Base.metadata))


def config(connection: Connection) -> Config:
    made = Config(str(ROOT / "alembic.ini"))
    made.set_main_option("script_location", str(ROOT / "migrations"))
    made.attributes["connection"] = connection
    return made


def test_the_migrations_make_exactly_what_the_models_say(db: Session) -> None:
    found = [d for d in differences(db.connection()) if "alembic_version" not in str(d)]
    assert found == []


def test_every_audited_table_has_its_trigger(db: Session) -> None:
    rows = db.execute(text("select event_object_table from information_schema.triggers where trigger_name = 'audit'"))
    assert {row[0] for row in rows} == set(AUDITED)


def test_the_way_back_to_the_first_release_and_forward_again_gives_the_same_tables(owner_db: Session) -> None:
    connection = owner_db.connection()
    command.downgrade(config(connection), "0001")
    command.upgrade(config(connection), "head")
    assert [d for d in differences(connection) if "alembic_version" not in str(d)] == []
    rows = owner_db.execute(text("select event_object_table from information_schema.triggers where trigger_name = 'audit'"))
    assert {row[0] for row in rows} == set(AUDITED)
    owner_db.rollback()


def test_releases_of_bundles_are_read_from_the_old_audit_trail_where_they_parse(
    client: TestClient, enrolled: str, owner_db: Session
) -> None:
    onnx = {"file": ("e.onnx", constant_onnx(0.6, 10))}
    policy = client.post(f"/api/v1/participants/{enrolled}/policies", data={"name": "flat"}, files=onnx).json()["id"]
    assert client.get(f"/api/v1/policies/{policy}/bundle").status_code == 200
    reasons = (
        f"controller bundle of P1, policy {policy}, left: 0.5 to 3.25 mA, cDBS 3 mA, ramp 1e-05 mA/s",
        f"controller bundle of P1, policy {policy}9: 0 to 3 mA, cDBS 3 mA, ramp 1.5 mA/s",
        "controller bundle, as somebody might write it",
    )
    (sha256,) = owner_db.scalars(text("select sha256 from bundle_release")).all()
    for reason in reasons:
        owner_db.execute(
            text(
                "insert into audit_event (actor, action, entity, entity_id, reason)"
                " values ('ada@clinic.example', 'insert', 'stored_file', :sha, :reason)"
            ),
            {"sha": sha256, "reason": reason},
        )
    command.downgrade(config(owner_db.connection()), "0005")
    command.upgrade(config(owner_db.connection()), "head")
    rows = owner_db.execute(
        text("select policy_id, hemisphere, min_ma, max_ma, ramp_ma_per_s, approvals, created_by, sha256 from bundle_release order by id")
    )
    assert [tuple(row) for row in rows] == [
        (policy, None, 0.0, 3.0, 1.5, None, "admin@clinic.example", sha256),
        (policy, "left", 0.5, 3.25, 1e-05, None, "ada@clinic.example", sha256),
    ]
    owner_db.rollback()


def test_a_token_without_an_end_is_given_one_and_others_keep_theirs(owner_db: Session) -> None:
    connection = owner_db.connection()
    command.downgrade(config(connection), "0033")
    owner_db.execute(text("insert into app_user (email, name, password_hash, active) values ('ada@clinic.example', '', '', true)"))
    made = (
        "insert into api_token (user_id, name, token_sha256, expires_at) select id, :name, :name, cast(:ends as timestamptz) from app_user"
    )
    for name, end in (("endless", None), ("short", "2026-12-01T00:00:00Z")):
        owner_db.execute(text(made), {"name": name, "ends": end})
    command.upgrade(config(connection), "head")
    ends = owner_db.execute(text("select name, expires_at - now() = interval '90 days' from api_token order by name"))
    assert [tuple(row) for row in ends] == [("endless", True), ("short", False)]
    assert owner_db.scalar(text("select expires_at = '2026-12-01T00:00:00Z' from api_token where name = 'short'"))
    owner_db.rollback()


def test_what_earlier_migrations_wrote_past_the_trail_has_its_entries(client: TestClient, enrolled: str, owner_db: Session) -> None:
    visit = client.post(f"/api/v1/participants/{enrolled}/visits", json={"number": 3}).json()["id"]
    command.downgrade(config(owner_db.connection()), "0032")
    lock = "insert into visit_lock (visit_id, locked, reason, created_by) values (:visit, true, 'complete', 'ada@clinic.example')"
    owner_db.execute(text(lock), {"visit": visit})
    command.upgrade(config(owner_db.connection()), "head")
    owner_db.commit()
    assert owner_db.scalar(text("select settings_version_id from visit_lock")) is not None
    entry = (
        "select actor, action, before ? 'settings_version_id', after ? 'settings_version_id' from audit_event where entity = 'visit_lock'"
    )
    assert [tuple(row) for row in owner_db.execute(text(f"{entry} order by id"))][1:] == [("migration 0035", "update", False, True)]
    assert verify(owner_db).whole


def test_doses_taken_back_since_go_with_the_way_back(client: TestClient, enrolled: str, owner_db: Session) -> None:
    visit = client.post(f"/api/v1/participants/{enrolled}/visits", json={"number": 3, "date": "2026-03-02"}).json()["id"]
    dose = {"drug": "levodopa", "mg": 100, "taken_at": "2026-03-02T07:00:00Z"}
    for mg in (100, 50):
        number = client.post(f"/api/v1/visits/{visit}/doses", json=dose | {"mg": mg}).json()["id"]
        if mg == 100:
            client.post(f"/api/v1/doses/{number}/removal", json={"reason": "it was 50 mg"})
    command.downgrade(config(owner_db.connection()), "0033")
    assert owner_db.scalars(text("select mg from dose")).all() == [50]
    command.upgrade(config(owner_db.connection()), "head")
    owner_db.commit()
    assert verify(owner_db).whole
