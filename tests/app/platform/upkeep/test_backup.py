"""A backup of a filled study comes back in a new data folder and in another PostgreSQL; the doctor says what is missing."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import psycopg
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import create_engine, inspect, text
from sqlalchemy.orm import Session

from app import main
from app.platform.audit.chain import seal
from app.platform.database import transaction
from app.platform.embedded.server import EmbeddedPostgres
from app.platform.embedded.system_user import system_user
from app.platform.files import path_of
from app.platform.upkeep import backup as backups
from app.platform.upkeep.backup import BackupError
from app.platform.upkeep.doctor import examine
from app.platform.upkeep.migrate import newest_revision
from app.platform.upkeep.sealing import SealedReader
from app.settings import get_settings

ROOT = Path(__file__).resolve().parents[4]
TABLE_BYTES = b"t_s,beta,amplitude_fraction\n" + b"".join(b"%d,1,1\n" % (2 * k) for k in range(21))


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that the server's user may pass through."""
    folder = Path("/tmp") / f"betaloop-backup-{os.getpid()}-{os.urandom(4).hex()}"
    folder.mkdir()
    folder.chmod(0o711)
    yield folder
    for data in folder.glob("*/postgres"):
        EmbeddedPostgres(data, server_user=get_settings().server_user).remove()
    shutil.rmtree(folder)


@pytest.fixture
def filled(client: TestClient, participant_code: str) -> dict[str, int]:
    """A study with a participant, a visit, an uploaded session; rows of its tables."""
    sent = client.post(
        "/api/v1/uploads",
        files={"file": ("session.csv", TABLE_BYTES)},
        data={"participant": participant_code, "visit": "1", "controller": "random", "started_at": "2026-03-02T10:00:00Z"},
    )
    assert sent.status_code == 201, sent.text
    with transaction("test") as db:
        seal(db)  # a backup seals the trail first
    return rows()


def rows() -> dict[str, int]:
    return backups._rows(backups.get_engine())


def betaloop(data: Path, *arguments: str, database_url: str = "") -> subprocess.CompletedProcess[str]:
    env = {k: v for k, v in os.environ.items() if not k.startswith("BETALOOP_") or k == "BETALOOP_SERVER_USER"}
    env |= {"BETALOOP_DATA_DIR": str(data), "PYTHONPATH": str(ROOT)}
    if database_url:
        env["BETALOOP_DATABASE_URL"] = database_url
    return subprocess.run([sys.executable, "-m", "app.cli", *arguments], env=env, capture_output=True, text=True, check=False, cwd=data)


def made(place: Path) -> tuple[Path, Path]:
    """Make a backup of the test's installation, and its key."""
    key = place / "key"
    backups.make_key(key)
    backups.backup(place / "backup", key)
    return place / "backup", key


