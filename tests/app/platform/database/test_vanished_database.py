"""A database whose machine vanishes: its network drops everything, nothing is refused. Needs root, for network namespaces."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import create_engine, make_url, text
from sqlalchemy.exc import OperationalError

from app.platform import database
from app.platform.database.connection import connection_url
from app.platform.jobs.ledger import persist
from app.settings import get_settings
from tests.network import FORWARD

LONGEST_S = 15.0


def ran(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


class Machine:
    """A machine of its own in a network namespace, which passes connections on to the embedded server."""

    def __init__(self, number: int, path: str) -> None:
        self.space, self.link = f"bl{os.getpid()}n{number}", f"bl{os.getpid() % 10000}v{number}"
        # addresses of documentation (RFC 5737): loopback ones never leave a namespace, and this pair of links leads nowhere else
        self.address, here = f"192.0.2.{4 * number + 2}", f"192.0.2.{4 * number + 1}"
        ran("ip", "netns", "add", self.space)
        ran("ip", "link", "add", self.link, "type", "veth", "peer", "name", "inside", "netns", self.space)
        ran("ip", "addr", "add", f"{here}/30", "dev", self.link)
        ran("ip", "link", "set", self.link, "up")
        for words in (("addr", "add", f"{self.address}/30", "dev", "inside"), ("link", "set", "inside", "up"), ("link", "set", "lo", "up")):
            ran("ip", "-n", self.space, *words)
        self.process = subprocess.Popen(
            ["ip", "netns", "exec", self.space, sys.executable, "-c", FORWARD, self.address, "5432", path],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    def vanish(self) -> None:
        """Take its end of the link down: what is sent to it is lost, and nothing comes back."""
        ran("ip", "-n", self.space, "link", "set", "inside", "down")

    def remove(self) -> None:
        self.process.kill()
        self.process.wait()
        ran("ip", "link", "del", self.link)  # its namespace would take a while to let it go
        ran("ip", "netns", "del", self.space)


@pytest.fixture
def machines(fresh_database: str) -> Iterator[list[Machine]]:
    """Two machines that lead to the test's database."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("needs root and the command `ip` for a network namespace that can be cut off")
    folder = str(make_url(fresh_database).query["host"])
    found: list[Machine] = []
    try:
        for number in (1, 2):
            try:
                found.append(Machine(number, f"{folder}/.s.PGSQL.{make_url(fresh_database).query.get('port', '5432')}"))
            except subprocess.CalledProcessError as error:
                pytest.skip(f"no network namespace can be made here: {error.stderr.decode().strip()}")
        yield found
    finally:
        for machine in found:
            machine.remove()


def address(url: str, *machines: Machine) -> str:
    """Write the setting that names these machines, with the role and database of the embedded server's URL."""
    parsed = make_url(url)
    return f"postgresql://{parsed.username}:{parsed.password}@{','.join(f'{m.address}:5432' for m in machines)}/{parsed.database}"


def timed(action: Any) -> float:
    """Measure the seconds until an action fails as a lost connection does."""
    began = time.monotonic()
    with pytest.raises(OperationalError):
        action()
    return time.monotonic() - began


def test_a_connection_whose_server_vanishes_fails_within_fifteen_seconds(machines: list[Machine], fresh_database: str) -> None:
    engine = create_engine(connection_url("BETALOOP_DATABASE_URL", address(fresh_database, machines[0])))
    with engine.connect() as idle, engine.connect() as asking:
        assert idle.execute(text("select 1")).scalar() == 1
        cut = threading.Timer(1.0, machines[0].vanish)
        cut.start()
        # one waits for an answer when the machine vanishes, the other asks afterwards
        assert timed(lambda: asking.execute(text("select pg_sleep(120)"))) < LONGEST_S + 1.0
        assert timed(lambda: idle.execute(text("select 2"))) < LONGEST_S
        for connection in (idle, asking):
            connection.invalidate()


def test_the_service_goes_on_with_the_second_host(
    machines: list[Machine], fresh_database: str, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(get_settings(), "database_url", address(fresh_database, *machines))
    with database.new_session() as db:
        assert db.execute(text("select 1")).scalar() == 1
    assert client.get("/readyz").status_code == 200
    machines[0].vanish()
    began = time.monotonic()

    def asked() -> int:
        with database.new_session() as db:
            return int(db.execute(text("select 3")).scalar_one())

    # as a worker asks: the transaction is repeated while the database is away
    assert persist(asked, lambda: None) == 3
    assert client.get("/readyz").status_code == 200
    assert time.monotonic() - began < LONGEST_S + 5.0
    database.get_engine().dispose()
