"""Jobs while the store of files is away, and what a job that is repeated takes over."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform import files
from app.platform.bucket import Bucket, StoreAway
from app.platform.database import transaction
from app.platform.jobs import repository, service
from app.platform.jobs.ledger import Ledger
from app.settings import get_settings
from tests.network import Line
from tests.s3_server import NAME, Server

CONTENT = b"a snapshot"
OPEN = "select count(*) from pg_stat_activity where datname = current_database() and state like 'idle in%'"
"""Counts the transactions that wait for something."""


@pytest.fixture
def line(s3_server: Server) -> Iterator[Line]:
    """The way to the S3 server."""
    made = Line(s3_server.port)
    yield made
    made.cut()


@pytest.fixture
def in_bucket(jobs, line: Line, monkeypatch: pytest.MonkeyPatch) -> str:
    """The hash of a file in the bucket, of which this machine has no copy."""
    monkeypatch.setenv("BETALOOP_FILES_URL", f"s3://{NAME}/jobs")
    monkeypatch.setenv("BETALOOP_FILES_ENDPOINT", f"http://127.0.0.1:{line.port}")
    get_settings.cache_clear()
    with transaction("test") as db:
        sha256 = files.store(db, CONTENT).sha256
    files.path_of(sha256).unlink()
    return sha256


def _messages(jobs, *ids):
    return [jobs.get(job_id).message for job_id in ids]


@pytest.mark.slow
def test_jobs_wait_for_a_bucket_that_is_away_and_go_on_when_it_is_back(jobs, in_bucket: str, line: Line) -> None:
    written = jobs.submit("files", sha256=in_bucket, content="before")
    jobs.start_worker(slots=3)
    assert jobs.ended(written).status == "succeeded"
    files.path_of(in_bucket).unlink()
    line.cut()
    writes = jobs.submit("files", sha256=in_bucket, content="meanwhile")
    jobs.wait(lambda: _messages(jobs, writes) == ["write: waits for the store of files"])
    unwanted, reads = jobs.submit("files", sha256=in_bucket, content="unwanted"), jobs.submit("read", sha256=in_bucket)
    jobs.wait(lambda: _messages(jobs, unwanted, reads) == ["write: waits for the store of files", "read: waits for the store of files"])
    with transaction("test") as db:
        service.cancel(db, repository.get(db, unwanted), "test")
    assert jobs.ended(unwanted).status == "cancelled"

    line.restore()
    job = jobs.ended(writes)
    assert (job.status, job.result["size"]) == ("succeeded", len(CONTENT))
    assert job.result["written"] == hashlib.sha256(b"meanwhile").hexdigest()
    assert files.is_whole(job.result["written"])
    assert jobs.ended(reads).status == "succeeded"


def test_a_job_that_is_repeated_takes_over_the_steps_that_had_succeeded(jobs, tmp_path: Path) -> None:
    with transaction("test") as db:
        sha256 = files.store(db, CONTENT).sha256
    needed = tmp_path / "needed"
    jobs.start_worker()
    params = {"sha256": sha256, "needs": str(needed)}
    first = jobs.ended(jobs.submit("files", **params))
    assert (first.status, [s.status for s in first.steps]) == ("failed", ["succeeded", "succeeded", "failed"])
    needed.touch()
    with transaction("test") as db:
        second = service.retry(db, repository.get(db, first.id), "test").id
    job = jobs.ended(second)
    assert (job.status, job.repeats) == ("succeeded", first.id)
    assert job.result["pid"] == first.steps[1].result["pid"], "the child did not run again"
    anew = jobs.ended(jobs.submit("files", **params))
    assert anew.result["pid"] != job.result["pid"], "only a repetition takes over"


def test_a_step_puts_its_files_into_the_bucket_while_no_transaction_is_open(jobs, in_bucket: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ledger = Ledger(jobs.submit("files", sha256=in_bucket, content=""), "test", "worker", lambda: None)
    ledger.open()
    ledger.declare("write", "Write", 1.0)
    real, asked = Bucket.put, []

    def put(store: Bucket, path: Path, sha256: str) -> None:
        with transaction("test") as db:
            asked.append(
                db.scalar(text("select count(*) from pg_stat_activity where datname = current_database() and state like 'idle in%'"))
            )
        if len(asked) == 1:
            raise StoreAway("The store of files does not answer.", "Try again.")
        real(store, path, sha256)

    monkeypatch.setattr(Bucket, "put", put)
    runs: list[int] = []

    def write(db: Session) -> dict[str, str]:
        runs.append(1)
        return {k: files.store(db, k.encode()).sha256 for k in ("a", "b")}

    stored = ledger.commit_step("write", write)
    assert asked == [0, 0, 0], "once in vain, then one for each file"
    assert len(runs) == 2
    assert all(files.is_whole(sha256) for sha256 in stored.values())

    ledger.declare("draw", "Draw", 1.0)
    drawn = ledger.commit_step("draw", lambda db: {"own": files.store(db, os.urandom(8)).sha256})
    assert files.is_whole(drawn["own"]), "bytes that are others at each run are stored all the same"
