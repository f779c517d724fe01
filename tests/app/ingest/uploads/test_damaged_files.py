"""A stored file that is missing or damaged comes back with its original bytes; a backup goes on around it, and names it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app import cli
from app.accounts.permissions import SYSTEM
from app.ingest.sessions import StatedSession
from app.ingest.uploads import reading, receiving, service
from app.ingest.uploads.incoming import Incoming
from app.ingest.uploads.interrupted import resume
from app.ingest.wording import MADE_ANEW
from app.platform import files
from app.platform.database import new_session
from app.platform.upkeep import backup as backups
from app.platform.upkeep.doctor import examine
from app.settings import get_settings
from app.study import repository as study
from tests.app.every_route import TABLE


class Stopped(BaseException):
    """The process ends here."""


DAMAGES = ("changed", "missing", "unreadable")


def damage(sha256: str, how: str) -> None:
    path = files.path_of(sha256)
    content = path.read_bytes()
    path.unlink()
    if how == "changed":
        path.write_bytes(bytes([content[0] ^ 1]) + content[1:])
    if how == "unreadable":
        path.mkdir()  # opens, and gives no bytes: as a file on a bad disk


def send(client: TestClient, participant: str, name: str, content: bytes, **stated: str) -> dict[str, Any]:
    answer = client.post("/api/v1/uploads", data={"participant": participant, **stated}, files={"file": (name, content)})
    assert answer.status_code in (200, 201), answer.text
    (file,) = answer.json()["files"]
    return dict(file) | {"told": answer.text}


def send_unreadable(client: TestClient, participant: str) -> None:
    file = {"file": ("x.csv", b"no recording at all")}
    assert client.post("/api/v1/uploads", data={"participant": participant}, files=file).status_code == 422


@pytest.mark.parametrize("how", ["changed", "missing"])
def test_the_same_bytes_sent_again_take_the_place_of_a_damaged_file(client: TestClient, participant_code: str, how: str) -> None:
    first = send(client, participant_code, "s.csv", TABLE, visit="1", controller="random")
    whole = files.read(first["stored_sha256"])
    assert MADE_ANEW not in send(client, participant_code, "s.csv", TABLE)["told"]
    damage(first["stored_sha256"], how)
    again = send(client, participant_code, "s.csv", TABLE)
    assert again["duplicate"]
    assert MADE_ANEW in again["told"]
    assert files.read(again["stored_sha256"]) == whole
    assert MADE_ANEW not in send(client, participant_code, "s.csv", TABLE)["told"]


def test_a_damaged_file_in_quarantine_comes_back_encrypted(client: TestClient, participant_code: str, db: Session) -> None:
    sealed = text("select quarantine_sha256 from upload_file")
    send_unreadable(client, participant_code)
    before = db.scalar(sealed)
    assert before is not None
    damage(before, "changed")
    send_unreadable(client, participant_code)
    db.rollback()
    (after,) = db.scalars(sealed).all()
    assert files.is_whole(after)
    assert b"no recording" not in files.read(after)
    assert db.scalars(text("select sha256 from stored_file")).all() == [after], "nothing that is damaged is left for `doctor` to find"


def test_a_file_that_is_cleaned_otherwise_today_leaves_nothing_damaged_behind(
    client: TestClient, participant_code: str, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = send(client, participant_code, "s.csv", TABLE, visit="1", controller="random")
    damage(first["stored_sha256"], "changed")
    real = reading.clean

    def newer(raw: Any, clean: Path, *args: Any) -> Any:
        found = real(raw, clean, *args)
        clean.write_bytes(clean.read_bytes() + b"\n")
        return found

    monkeypatch.setattr(reading, "clean", newer)
    monkeypatch.setattr(receiving, "REDACTOR_VERSION", 99)
    again = send(client, participant_code, "s.csv", TABLE)
    assert MADE_ANEW in again["told"]
    assert again["stored_sha256"] != first["stored_sha256"]
    assert files.is_whole(again["stored_sha256"])
    assert db.scalars(text("select redactor_version from upload_file")).all() == [99]
    assert [f for f in examine(hashes=True) if f.name == "files" and not f.ok] == []
    assert not files.path_of(first["stored_sha256"]).exists()


@pytest.mark.parametrize("stopped", ["before they go", "after they went"])
@pytest.mark.parametrize("first_is", ["whole", "changed"])
def test_a_stop_while_bytes_of_no_use_come_again_leaves_nothing_that_nobody_names(
    client: TestClient, participant_code: str, db: Session, monkeypatch: pytest.MonkeyPatch, first_is: str, stopped: str
) -> None:
    send_unreadable(client, participant_code)
    sealed = text("select quarantine_sha256 from upload_file")
    (before,) = db.scalars(sealed).all()
    if first_is != "whole":
        damage(before, first_is)
    real = files.remove

    def stop(sha256: str) -> None:
        if stopped == "after they went":
            real(sha256)
        raise Stopped

    with monkeypatch.context() as patch, new_session() as dying:
        patch.setattr(files, "remove", stop)
        mine = study.participant_by_code(dying, participant_code, SYSTEM)
        with pytest.raises(Stopped):
            service.receive(dying, mine, StatedSession(), [Incoming("x.csv", io.BytesIO(b"no recording at all"))], SYSTEM)
    assert [taken.done for taken in resume("test")] == [True]
    db.rollback()
    (after,) = db.scalars(sealed).all()
    assert files.is_whole(after)
    assert db.scalars(text("select sha256 from stored_file")).all() == [after]
    kept = [path for path in get_settings().files_dir.rglob("*") if path.is_file() and "incoming" not in path.parts]
    assert kept == [files.path_of(after)]


def test_the_doctor_names_what_needs_a_damaged_file_and_how_it_comes_back(client: TestClient, participant_code: str) -> None:
    first = send(client, participant_code, "s.csv", TABLE, visit="1", controller="random")
    damage(first["stored_sha256"], "missing")
    (found,) = [f for f in examine() if f.name == "files"]
    assert f"needed by upload file {first['id']})" in found.detail
    assert "uploaded once more" in found.hint
    assert "betaloop restore" in found.hint
    send(client, participant_code, "s.csv", TABLE)
    assert [f.ok for f in examine(hashes=True) if f.name == "files"] == [True]


def test_bytes_that_are_kept_a_second_time_replace_damaged_ones(db: Session) -> None:
    sha256 = files.store(db, b"as it was").sha256
    damage(sha256, "changed")
    with pytest.raises(files.MissingFile):
        files.read(sha256)
    assert files.store(db, b"as it was").sha256 == sha256
    assert files.read(sha256) == b"as it was"


@pytest.mark.parametrize("how", DAMAGES)
def test_a_backup_goes_on_around_a_damaged_file_and_names_it(client: TestClient, participant_code: str, tmp_path: Path, how: str) -> None:
    good = send(client, participant_code, "a.csv", TABLE, visit="1", controller="random")["stored_sha256"]
    bad = send(client, participant_code, "b.csv", TABLE + b"42,1,1\n", visit="1", controller="random")["stored_sha256"]
    damage(bad, how)
    key = tmp_path / "key"
    backups.make_key(key)
    done = CliRunner().invoke(cli.app, ["backup", str(tmp_path / "backup"), "--key-file", str(key)])
    assert done.exit_code == 1
    assert bad in done.output
    assert good not in done.output
    manifest = backups.verify(tmp_path / "backup")
    assert (manifest["damaged"], manifest["removed"], manifest["files"]) == ([bad], [], 1)
