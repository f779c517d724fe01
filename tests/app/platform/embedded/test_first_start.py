"""The first start on a machine that has never seen betaloop, in several processes at once."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from app.platform.embedded.server import EmbeddedPostgres
from app.platform.embedded.system_user import system_user
from app.settings import Settings
from tests.system_users import exists, require_root, unknown_user

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture
def unknown() -> Iterator[str]:
    require_root("only root makes system users")
    with unknown_user() as name:
        yield name


def at_once(code: str, arguments: list[str], **env: str) -> list[str]:
    """Run a script in one process per argument; all wait for the same moment, and hold on until all are done. What each printed."""
    script = f"import sys; arg = sys.argv[1]\nprint('ready', flush=True); sys.stdin.readline()\n{code}\nsys.stdin.readline()"
    processes = [
        subprocess.Popen(
            [sys.executable, "-W", "ignore", "-c", script, argument], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)} | env,
        )
        for argument in arguments
    ]  # fmt: skip
    try:
        for process in processes:
            assert process.stdout
            assert process.stdout.readline() == "ready\n"
        for process in processes:
            assert process.stdin
            process.stdin.write("go\n")
            process.stdin.flush()
        lines = [process.stdout.readline().strip() for process in processes if process.stdout]
        results = [process.communicate("end\n", timeout=120) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    for process, (_, errors) in zip(processes, results, strict=True):
        assert process.returncode == 0, errors
    return lines


def test_eight_first_starts_at_once_in_two_data_folders(tmp_path: Path, unknown: str) -> None:
    folders = [tmp_path / name / "postgres" for name in ("one", "two")]
    code = (
        "import pathlib; from app.platform.embedded.server import EmbeddedPostgres\n"
        f"server = EmbeddedPostgres(pathlib.Path(arg), durable=False, server_user={unknown!r})\n"
        "server.start(); print(server.pid(), flush=True)"
    )
    try:
        pids = at_once(code, [str(folder) for folder in folders] * 4)
        assert exists(unknown)
        assert len(set(pids[0::2])) == 1
        assert len(set(pids[1::2])) == 1
        assert len(set(pids)) == 2
        for folder in folders:
            server = EmbeddedPostgres(folder, durable=False, server_user=unknown)
            server.start()
            assert server.data.stat().st_uid == system_user(unknown).uid
            server.leave()
    finally:
        for folder in folders:
            EmbeddedPostgres(folder, durable=False, server_user=unknown).remove()


def test_a_user_is_made_once_by_many(unknown: str) -> None:
    code = f"from app.platform.embedded.system_user import system_user; print(system_user({unknown!r}).uid, flush=True)"
    assert len(set(at_once(code, [""] * 8))) == 1
    assert exists(unknown)
    shell = subprocess.run(["getent", "passwd", unknown], capture_output=True, text=True, check=True).stdout
    assert shell.strip().endswith(":/nonexistent:/usr/sbin/nologin")


def test_a_user_that_cannot_be_made_is_explained(unknown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "useradd"
    program.write_text("#!/bin/sh\necho 'the directory of users is read-only' >&2\nexit 6\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with pytest.raises(RuntimeError, match=r"read-only.*BETALOOP_SERVER_USER") as error:
        system_user(unknown)
    assert f"useradd --system {unknown}" in str(error.value)
    assert not exists(unknown)


@pytest.mark.parametrize("name", ["", "Upper", "a b", "-x", "x" * 33, "a/b"])
def test_names_that_no_user_can_have_are_refused(name: str) -> None:
    with pytest.raises(RuntimeError, match="cannot be the name"):
        system_user(name)


def test_root_is_refused() -> None:
    with pytest.raises(RuntimeError, match="does not run as root"):
        system_user("root")


def test_secrets_are_one_for_all_that_start_at_once(tmp_path: Path) -> None:
    code = "from app.settings import get_settings; print(get_settings().secret('signing').hex(), flush=True)"
    keys = at_once(code, [""] * 6, BETALOOP_DATA_DIR=str(tmp_path / "new" / "data"))
    assert len(set(keys)) == 1
    path = tmp_path / "new" / "data" / "secrets" / "signing"
    assert path.read_text() == keys[0]
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    assert [p.name for p in path.parent.iterdir()] == ["signing"]


@pytest.mark.parametrize("content", ["", "not a key", "ab"])
def test_a_damaged_secret_is_refused_and_never_used(tmp_path: Path, content: str) -> None:
    settings = Settings(data_dir=tmp_path)
    settings.secret("signing")
    (tmp_path / "secrets" / "signing").write_text(content)
    with pytest.raises(RuntimeError, match="does not hold a key"):
        settings.secret("signing")


@pytest.mark.slow
def test_two_test_runs_at_once_make_their_template_databases(tmp_path: Path, unknown: str) -> None:
    test = "tests/app/platform/embedded/test_first_start.py::test_the_tests_own_database_works"
    runs = [
        subprocess.Popen(
            [sys.executable, "-m", "pytest", "-q", test, f"--basetemp={tmp_path / name}", "-p", "no:cacheprovider"],
            cwd=ROOT, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT), "BETALOOP_SERVER_USER": unknown},
        )
        for name in ("one", "two")
    ]  # fmt: skip
    for run in runs:
        said = run.communicate(timeout=240)[0]
        assert run.returncode == 0, said
        assert "1 passed" in said
    assert exists(unknown)


def test_the_tests_own_database_works(fresh_database: str) -> None:
    with psycopg.connect(fresh_database.replace("+psycopg", "")) as connection:
        assert connection.execute("select count(*) from participant").fetchone() == (0,)
        assert connection.execute("select rolsuper, rolcreatedb, rolcreaterole from pg_roles where rolname = current_user").fetchone() == (
            False, False, False,
        )  # fmt: skip
