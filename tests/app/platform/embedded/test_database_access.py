"""Access to the embedded database and the stored files: the service, and no other user of the machine."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from sqlalchemy.orm import Session

from app.platform import files
from app.platform.database import get_engine
from app.platform.embedded.server import EmbeddedPostgres
from app.platform.embedded.system_user import system_user
from app.platform.service_role import excess
from app.platform.upkeep.migrate import migrate
from app.settings import get_settings
from tests.system_users import require_root

NOBODY = 65534
ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture
def data(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty data folder in which every user may look around, and which the settings name."""
    folder = Path("/tmp") / f"betaloop-access-{os.getpid()}-{os.urandom(4).hex()}"
    folder.mkdir()
    folder.chmod(0o755)
    monkeypatch.delenv("BETALOOP_DATABASE_URL", raising=False)
    monkeypatch.setenv("BETALOOP_DATA_DIR", str(folder))
    get_settings.cache_clear()
    yield folder
    get_settings.cache_clear()
    EmbeddedPostgres(folder / "postgres", server_user=get_settings().server_user).remove()
    shutil.rmtree(folder)


def server_of(data: Path) -> EmbeddedPostgres:
    return EmbeddedPostgres(data / "postgres", durable=False, server_user=get_settings().server_user)


def test_no_other_user_gets_into_the_database(data: Path) -> None:
    require_root("only root can try as another user")
    server = server_of(data)
    server.start()
    service = server.url("betaloop").replace("+psycopg", "")
    psycopg.connect(service).close()
    for conninfo in (f"host={server._sockets} user=postgres dbname=postgres", server.admin_conninfo(), service):
        assert "Permission denied" in said_to(NOBODY, conninfo)
    assert server.data.stat().st_uid == system_user(get_settings().server_user).uid


def said_to(uid: int, conninfo: str) -> str:
    """Connect as another user of the machine and return the answer; forked, for that user need not be able to start our Python."""
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:
        os.setgroups([])
        os.setgid(uid)
        os.setuid(uid)
        try:
            psycopg.connect(conninfo)
            os.write(writer, b"connected")
        except psycopg.OperationalError as error:
            os.write(writer, str(error).encode())
        finally:
            os._exit(0)
    os.close(writer)
    with open(reader) as answer:
        said = answer.read()
    os.waitpid(child, 0)
    return said


def test_without_a_password_nobody_gets_in(data: Path) -> None:
    server = server_of(data)
    server.start()
    for user in ("postgres", "betaloop", "betaloop_service"):
        with pytest.raises(psycopg.OperationalError, match="password"):
            psycopg.connect(f"host={server._sockets} user={user} dbname=betaloop")
        with pytest.raises(psycopg.OperationalError, match="password authentication failed"):
            psycopg.connect(f"host={server._sockets} user={user} dbname=betaloop password=guessed")


def test_the_service_is_no_superuser_and_can_migrate(data: Path) -> None:
    migrate()
    with get_engine().connect() as connection:
        rights = "select rolsuper, rolcreaterole, rolcreatedb, rolbypassrls, rolreplication from pg_roles where rolname = current_user"
        assert connection.exec_driver_sql(rights).fetchone() == (False,) * 5
        owners = "select distinct tableowner from pg_tables where schemaname in ('public', 'dbos')"
        assert connection.exec_driver_sql(owners).scalars().all() == ["betaloop"]
        assert connection.exec_driver_sql("select current_user").scalar() == "betaloop_service"
        assert excess(connection) == []
    get_engine().dispose()


def test_lost_secrets_are_made_anew_by_the_owner_of_the_data_folder(data: Path) -> None:
    server = server_of(data)
    server.start()
    old = server.url("betaloop")
    server.leave()
    shutil.rmtree(data / "secrets")
    again = server_of(data)
    again.start()
    assert again.url("betaloop") != old
    with psycopg.connect(again.url("betaloop").replace("+psycopg", "")) as connection:
        assert connection.execute("select 1").fetchone() == (1,)
    with pytest.raises(psycopg.OperationalError, match="password"):
        psycopg.connect(old.replace("+psycopg", ""))
    again.leave()


def test_stored_files_are_the_services_alone(db: Session) -> None:
    row = files.store(db, b"a recording")
    path = files.path_of(row.sha256)
    assert path.stat().st_mode & 0o777 == 0o600
    for folder in (path.parent, path.parent.parent, path.parent.parent / "incoming"):
        assert folder.stat().st_mode & 0o777 == 0o700


def test_stored_files_that_stand_open_are_closed_when_the_service_migrates(db: Session) -> None:
    path = files.path_of(files.store(db, b"a recording").sha256)
    db.rollback()
    open_to_all = {path: 0o644, path.parent: 0o755, path.parent.parent: 0o755}
    for each, mode in open_to_all.items():
        each.chmod(mode)
    migrate()
    assert [each.stat().st_mode & 0o777 for each in open_to_all] == [0o600, 0o700, 0o700]
