"""Migrations: they make what the tables say, refuse other schemas, and every audited table has its trail."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection, text
from sqlalchemy.orm import Session

from app.platform.audit import AUDITED
from app.platform.upkeep.migrate import migrate
from app.tables import METADATA

ROOT = Path(__file__).resolve().parents[3]


def differences(connection: Connection) -> list[Any]:
    """List what a new migration would have to do; tables of the job engine's own schema are not ours."""
    context = MigrationContext.configure(connection, opts={"compare_server_default": False})
    return list(compare_metadata(context, METADATA))


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


def test_a_database_of_another_version_is_refused_and_left_as_it_is(fresh_database: str, owner_db: Session) -> None:
    owner_db.execute(text("update alembic_version set version_num = '0040'"))
    owner_db.commit()
    with pytest.raises(RuntimeError, match=r"does not know the schema .*0040.*restore a backup"):
        migrate()
    assert owner_db.scalar(text("select version_num from alembic_version")) == "0040"


def test_the_first_schema_changes_its_name_with_its_content_so_that_databases_of_before_are_refused() -> None:
    """Until a version is released it is changed in place. No name may begin with another: alembic takes the short one for both."""
    (path,) = (ROOT / "migrations" / "versions").glob("*.py")
    content, known = re.subn(r'^revision = "first_(\w+)"\n', "", path.read_text(), flags=re.MULTILINE)
    assert known == 1
    digest = hashlib.sha256(content.encode()).hexdigest()[:8]
    assert f'revision = "first_{digest}"' in path.read_text(), f'write revision = "first_{digest}"'


def test_nothing_comes_before_the_first_schema(owner_db: Session) -> None:
    with pytest.raises(RuntimeError, match="restore a backup"):
        command.downgrade(config(owner_db.connection()), "base")
    owner_db.rollback()
    assert owner_db.scalar(text("select count(*) from study")) == 1
