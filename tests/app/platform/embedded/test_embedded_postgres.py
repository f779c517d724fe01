"""The embedded PostgreSQL under the faults that happen to laptops."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import psycopg
import pytest

from app.platform.embedded.programs import Programs, make_cluster
from app.platform.embedded.server import EmbeddedPostgres
from app.platform.embedded.system_user import SystemUser
from app.settings import get_settings


@pytest.fixture
def own_server(tmp_path: Path):  # type: ignore[no-untyped-def]
    server = EmbeddedPostgres(tmp_path / "postgres")
    server.start()
    yield server
    server.remove()


def connect(server: EmbeddedPostgres) -> psycopg.Connection:
    return psycopg.connect(server.owner_url("betaloop").replace("+psycopg", ""), autocommit=True)


def test_what_was_committed_survives_kill_9_of_the_postmaster(own_server: EmbeddedPostgres, tmp_path: Path) -> None:
    with connect(own_server) as connection:
        assert connection.execute("show fsync").fetchone() == ("on",)
        connection.execute("create table kept (n int)")
        connection.execute("insert into kept values (7)")
    os.kill(own_server.pid(), signal.SIGKILL)
    again = EmbeddedPostgres(tmp_path / "postgres")
    again.start()
    try:
        with connect(again) as connection:
            assert connection.execute("select n from kept").fetchone() == (7,)
    finally:
        again.leave()


def test_the_server_outlives_one_of_two_users_and_not_the_last(tmp_path: Path) -> None:
    folder = tmp_path / "postgres"
    code = (
        "import sys, pathlib; from app.platform.embedded.server import EmbeddedPostgres as E;"
        f"s = E(pathlib.Path({str(folder)!r})); s.start(); print(s.pid(), flush=True); sys.stdin.readline()"
    )
    users = [
        subprocess.Popen([sys.executable, "-W", "ignore", "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    pids = {int(u.stdout.readline()) for u in users if u.stdout}
    assert len(pids) == 1
    users[0].communicate("\n", timeout=300)
    assert Path(f"/proc/{pids.copy().pop()}").exists()
    users[1].communicate("\n", timeout=300)
    deadline = time.monotonic() + 60
    while Path(f"/proc/{min(pids)}").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not Path(f"/proc/{min(pids)}").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has another user's server to keep out of its home")
def test_a_closed_home_stays_closed(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir(mode=0o700)
    server = EmbeddedPostgres(home / "data" / "postgres")
    (home / "data").mkdir()
    server.start()
    try:
        with connect(server) as connection:
            assert connection.execute("select 1").fetchone() == (1,)
        assert home.stat().st_mode & 0o077 == 0
    finally:
        server.remove()


def test_any_name_of_a_data_folder_will_do(tmp_path: Path) -> None:
    named = EmbeddedPostgres(tmp_path / 'Klinik "Süd", it\'s (a) [b]: $HOME `x` \\ 100%' / "postgres", durable=False)
    named.start()
    try:
        with connect(named) as connection:
            assert connection.execute("select 1").fetchone() == (1,)
    finally:
        named.remove()


def test_variables_of_another_postgresql_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = EmbeddedPostgres(tmp_path / "postgres", durable=False)
    for name, value in {"PGPORT": "6543", "PGDATA": "/nowhere", "PGHOST": "db.example", "PGUSER": "ada", "PGDATABASE": "other"}.items():
        monkeypatch.setenv(name, value)
    first.start()
    try:
        for name in ("PGPORT", "PGDATA", "PGHOST", "PGUSER", "PGDATABASE"):
            monkeypatch.delenv(name)
        second = EmbeddedPostgres(tmp_path / "postgres", durable=False)
        second.start()
        assert second.pid() == first.pid()
        with connect(second) as connection:
            assert connection.execute("show port").fetchone() == ("5432",)
        second.leave()
    finally:
        first.remove()


def test_a_server_that_ends_at_once_is_told_within_20_s_and_leaves_nothing(tmp_path: Path) -> None:
    faulty = EmbeddedPostgres(tmp_path / "postgres", durable=False)
    faulty.start()
    faulty.leave()
    with (faulty.data / "postgresql.conf").open("a") as settings:
        settings.write("no_such_setting = on\n")
    begun = time.monotonic()
    with pytest.raises(RuntimeError, match=r"does not start(.|\n)*no_such_setting"):
        faulty.start()
    assert time.monotonic() - begun < 20
    assert not (faulty.data / "postmaster.pid").exists()


def test_a_number_that_another_postgresql_got_is_not_taken_for_ours(tmp_path: Path, server: EmbeddedPostgres) -> None:
    crashed = EmbeddedPostgres(tmp_path / "crashed" / "postgres", durable=False)
    crashed.start()
    try:
        os.kill(crashed.pid(), signal.SIGKILL)
        file = crashed.data / "postmaster.pid"
        file.write_text("\n".join([str(server.pid()), *file.read_text().splitlines()[1:]]))
        again = EmbeddedPostgres(tmp_path / "crashed" / "postgres", durable=False)
        again.start()
        assert again.pid() != server.pid()
        with connect(server) as connection:
            assert connection.execute("select 1").fetchone() == (1,)
        again.leave()
    finally:
        crashed.remove()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root mounts a smaller shared memory")
def test_a_megabyte_of_shared_memory_is_enough(tmp_path: Path) -> None:
    code = (
        "import pathlib, psycopg; from app.platform.embedded.server import EmbeddedPostgres as E\n"
        f"s = E(pathlib.Path({str(tmp_path / 'postgres')!r}), durable=False); s.start()\n"
        "with psycopg.connect(s.owner_url('betaloop').replace('+psycopg', '')) as c:\n"
        "    c.execute('set debug_parallel_query = on')\n"
        "    print(c.execute('select sum(g) from generate_series(1, 100000) g').fetchone()[0])\n"
        "s.remove()"
    )
    command = 'mount -t tmpfs -o size=1m tmpfs /dev/shm && exec "$@"'
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", command, "sh", sys.executable, "-W", "ignore", "-c", code],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.stdout.strip() == "5000050000", done.stderr


def test_a_user_without_an_entry_is_explained(tmp_path: Path) -> None:
    unknown = Programs(tmp_path, SystemUser("nobody-knows", 54321, 54321))
    with pytest.raises(RuntimeError, match=r"user number 54321, who has no entry in /etc/passwd\. .*BETALOOP_DATABASE_URL"):
        make_cluster(tmp_path / "postgres", unknown)
    assert not list(tmp_path.iterdir())


def test_a_server_whose_users_were_all_killed_is_stopped_by_the_command(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    code = (
        "import os, pathlib, signal; from app.platform.embedded.server import EmbeddedPostgres as E\n"
        f"s = E(pathlib.Path({str(folder / 'postgres')!r}), durable=False, server_user={get_settings().server_user!r})\n"
        "s.start(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=False, timeout=120)
    left = EmbeddedPostgres(folder / "postgres", durable=False, server_user=get_settings().server_user)
    number = left.pid()
    assert psutil.pid_exists(number)
    env = {k: v for k, v in os.environ.items() if k != "BETALOOP_DATABASE_URL"} | {"BETALOOP_DATA_DIR": str(folder)}
    try:
        done = subprocess.run([sys.executable, "-W", "ignore", "-m", "app.platform.embedded.server"], env=env, check=False, timeout=120)
        assert done.returncode == 0
        assert not psutil.pid_exists(number)
    finally:
        left.remove()
