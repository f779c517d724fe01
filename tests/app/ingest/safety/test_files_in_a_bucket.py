"""Stored files in a bucket, on a real S3 server: two machines share them, what is encrypted stays so, and every loss is noticed."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform import bucket as buckets
from app.platform import files
from app.platform.upkeep import backup as backups
from app.platform.upkeep.doctor import examine
from app.settings import get_settings
from tests.app.ingest.conftest import steady
from tests.ports import free_port
from tests.s3_server import NAME, Server

SECRET = b"\x00\x01 Jane Example, born 1950 " * 10


@pytest.fixture
def shared(s3_server: Server, fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """A prefix of this test's own in the bucket, which the installation uses."""
    prefix = f"study-{os.urandom(4).hex()}"
    use(monkeypatch, s3_server, prefix)
    return prefix


def use(monkeypatch: pytest.MonkeyPatch, server: Server, prefix: str, data: Path | None = None) -> None:
    monkeypatch.setenv("BETALOOP_FILES_URL", f"s3://{NAME}/{prefix}")
    monkeypatch.setenv("BETALOOP_FILES_ENDPOINT", server.address)
    if data is not None:
        monkeypatch.setenv("BETALOOP_DATA_DIR", str(data))
    get_settings.cache_clear()


def another_machine(monkeypatch: pytest.MonkeyPatch, server: Server, prefix: str, folder: Path) -> Path:
    """Continue as a machine that has the keys and nothing else."""
    shutil.copytree(get_settings().data_dir / "secrets", folder / "secrets")
    use(monkeypatch, server, prefix, folder)
    return folder


def on_this_machine() -> list[Path]:
    return [p for p in get_settings().files_dir.rglob("*") if p.is_file() and p.name != ".lock"]


def hash_read_in_a_child(sha256: str) -> str:
    return hashlib.sha256(files.read(sha256)).hexdigest()


def test_a_file_that_one_machine_stored_is_read_by_another_and_by_its_children(
    send: Any, shared: str, s3_server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, client: TestClient
) -> None:
    answer = send(("t.csv", steady(1)), visit=1, controller="random").json()
    sha256 = answer["files"][0]["stored_sha256"]
    held = s3_server.objects(shared)
    assert hashlib.sha256(held[f"{shared}/files/{sha256[:2]}/{sha256}"]).hexdigest() == sha256
    another_machine(monkeypatch, s3_server, shared, tmp_path / "second")
    assert on_this_machine() == []
    session = answer["sessions"][0]["id"]
    assert client.get(f"/api/v1/sessions/{session}/samples").status_code == 200
    assert hashlib.sha256(files.read(sha256)).hexdigest() == sha256
    assert [p.name for p in on_this_machine()] == [sha256]
    files.path_of(sha256).unlink()
    with multiprocessing.get_context("fork").Pool(1) as pool:  # as compute steps are
        assert pool.apply(hash_read_in_a_child, (sha256,)) == sha256


def test_what_is_damaged_or_missing_in_the_bucket_is_never_believed(shared: str, s3_server: Server, db: Session) -> None:
    sha256 = files.store(db, b"a recording").sha256
    db.commit()
    files.path_of(sha256).unlink()
    key = f"{shared}/files/{sha256[:2]}/{sha256}"
    s3_server.s3.put_object(Bucket=NAME, Key=key, Body=b"b recording")
    with pytest.raises(files.MissingFile, match="damaged"):
        files.read(sha256)
    assert on_this_machine() == []
    found = {f.name: f for f in examine(hashes=True)}["files"]
    assert (found.ok, "1 of 1" in found.detail) == (False, True)
    assert {f.name: f for f in examine()}["files"].ok, "its size is right"
    s3_server.s3.delete_object(Bucket=NAME, Key=key)
    with pytest.raises(files.MissingFile, match="missing"):
        files.read(sha256)
    assert not {f.name: f for f in examine()}["files"].ok


