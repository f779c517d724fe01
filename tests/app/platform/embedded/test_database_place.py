"""Place of the embedded database: chosen once, recorded, and never changed in silence."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from typer.testing import CliRunner

from app.cli import app as command_line
from app.platform.embedded import place
from app.platform.embedded.server import EmbeddedPostgres
from app.settings import get_settings
from tests.system_users import require_root


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A data folder that the server's user may enter; `home` above it can be closed."""
    require_root("only root has a server's user that may not enter a folder")
    base = Path("/tmp") / f"betaloop-place-{os.getpid()}-{os.urandom(4).hex()}"
    data = base / "home" / "data"
    data.mkdir(parents=True)
    for path in (base, base / "home", data):
        path.chmod(0o755)
    yield data
    (base / "home").chmod(0o755)
    if data.exists():
        server_of(data).remove()
    shutil.rmtree(base)


def server_of(data: Path) -> EmbeddedPostgres:
    return EmbeddedPostgres(data / "postgres", durable=False, server_user=get_settings().server_user)


def tables(server: EmbeddedPostgres) -> list[str]:
    with psycopg.connect(server.owner_url("betaloop").replace("+psycopg", "")) as connection:
        rows = connection.execute("select tablename from pg_tables where schemaname = 'public'").fetchall()
    return [row[0] for row in rows]


def started_with(data: Path, table: str | None = None) -> Path:
    """Start, make a table, stop; where the data lie."""
    server = server_of(data)
    server.start()
    if table:
        with psycopg.connect(server.owner_url("betaloop").replace("+psycopg", "")) as connection:
            connection.execute(f"create table {table} (n int)")
    server.leave()
    return server.data


def test_a_folder_that_was_closed_later_is_an_error_and_no_second_database(folder: Path) -> None:
    assert started_with(folder, "study") == folder / "postgres"
    before = set(place.SYSTEM_FOLDER.iterdir()) if place.SYSTEM_FOLDER.exists() else set()
    folder.parent.chmod(0o700)
    with pytest.raises(RuntimeError, match=r"can no longer get there.*mode 700.*chmod o\+x") as error:
        server_of(folder).start()
    assert f"chmod o+x {folder.parent}." in str(error.value)
    assert set(place.SYSTEM_FOLDER.iterdir() if place.SYSTEM_FOLDER.exists() else []) == before
    folder.parent.chmod(0o711)
    server = server_of(folder)
    server.start()
    assert tables(server) == ["study"]
    server.leave()


def test_a_place_outside_is_kept_when_the_folder_is_opened_later(folder: Path) -> None:
    folder.parent.chmod(0o700)
    outside = started_with(folder, "study")
    assert outside.is_relative_to(place.SYSTEM_FOLDER)
    folder.parent.chmod(0o755)
    assert started_with(folder) == outside
    assert not (folder / "postgres").exists()


def test_a_data_folder_in_place_may_be_moved_as_a_whole(folder: Path) -> None:
    started_with(folder, "study")
    moved = folder.rename(folder.with_name("elsewhere"))
    server = server_of(moved)
    server.start()
    try:
        assert server.data == moved / "postgres"
        assert tables(server) == ["study"]
    finally:
        server.remove()


def test_a_database_that_is_gone_is_an_error_and_not_an_empty_one(folder: Path) -> None:
    folder.parent.chmod(0o700)
    outside = started_with(folder)
    shutil.rmtree(outside)
    with pytest.raises(RuntimeError, match=r"is not there any more.*backup"):
        server_of(folder).start()
    assert not outside.exists()


def test_two_databases_for_one_folder_are_refused(folder: Path) -> None:
    started_with(folder)
    other = folder.with_name("other")
    shutil.copytree(folder / "postgres", other)
    place.record_path(folder / "postgres").write_text(f"{other}\n")
    with pytest.raises(RuntimeError, match="two databases"):
        server_of(folder).start()
    place.record_path(folder / "postgres").write_text("postgres\n")


def test_a_database_of_another_user_is_explained(folder: Path) -> None:
    data = started_with(folder)
    owner = data.stat()
    os.chown(data, 4242, 4242)
    with pytest.raises(RuntimeError, match=r"number 4242.*chown"):
        server_of(folder).start()
    os.chown(data, owner.st_uid, owner.st_gid)


@pytest.mark.slow
def test_a_data_folder_made_anew_does_not_find_the_old_rows(folder: Path) -> None:
    folder.parent.chmod(0o700)
    outside = started_with(folder, "study")
    shutil.rmtree(folder)
    folder.mkdir()
    server = server_of(folder)
    server.start()
    assert server.data == outside
    assert tables(server) == []
    server.leave()


def test_stored_files_without_a_record_are_not_given_an_empty_database(folder: Path) -> None:
    folder.parent.chmod(0o700)
    outside = started_with(folder, "study")
    (folder / "files").mkdir()
    place.record_path(folder / "postgres").unlink()
    with pytest.raises(RuntimeError, match="belong together") as error:
        server_of(folder).start()
    assert f"echo {outside} > " in str(error.value)
    place.record(folder / "postgres", outside)
    assert started_with(folder) == outside


def test_an_interrupted_first_start_leaves_no_half_of_a_database(folder: Path) -> None:
    draft = folder / "postgres.new"
    draft.mkdir()
    (draft / "PG_VERSION").write_text("18\n")
    assert started_with(folder) == folder / "postgres"
    assert not draft.exists()


def test_where_tells_the_place(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BETALOOP_DATA_DIR", str(folder))
    monkeypatch.delenv("BETALOOP_DATABASE_URL", raising=False)
    folder.parent.chmod(0o700)
    outside = started_with(folder)
    get_settings.cache_clear()
    try:
        said = CliRunner().invoke(command_line, ["where"]).output
        monkeypatch.setenv("BETALOOP_DATABASE_URL", "postgresql://betaloop:very-secret@db.example/betaloop")
        get_settings.cache_clear()
        own = CliRunner().invoke(command_line, ["where", "--json"]).output
        monkeypatch.setenv("BETALOOP_FILES_URL", "s3://clinic/study")
        monkeypatch.setenv("BETALOOP_FILES_ENDPOINT", "https://s3.example")
        get_settings.cache_clear()
        in_a_bucket = CliRunner().invoke(command_line, ["where"]).output
    finally:
        get_settings.cache_clear()
    assert f"database: {outside}\n" in said
    assert f"keys: {folder / 'secrets'}" in said
    assert "db.example" in own
    assert "files: s3://clinic/study at https://s3.example\n" in in_a_bucket
    assert "very-secret" not in own