@pytest.mark.slow
def test_a_backup_comes_back_in_a_new_data_folder(place: Path, filled: dict[str, int]) -> None:
    folder, key = made(place)
    for part in folder.iterdir():
        assert b"t_s,beta" not in part.read_bytes()
    new = place / "new"
    new.mkdir()
    done = betaloop(new, "restore", str(folder), "--key-file", str(key), "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["rows"] == filled
    assert filled["session"] == 1
    assert json.loads(done.stdout)["files"] == filled["stored_file"] > 0
    doctor = betaloop(new, "doctor", "--hashes", "--json")
    assert doctor.returncode == 0, doctor.stdout + doctor.stderr
    trail = json.loads(betaloop(new, "audit", "verify", "--json").stdout)
    assert trail["whole"]
    assert 0 < trail["sealed_to"] <= trail["links"]
    again = betaloop(new, "restore", str(folder), "--key-file", str(key))
    assert again.returncode == 1
    assert "holds data already" in again.stderr


@pytest.mark.parametrize("damaged", [False, True])
def test_a_backup_comes_back_in_another_postgresql(place: Path, filled: dict[str, int], server: EmbeddedPostgres, damaged: bool) -> None:
    """Also one that was made around a damaged file, which is named; every other row and file comes back."""
    with transaction("test") as db:
        first = db.connection().exec_driver_sql("select sha256 from stored_file order by sha256 limit 1").scalar_one()
    if damaged:
        path_of(first).write_bytes(b"other bytes")
    folder, key = made(place)
    with psycopg.connect(server.admin_conninfo(), autocommit=True) as connection:
        connection.execute("drop database if exists restored with (force)")
        connection.execute("create database restored owner betaloop")
    new = place / "new"
    new.mkdir()
    url = server.owner_url("restored").replace("+psycopg", "")
    try:
        done = betaloop(new, "restore", str(folder), "--key-file", str(key), "--json", database_url=url)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["rows"] == filled
        assert json.loads(done.stdout)["damaged"] == ([first] if damaged else [])
        assert json.loads(done.stdout)["files"] == filled["stored_file"] - damaged
        assert not (new / "postgres").exists()
    finally:
        with psycopg.connect(server.admin_conninfo(), autocommit=True) as connection:
            connection.execute("drop database restored with (force)")


@pytest.fixture
def older_server(place: Path) -> Iterator[str]:
    """URL of an empty database of the machine's own PostgreSQL, which is older than the embedded one."""
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    if not programs:
        pytest.skip("no PostgreSQL of the machine's own here (/usr/lib/postgresql)")
    user = system_user(get_settings().server_user) if os.geteuid() == 0 else None
    data = place / "older"
    data.mkdir(mode=0o700)
    if user:
        os.chown(data, user.uid, user.gid)

    def run(name: str, *arguments: str) -> None:
        who = {"user": user.uid, "group": user.gid, "extra_groups": []} if user else {}
        with (place / "older.log").open("ab") as log:
            subprocess.run([str(programs[0] / name), *arguments], stdout=log, stderr=log, cwd="/", check=True, **who)

    run("initdb", "--auth=trust", "--encoding=utf8", "--locale=C.UTF-8", "-U", "betaloop", "-D", str(data / "db"))
    run("pg_ctl", "-D", str(data / "db"), "-w", "-l", str(data / "log"), "-o", f"-h '' -k {data}", "start")
    try:
        with psycopg.connect(f"host={data} user=betaloop dbname=postgres", autocommit=True) as connection:
            assert connection.info.server_version < 180000
            connection.execute("create database restored")
        yield f"postgresql://betaloop@/restored?host={data}"
    finally:
        run("pg_ctl", "-D", str(data / "db"), "-m", "immediate", "-w", "stop")


@pytest.mark.slow
def test_a_backup_comes_back_in_an_older_postgresql_of_another_make(place: Path, filled: dict[str, int], older_server: str) -> None:
    folder, key = made(place)
    new = place / "new"
    new.mkdir()
    done = betaloop(new, "restore", str(folder), "--key-file", str(key), "--json", database_url=older_server)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["rows"] == filled


@pytest.mark.parametrize("part", ["database.sealed", "files.sealed", "keys.sealed", "manifest.json"])
def test_a_damaged_backup_is_refused_before_anything_is_written(place: Path, filled: dict[str, int], part: str) -> None:
    folder, key = made(place)
    content = (folder / part).read_bytes()
    (folder / part).write_bytes(content[:-3])
    with pytest.raises(BackupError, match="missing or damaged"):
        backups.restore(folder, key)
    assert rows() == filled


def test_a_restore_that_breaks_off_leaves_no_half_of_the_database(
    place: Path, filled: dict[str, int], server: EmbeddedPostgres, monkeypatch: pytest.MonkeyPatch
) -> None:
    """psql commits at the end of its input: an archive that breaks off in the middle must not look like one that ends."""
    folder, key = made(place)
    with psycopg.connect(server.admin_conninfo(), autocommit=True) as connection:
        connection.execute("drop database if exists restored with (force)")
        connection.execute("create database restored owner betaloop")
    engine = create_engine(server.owner_url("restored"))
    monkeypatch.setattr(backups, "get_engine", lambda: engine)
    monkeypatch.setattr(backups, "owner_url", lambda: server.owner_url("restored"))

    def breaks_off(lines: Iterator[bytes], known: frozenset[str]) -> Iterator[bytes]:
        for line in whole(lines, known):
            yield line
            if line.startswith(b"COPY public.visit "):
                broken.append(1)
                next(p for p in psutil.Process().children() if p.name() == "pg_restore").kill()
                return

    whole, broken = backups._for_server, []
    monkeypatch.setattr(backups, "_for_server", breaks_off)
    try:
        with pytest.raises(BackupError, match="cannot be restored"), (folder / "database.sealed").open("rb") as source:
            backups._load(SealedReader(source, backups.read_key(key)))
        assert broken
        assert inspect(engine).get_table_names() == []
    finally:
        engine.dispose()
        with psycopg.connect(server.admin_conninfo(), autocommit=True) as connection:
            connection.execute("drop database restored with (force)")
    assert filled


def test_settings_that_a_server_lacks_are_left_out_and_rows_are_not() -> None:
    dump = [b"SET old = 1;\n", b"SET new = 2;\n", b"COPY public.note (text) FROM stdin;\n", b"SET new = 2;\n", b"\\.\n"]
    assert list(backups._for_server(iter(dump), frozenset({"old"}))) == [dump[0], *dump[2:]]


def test_a_key_beside_what_it_protects_is_refused(place: Path, filled: dict[str, int]) -> None:
    inside = get_settings().data_dir / "backup.key"
    backups.make_key(inside)
    try:
        with pytest.raises(BackupError, match="next to what it protects"):
            backups.backup(place / "backup", inside)
    finally:
        inside.unlink()
    assert not (place / "backup").exists()
    assert filled


def test_neither_a_key_nor_a_backup_is_overwritten(place: Path, filled: dict[str, int]) -> None:
    folder, key = made(place)
    with pytest.raises(BackupError, match="exists already"):
        backups.make_key(key)
    with pytest.raises(BackupError, match="exists already"):
        backups.backup(folder, key)
    assert filled


def test_the_doctor_finds_what_is_missing_damaged_or_standing_open(filled: dict[str, int]) -> None:
    assert [f.name for f in examine(hashes=True) if not f.ok] == []
    with transaction("test") as db:
        first = db.connection().exec_driver_sql("select sha256 from stored_file order by sha256 limit 1").scalar_one()
    path = path_of(first)
    content = path.read_bytes()
    path.write_bytes(bytes([content[0] ^ 1]) + content[1:])
    assert [f.name for f in examine() if not f.ok] == []  # its size is right: that is all that was asked
    assert [f.name for f in examine(hashes=True) if not f.ok] == ["files"]
    path.unlink()
    missing = next(f for f in examine() if not f.ok)
    assert first in missing.detail
    assert "backup" in missing.hint
    path.write_bytes(content)
    get_settings().files_dir.chmod(0o755)
    assert [f.name for f in examine() if not f.ok] == ["folders"]
    assert filled


def test_the_service_is_ready_with_the_right_schema_alone(client: TestClient, owner_db: Session) -> None:
    ready = client.get("/readyz")
    assert ready.json() == {"status": "ready", "schema": newest_revision()}
    owner_db.execute(text("update alembic_version set version_num = '0001'"))
    owner_db.commit()
    stale = TestClient(main.create_app()).get("/readyz")
    assert stale.status_code == 503
    assert "betaloop migrate" in stale.json()["hint"]
    assert [f.name for f in examine() if not f.ok] == ["database"]
