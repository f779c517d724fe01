"""Migration of the database to the newest schema."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from psycopg.errors import InsufficientPrivilege
from sqlalchemy import Connection, Engine, NullPool, create_engine, make_url, text
from sqlalchemy.exc import ProgrammingError
from sqlalchemy.orm import Session

from app.platform import service_role
from app.platform.database import database_url, get_engine, owner_url
from app.platform.files import close_to_others
from app.platform.jobs import engine as jobs_engine

ROOT = Path(__file__).resolve().parents[3]
_LOCK = 0x62657461  # any number that only this project uses


def migrate() -> None:
    """Run every migration that is missing, as the owner of the tables, and give the service's role its rights.

    Processes that start at once wait for each other. Folders open to other users of the machine are closed on the way.

    Raises:
        RuntimeError: migrations are missing and the role may not run them, or the database has a schema that this version does not know.
    """
    close_to_others()
    owner, service = owner_url(), database_url()
    engine = get_engine() if owner == service else create_engine(owner, poolclass=NullPool, hide_parameters=True)
    try:
        _upgrade(engine)
        jobs_engine.prepare(owner)
        if owner != service:
            with _one_at_a_time(engine) as connection:
                service_role.grant(connection, service_role.role_of(service), make_url(service).password)
    except ProgrammingError as error:
        if isinstance(error.orig, InsufficientPrivilege):
            raise RuntimeError(
                f"the database role {service_role.role_of(owner)} may not change the tables: run `betaloop migrate` with"
                " BETALOOP_OWNER_URL, the address with the role that owns them"
            ) from error
        raise


def _upgrade(engine: Engine) -> None:
    config = Config(str(ROOT / "alembic.ini"))
    config.set_main_option("script_location", str(ROOT / "migrations"))
    with _one_at_a_time(engine) as connection:
        config.attributes["connection"] = connection
        try:
            command.upgrade(config, "head")
        except CommandError as error:
            raise RuntimeError(
                f"this version of betaloop does not know the schema of its database ({error}). Install the version that last ran on it,"
                " or restore a backup that this version made"
            ) from error


@contextmanager
def _one_at_a_time(engine: Engine) -> Iterator[Connection]:
    with engine.begin() as connection:
        connection.execute(text("select pg_advisory_xact_lock(:key)"), {"key": _LOCK})
        yield connection


def newest_revision() -> str:
    """Read the schema that this betaloop needs."""
    config = Config(str(ROOT / "alembic.ini"))
    config.set_main_option("script_location", str(ROOT / "migrations"))
    return ScriptDirectory.from_config(config).get_current_head() or ""


def revision(db: Session) -> str:
    """Read the schema that the database has."""
    if db.scalar(text("select to_regclass('alembic_version')")) is None:
        return ""
    return db.scalar(text("select version_num from alembic_version")) or ""
