"""The address of a database as a setting has it: what is added, what is kept, and what cannot be read."""

from __future__ import annotations

import pytest
from sqlalchemy import make_url
from sqlalchemy.exc import OperationalError

from app.platform import database
from app.platform.database.connection import NOTICED, connection_url
from app.platform.errors import DatabaseAway, passing
from app.platform.jobs.ledger import _worth_repeating
from app.settings import Settings

NAME = "BETALOOP_DATABASE_URL"


def test_every_connection_notices_a_server_that_vanishes() -> None:
    settings = Settings(database_url="postgresql://a:p%40ss@db.example/clinic", owner_url="postgresql://o@db.example/clinic")
    for url in (database.database_url(settings), database.owner_url(settings)):
        found = make_url(url)
        assert dict(found.query) == NOTICED
        assert (found.host, found.database) == ("db.example", "clinic")
    assert make_url(database.database_url(settings)).password == "p@ss"
    assert database.database_place(settings) == "postgresql+psycopg://a:***@db.example/clinic"


def test_what_a_url_states_is_kept() -> None:
    found = make_url(connection_url(NAME, "postgresql://a@h/d?connect_timeout=2&keepalives=0&sslmode=require"))
    assert found.query == {**NOTICED, "connect_timeout": "2", "keepalives": "0", "sslmode": "require"}


@pytest.mark.parametrize(
    ("hosts", "names", "ports"),
    [("h1:5432,h2:5433", "h1,h2", "5432,5433"), ("h1,h2", "h1,h2", "5432,5432"), ("[::1]:6,[fe80::2]", "::1,fe80::2", "6,5432")],
)
def test_several_hosts_are_read_as_libpq_writes_them_and_the_writable_one_is_asked_for(hosts: str, names: str, ports: str) -> None:
    found = make_url(connection_url(NAME, f"postgres://a:b@{hosts}/d"))
    assert (found.query["host"], found.query["port"]) == (names, ports)
    assert found.query["target_session_attrs"] == "read-write"
    stated = make_url(connection_url(NAME, f"postgresql://a:b@{hosts}/d?target_session_attrs=any"))
    assert stated.query["target_session_attrs"] == "any"


@pytest.mark.parametrize(
    "url", ["postgresql://a:secret@h1:x,h2/d", "postgresql://a:secret@h:x/d", "mysql://a:secret@h/d", "postgresql://a:secret@h,/d"]
)
def test_what_cannot_be_read_is_told_without_its_password(url: str) -> None:
    with pytest.raises(RuntimeError, match=NAME) as told:
        connection_url(NAME, url)
    assert "secret" not in str(told.value)


class Fault(Exception):
    """An error of the driver."""

    def __init__(self, sqlstate: str) -> None:
        super().__init__(sqlstate)
        self.sqlstate = sqlstate


@pytest.mark.parametrize(("state", "waits"), [("25006", True), ("53100", True), ("57P01", True), ("23505", False), ("42601", False)])
def test_jobs_wait_while_the_database_takes_no_writes(state: str, waits: bool) -> None:
    assert _worth_repeating(OperationalError("insert", {}, Fault(state))) is waits


def test_a_read_only_database_is_a_fault_that_passes_for_a_request() -> None:
    assert isinstance(passing(OperationalError("insert", {}, Fault("25006"))), DatabaseAway)
