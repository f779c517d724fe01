"""Place of the tests' databases: in memory where there is room, and nothing of a killed run stays there."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import psycopg
import pytest

import tests.conftest as suite
from app.platform.embedded.server import EmbeddedPostgres
from app.settings import get_settings


def test_databases_lie_in_memory_where_there_is_room(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(suite, "ROOM_IN_MEMORY", 1)
    folder = suite.database_folder(tmp_path_factory, tmp_path)
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o777 == 0o711
    monkeypatch.setattr(suite, "ROOM_IN_MEMORY", 1 << 60)
    assert suite.database_folder(tmp_path_factory, tmp_path).parent != tmp_path
    assert suite.database_folder(tmp_path_factory, tmp_path / "nowhere").is_dir()


def test_what_a_killed_run_left_in_memory_goes(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(suite, "ROOM_IN_MEMORY", 1)
    ended = subprocess.Popen(["true"])
    ended.wait()
    left, used = (tmp_path / f"betaloop-tests-{pid}-x" for pid in (ended.pid, os.getpid()))
    for folder in (left, used):
        (folder / "postgres").mkdir(parents=True)
    suite.database_folder(tmp_path_factory, tmp_path)
    assert not left.exists()
    assert used.exists()


def test_a_study_whose_making_was_cut_short_is_made_anew_and_leaves_nothing(
    server: EmbeddedPostgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def databases() -> set[str]:
        with psycopg.connect(server.admin_conninfo()) as connection:
            return {name for (name,) in connection.execute("select datname from pg_database")}

    before, settings = databases(), get_settings()
    with pytest.raises(ZeroDivisionError), suite.own_database(server, tmp_path / "data", monkeypatch, "betaloop", keep="cut_short"):
        _ = 1 / 0
    assert databases() == before
    assert get_settings() is not settings, "nothing goes on with the settings of a database that is gone"
    for _ in range(2):
        with suite.own_database(server, tmp_path / "data", monkeypatch, "betaloop", keep="cut_short"):
            pass
        assert databases() == before | {"cut_short"}
    suite.drop_database(server, "cut_short")
