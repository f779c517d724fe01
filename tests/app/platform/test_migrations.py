"""Migrations: they make what the models say, they lead back, and every audited table keeps its trail."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection, text
from sqlalchemy.orm import Session

from app.platform.audit import AUDITED
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


def test_the_way_back_to_the_first_release_and_forward_again_gives_the_same_tables(db: Session) -> None:
    connection = db.connection()
    command.downgrade(config(connection), "0001")
    command.upgrade(config(connection), "head")
    assert [d for d in differences(connection) if "alembic_version" not in str(d)] == []
    rows = db.execute(text("select event_object_table from information_schema.triggers where trigger_name = 'audit'"))
    assert {row[0] for row in rows} == set(AUDITED)
    db.rollback()
