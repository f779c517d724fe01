"""Migration of the database to the newest schema."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from alembic import command
from alembic.config import Config
from alembic.operations import Operations
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from psycopg.errors import InsufficientPrivilege
from sqlalchemy import Column, Connection, Engine, MetaData, NullPool, Table, create_engine, func, make_url, select, text
from sqlalchemy.exc import ProgrammingError
from sqlalchemy.orm import Session

from app.platform import service_role
from app.platform.database import DEFINED, Base, database_url, get_engine, owner_url
from app.platform.files import close_to_others
from app.platform.jobs import engine as jobs_engine
from app.platform.numbers import counted

ROOT = Path(__file__).resolve().parents[3]
_LOCK = 0x62657461  # any number that only this project uses


def migrate() -> None:
    """Run every migration that is missing, as the owner of the tables, and give the service's role its rights.

    Processes that start at once wait for each other. Folders open to other users of the machine are closed on the way.

    Raises:
        RuntimeError: migrations are missing and the role may not run them. Or this version does not know the schema of the database. Or it
            has values of an outcome that this installation no longer defines.
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
        add_columns(connection)


@contextmanager
def _one_at_a_time(engine: Engine) -> Iterator[Connection]:
    with engine.begin() as connection:
        connection.execute(text("select pg_advisory_xact_lock(:key)"), {"key": _LOCK})
        yield connection


def newest_revision() -> str:
    """Read the schema that this betaloop needs."""
    config = Config(str(ROOT / "alembic.ini"))
    config.set_main_option("script_location", str(ROOT / "migrations"))
    return (ScriptDirectory.from_config(config).get_current_head() or "") + needed_suffix()


def revision(db: Session) -> str:
    """Read the schema that the database has."""
    if db.scalar(text("select to_regclass('alembic_version')")) is None:
        return ""
    found: str | None = db.scalar(text("select version_num from alembic_version"))
    return (found or "") + stored_suffix(db)


# Columns that an installation defines by its own files, as outcomes of choice: they are a part of the schema's name.

_COMMENTS = text(
    "select c.relname, a.attname, col_description(a.attrelid, a.attnum) from pg_attribute a join pg_class c on c.oid = a.attrelid"
    " where c.relnamespace = current_schema()::regnamespace and c.relkind = 'r' and not a.attisdropped"
    " and col_description(a.attrelid, a.attnum) like :mark order by 1, 2"
)
_MARK = "defined: "


def _columns_of_choice() -> Iterator[tuple[Table, Column[Any]]]:
    """Yield the columns that this installation defines, by table and name."""
    found = ((table, column) for table in Base.metadata.tables.values() for column in table.columns if DEFINED in column.info)
    yield from sorted(found, key=lambda pair: (pair[0].name, pair[1].name))


def _comment_of(column: Column[Any]) -> str:
    return _MARK + json.dumps(column.info[DEFINED], sort_keys=True)


def _definitions_in(connection: Connection | Session) -> dict[tuple[str, str], str]:
    """Read the definitions of the columns that the database has, by table and name."""
    return {(table, name): comment for table, name, comment in connection.execute(_COMMENTS, {"mark": f"{_MARK}%"})}


def _suffix(definitions: dict[tuple[str, str], str]) -> str:
    """Name a set of definitions, to follow the name of the schema; empty where there is none."""
    if not definitions:
        return ""
    content = json.dumps(sorted([*key, comment] for key, comment in definitions.items()))
    return f"+{hashlib.sha256(content.encode()).hexdigest()[:8]}"


def needed_suffix() -> str:
    """Name the definitions of this process."""
    return _suffix({(table.name, column.name): _comment_of(column) for table, column in _columns_of_choice()})


def stored_suffix(db: Session) -> str:
    """Name the definitions that the database has."""
    return _suffix(_definitions_in(db))


def add_columns(connection: Connection) -> None:
    """Add the columns that are missing, and drop those whose definition is gone and that hold nothing.

    Raises:
        RuntimeError: a column with values is no longer defined, or is defined otherwise.
    """
    known, run = _definitions_in(connection), Operations(MigrationContext.configure(connection))
    wanted = {(table.name, column.name): (table, column) for table, column in _columns_of_choice()}
    for (name, field), comment in known.items():
        if (name, field) in wanted and _comment_of(wanted[name, field][1]) == comment:
            continue
        _refuse_if_used(connection, name, field, gone=(name, field) not in wanted)
        run.drop_column(name, field)
    for (name, field), (table, column) in wanted.items():
        if known.get((name, field)) == _comment_of(column):
            continue
        fresh: Column[Any] = Column(
            field, column.type, nullable=column.nullable, server_default=column.server_default, comment=_comment_of(column)
        )
        run.add_column(table.name, fresh)
        run.create_check_constraint(run.f(f"ck_{name}_{field}"), name, text(column.info[DEFINED]["check"]))


def _refuse_if_used(connection: Connection, table: str, field: str, *, gone: bool) -> None:
    """Raise RuntimeError where a column has a value that a person gave."""
    column = Table(table, MetaData(), autoload_with=connection).columns[field]
    default = getattr(column.server_default, "arg", None)
    given = column.is_not(None) if default is None else column.is_distinct_from(default)
    count = connection.scalar(select(func.count()).where(given))
    if count:
        why = "is no longer defined" if gone else "is defined otherwise than before"
        raise RuntimeError(
            f"the database has {counted(count, 'value')} of `{field}`, which {why}: put its definition back as it was"
            + ("" if gone else ", and give the changed one another key")
        )
