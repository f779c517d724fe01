"""Access to the embedded database: three roles with generated passwords, and no others.

`postgres` is the superuser of the server's own upkeep. `betaloop` owns the database and runs migrations. The service connects as
`betaloop_service`, which owns nothing and has the rights of `app.platform.service_role`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import psycopg
from psycopg import sql
from psycopg.conninfo import make_conninfo

from app.platform.embedded.programs import ADMIN

OWNER, SERVICE, DATABASE = "betaloop", "betaloop_service", "betaloop"
PORT = 5432
"""Part of the socket's name. It is always stated, since PGPORT in a user's environment would change it for one process only."""
_RULES = "# Written by betaloop: passwords only, see the data folder's secrets.\nlocal all all scram-sha-256\n"
_SETTING_UP = (
    "# Written by betaloop: for the moment in which passwords are set; the socket's folder is closed to others.\nlocal all postgres trust\n"
)
_RELOAD_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class Passwords:
    """Of the three roles."""

    admin: str
    owner: str
    service: str

    def of(self, role: str) -> str:
        """Return the password of one role."""
        return {ADMIN: self.admin, OWNER: self.owner, SERVICE: self.service}[role]


class Access:
    """The rules and roles of one running server.

    Args:
        data: its data folder. sockets: where it listens. passwords: of the roles. reload: has the server read its rules again.
    """

    def __init__(self, data: Path, sockets: Path, passwords: Passwords, reload: Callable[[], object]) -> None:
        self._rules, self._sockets, self._passwords, self._reload = data / "pg_hba.conf", sockets, passwords, reload

    def conninfo(self, database: str, role: str = ADMIN) -> str:
        """Return the connection string for libpq."""
        password = self._passwords.of(role)
        return make_conninfo(host=str(self._sockets), port=PORT, user=role, password=password, dbname=database, connect_timeout=5)

    def ensure(self) -> None:
        """Require passwords, and make the roles and the database; what exists is left as it is.

        Raises:
            RuntimeError: the server does not take the new rules.
        """
        if self._rules.read_text() != _RULES or not self._may("postgres", ADMIN):
            # a new or older server, or lost secrets: the owner of the data folder may set new passwords
            self._apply(_SETTING_UP, lambda: self._may("postgres", ADMIN))
            self._set_passwords()
            wrong = {"password": "wrong"}
            self._apply(_RULES, lambda: self._may("postgres", ADMIN) and not self._may("postgres", ADMIN, **wrong))
        self._ensure_database()
        if not (self._may(DATABASE, OWNER) and self._may(DATABASE, SERVICE)):
            self._set_passwords()

    def _may(self, database: str, role: str, **other: str) -> bool:
        try:
            with psycopg.connect(self.conninfo(database, role), **other):  # type: ignore[arg-type]
                return True
        except psycopg.OperationalError:
            return False

    def _apply(self, rules: str, in_force: Callable[[], bool]) -> None:
        draft = self._rules.with_name("pg_hba.conf.part")
        before = self._rules.stat()
        fd = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with open(fd, "w") as out:
            out.write(rules)
            out.flush()
            os.fsync(out.fileno())
        os.chown(draft, before.st_uid, before.st_gid)
        draft.replace(self._rules)
        self._reload()
        deadline = time.monotonic() + _RELOAD_TIMEOUT_S
        while not in_force():
            if time.monotonic() > deadline:
                raise RuntimeError(f"The embedded PostgreSQL does not take the rules in {self._rules}. See server.log next to them.")
            time.sleep(0.05)

    def _set_passwords(self) -> None:
        with psycopg.connect(self.conninfo("postgres"), autocommit=True) as connection:
            # the passwords are random and 256 bits long: hashing them many times protects nothing and costs at every connection
            connection.execute("set scram_iterations = 1")
            connection.execute("set log_statement = 'none'")
            for role in (ADMIN, OWNER, SERVICE):
                if connection.execute("select 1 from pg_roles where rolname = %s", (role,)).fetchone() is None:
                    connection.execute(sql.SQL("create role {}").format(sql.Identifier(role)))
                password = sql.Literal(self._passwords.of(role))
                connection.execute(sql.SQL("alter role {} login password {}").format(sql.Identifier(role), password))
            for role in (OWNER, SERVICE):
                connection.execute(sql.SQL("alter role {} nosuperuser nocreatedb nocreaterole").format(sql.Identifier(role)))

    def _ensure_database(self) -> None:
        with psycopg.connect(self.conninfo("postgres"), autocommit=True) as connection:
            if connection.execute("select 1 from pg_database where datname = %s", (DATABASE,)).fetchone() is None:
                connection.execute(sql.SQL("create database {} owner {}").format(sql.Identifier(DATABASE), sql.Identifier(OWNER)))
