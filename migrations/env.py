"""Alembic environment: the same engine and metadata as the service."""

from __future__ import annotations

from alembic import context

from app.platform.database import get_engine
from app.tables import METADATA


def _include(_object, name, type_, _reflected, _compare_to):  # type: ignore[no-untyped-def]
    return not (type_ == "table" and name == "alembic_version")


def run() -> None:
    """Migrate inside one transaction; a migration that waits for a lock longer than 10 s gives up instead of blocking the clinic."""
    connection = context.config.attributes.get("connection")
    if connection is not None:
        _migrate(connection)
        return
    with get_engine().begin() as connection:
        _migrate(connection)


def _migrate(connection) -> None:  # type: ignore[no-untyped-def]
    connection.exec_driver_sql("set local lock_timeout = '10s'")
    context.configure(connection=connection, target_metadata=METADATA, include_object=_include, compare_server_default=False)
    context.run_migrations()


run()
