"""Bring the database to the newest schema."""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import text

from app.platform.database import database_url, get_engine
from app.platform.files import close_to_others
from app.platform.jobs import engine as jobs_engine

ROOT = Path(__file__).resolve().parents[2]
_LOCK = 0x62657461  # any number that only this project uses


def migrate() -> None:
    """Run every migration that is missing; processes that start at once wait for each other.

    What an earlier version left open to other users of the machine is closed on the way.
    """
    close_to_others()
    config = Config(str(ROOT / "alembic.ini"))
    config.set_main_option("script_location", str(ROOT / "migrations"))
    with get_engine().begin() as connection:
        connection.execute(text("select pg_advisory_xact_lock(:key)"), {"key": _LOCK})
        config.attributes["connection"] = connection
        command.upgrade(config, "head")
    jobs_engine.prepare(database_url())
