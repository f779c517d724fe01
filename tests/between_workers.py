"""A database and its files that one worker of a test run has made, for the other workers of the run."""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
from psycopg.sql import SQL, Composed

from app.platform.embedded.server import EmbeddedPostgres

OURS = "nspname !~ '^pg_' and nspname <> 'information_schema'"
TABLES = f"""
select format('%I.%I', nspname, relname), string_agg(quote_ident(attname), ', ' order by attnum)
from pg_class c join pg_namespace n on n.oid = relnamespace join pg_attribute a on attrelid = c.oid
where relkind = 'r' and {OURS} and attnum > 0 and not attisdropped and attgenerated = '' group by 1 order by 1
"""
SEQUENCES = "select format('%I.%I', schemaname, sequencename), last_value from pg_sequences where last_value is not null"


@contextmanager
def one_at_a_time(folder: Path) -> Iterator[None]:
    """Keep the other workers waiting while this one is in the block, which makes or reads what is in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def give(server: EmbeddedPostgres, database: str, data: Path, state: Any, folder: Path) -> None:
    """Write the rows of a database, its data folder and what the tests know of it; a folder without `state.json` has nothing yet."""
    with psycopg.connect(server.admin_conninfo(database)) as connection, connection.cursor() as cursor:
        for number, (table, columns) in enumerate(connection.execute(TABLES).fetchall()):
            with (
                (folder / f"{number}.rows").open("wb") as file,
                cursor.copy(_sql(f"copy {table} ({columns}) to stdout (format binary)")) as rows,
            ):
                file.writelines(rows)
        sequences = connection.execute(SEQUENCES).fetchall()
    shutil.copytree(data, folder / "data")
    (folder / "state.json").write_text(json.dumps({"sequences": sequences, "state": state}))


def take(server: EmbeddedPostgres, database: str, data: Path, folder: Path) -> Any:
    """Fill a database at the newest schema, and a data folder, with what `give` wrote. Returns the state; None where nothing is there."""
    if not (folder / "state.json").exists():
        return None
    given = json.loads((folder / "state.json").read_text())
    with psycopg.connect(server.admin_conninfo(database)) as connection, connection.cursor() as cursor:
        tables = connection.execute(TABLES).fetchall()
        cursor.execute("set session_replication_role = replica")  # no trigger writes, and no reference is looked at before all rows are in
        cursor.execute(_sql(f"truncate {', '.join(table for table, _ in tables)}"))
        for number, (table, columns) in enumerate(tables):
            with cursor.copy(_sql(f"copy {table} ({columns}) from stdin (format binary)")) as rows:
                rows.write((folder / f"{number}.rows").read_bytes())
        for sequence, value in given["sequences"]:
            cursor.execute("select setval(%s::regclass, %s)", (sequence, value))
    shutil.copytree(folder / "data", data)
    return given["state"]


def _sql(statement: str) -> Composed:
    return Composed([SQL(statement)])  # type: ignore[arg-type]  # names of the database's own tables, quoted by it