def test_quarantined_bytes_are_encrypted_there_and_gone_everywhere_once_decided(
    send: Any, client: TestClient, shared: str, s3_server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    held = next(f for f in send(("noise.bin", SECRET), ("t.csv", steady(1)), visit=1).json()["files"] if f["quarantined"])
    sealed = held["stored_sha256"]
    assert not any(b"Jane" in content for content in s3_server.objects(shared).values())
    assert sealed not in {p.name for p in on_this_machine()}, "a copy would outlive the decision of another machine"
    another_machine(monkeypatch, s3_server, shared, tmp_path / "second")
    assert client.post(f"/api/v1/uploaded-files/{held['id']}/review").content == SECRET
    assert client.post(f"/api/v1/uploaded-files/{held['id']}/discard", json={"reason": "a letter"}).status_code == 200
    assert not any(sealed in name for name in s3_server.objects(shared))
    assert on_this_machine() == []


def away_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the bucket refuse its first removal."""
    real = buckets.Bucket.remove
    refused: list[str] = []

    def remove(store: buckets.Bucket, sha256: str) -> None:
        if not refused:
            refused.append(sha256)
            raise buckets.StoreAway("The store of files does not answer.", "Try again.")
        real(store, sha256)

    monkeypatch.setattr(buckets.Bucket, "remove", remove)


@pytest.mark.parametrize("how", ["release", "discard"])
def test_what_a_bucket_that_was_away_did_not_remove_is_removed_when_the_decision_is_made_again(
    how: str, send: Any, client: TestClient, shared: str, s3_server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = next(f for f in send(("noise.bin", SECRET), ("t.csv", steady(1)), visit=1).json()["files"] if f["quarantined"])
    path, decision = f"/api/v1/uploaded-files/{held['id']}", {"reason": "no name in it"}
    assert client.post(f"{path}/review").status_code == 200
    decision |= {"how": "as_is"} if how == "release" else {}
    away_once(monkeypatch)
    assert client.post(f"{path}/{how}", json=decision).status_code == 503
    assert any(held["stored_sha256"] in name for name in s3_server.objects(shared))
    assert client.post(f"{path}/{how}", json=decision).status_code == 200
    assert not any(held["stored_sha256"] in name for name in s3_server.objects(shared))
    assert (SECRET in s3_server.objects(shared).values()) == (how == "release")


def test_machines_with_other_keys_do_not_start(shared: str, s3_server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    store = buckets.bucket()
    assert store is not None
    store.check_keys(get_settings())
    store.check_keys(get_settings())
    assert all(get_settings().secret(n).hex().encode() not in s3_server.objects(shared).values() for n in buckets.SHARED_KEYS)
    first = get_settings().data_dir
    use(monkeypatch, s3_server, shared, tmp_path / "second")
    with pytest.raises(RuntimeError, match="is missing, and the other machines"):
        store.check_keys(get_settings())
    shutil.copytree(first / "secrets", tmp_path / "second" / "secrets")
    store.check_keys(get_settings())
    (tmp_path / "second" / "secrets" / "quarantine").write_text("ab" * 32)
    with pytest.raises(RuntimeError, match="is not the key"):
        store.check_keys(get_settings())
    found = {f.name: f for f in examine()}["files"]
    assert (found.ok, "not the key" in found.detail) == (False, True)


def test_every_key_that_machines_must_share_is_checked() -> None:
    from app.planning.bundles.service import KEY
    from app.planning.visit_day.service import _KEY as VISIT_DAY
    from app.platform.audit.chain import SECRET as SEALS

    assert {KEY, SEALS, VISIT_DAY} <= set(buckets.SHARED_KEYS)
    asked = subprocess.run(["grep", "-rhoE", r"\.secret\(\"[a-z-]+\"\)", "app"], capture_output=True, text=True, check=True).stdout
    assert {line.split('"')[1] for line in asked.splitlines()} <= set(buckets.SHARED_KEYS)


def test_a_backup_comes_back_in_another_prefix(
    send: Any, shared: str, s3_server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, db: Session
) -> None:
    send(("noise.bin", SECRET), ("t.csv", steady(1)), visit=1)
    stored = set(db.scalars(text("select sha256 from stored_file")))
    assert len(stored) == 2
    backups.make_key(tmp_path / "key")
    backups.backup(tmp_path / "backup", tmp_path / "key")
    key = backups.read_key(tmp_path / "key")
    with pytest.raises(backups.BackupError, match="holds data already"):
        backups._require_empty(backups.get_engine())
    other = f"{shared}-restored"
    use(monkeypatch, s3_server, other, tmp_path / "new")
    store = buckets.bucket()
    assert store is not None
    assert store.empty()
    backups._restore_keys(tmp_path / "backup" / backups.KEYS, key)
    assert backups._restore_files(tmp_path / "backup" / backups.FILES, key) == 2
    assert not store.empty()
    assert {name.rsplit("/", 1)[-1] for name in s3_server.objects(f"{other}/files")} == stored
    assert all(files.is_whole(sha256) for sha256 in stored)
    assert {f.name: f for f in examine(hashes=True)}["files"].ok


def test_a_bucket_that_is_away_is_said_and_loses_nothing(
    send: Any, client: TestClient, shared: str, s3_server: Server, monkeypatch: pytest.MonkeyPatch, db: Session
) -> None:
    monkeypatch.setenv("BETALOOP_FILES_ENDPOINT", f"http://127.0.0.1:{free_port()}")
    get_settings.cache_clear()
    refused = client.post("/api/v1/uploads", data={"participant": "P1"}, files={"file": ("t.csv", steady(1))})
    assert refused.status_code == 503, refused.text
    assert "store of files" in refused.json()["title"]
    assert on_this_machine() == [], "no draft is left"
    assert db.scalar(text("select count(*) from stored_file")) == 0
    use(monkeypatch, s3_server, shared)
    assert send(("t.csv", steady(1)), visit=1, controller="random").status_code == 201


def test_a_full_disk_here_is_not_taken_for_a_bucket_that_is_away(shared: str, db: Session) -> None:
    sha256, store = files.store(db, bytes(3 << 20)).sha256, buckets.bucket()
    assert store is not None
    with pytest.raises(OSError, match="No space left"):
        store.fetch(sha256, Path("/dev/full"))


def test_copies_that_were_used_longest_ago_make_room(shared: str, db: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = [files.store(db, bytes([k]) * 1000).sha256 for k in range(4)]
    for age, sha256 in enumerate(kept):
        os.utime(files.path_of(sha256), (time.time() - 7200 * age,) * 2)
    monkeypatch.setenv("BETALOOP_FILES_CACHE_GIB", str(1500 / (1 << 30)))
    get_settings.cache_clear()
    assert buckets.prune_copies() == 3
    assert [p.name for p in on_this_machine()] == kept[:1]
    assert all(files.read(sha256) == bytes([k]) * 1000 for k, sha256 in enumerate(kept)), "they are in the bucket"
    assert buckets.prune_copies() == 0, "used within the last hour"


def test_files_of_before_there_was_a_bucket_are_no_copies(shared: str, db: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    sha256 = files.store(db, b"made before" * 100).sha256
    os.utime(files.path_of(sha256), (time.time() - 7200,) * 2)
    store = buckets.bucket()
    assert store is not None
    store.remove(sha256)
    monkeypatch.setenv("BETALOOP_FILES_CACHE_GIB", str(1 / (1 << 30)))
    get_settings.cache_clear()
    assert buckets.prune_copies() == 0
    assert [p.name for p in on_this_machine()] == [sha256]


def test_a_large_file_arrives_whole(shared: str, db: Session) -> None:
    content = os.urandom(1 << 20) * 70  # more than one part
    row = files.store(db, content)
    files.path_of(row.sha256).unlink()
    assert files.read(row.sha256) == content


def test_an_address_that_is_no_bucket_is_refused_in_words(fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BETALOOP_FILES_URL", "/srv/files")
    get_settings.cache_clear()
    with pytest.raises(RuntimeError, match="give s3://BUCKET"):
        buckets.bucket()
    get_settings.cache_clear()
