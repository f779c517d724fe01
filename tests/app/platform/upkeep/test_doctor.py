"""Findings of `betaloop doctor` on jobs, disk and clock, and its exit code for timers; files and folders are in test_backup."""

from __future__ import annotations

import json
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel
from sqlalchemy import text
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.cli import app as command_line
from app.platform.database import now, transaction
from app.platform.jobs import JobKind, engine, register, registry, service
from app.platform.jobs.service import STALE_S
from app.platform.upkeep import doctor
from app.settings import get_settings
from app.tables.jobs import Worker
from tests.app.platform.upkeep.small_disks import small_disk
from tests.conftest import close_connections


def found(exit_code: int) -> dict[str, dict[str, Any]]:
    """Run the command and return each check by its name; it must end with this exit code."""
    done = CliRunner().invoke(command_line, ["doctor", "--json"])
    assert done.exit_code == exit_code, done.output
    return {finding["name"]: finding for finding in json.loads(done.output)}


def not_in_order(findings: dict[str, dict[str, Any]]) -> list[str]:
    return [name for name, finding in findings.items() if not finding["ok"]]


def test_all_is_well_with_exit_code_0(fresh_database: str) -> None:
    findings = found(exit_code=0)
    assert list(findings) == ["disk", "folders", "database", "database role", "clock", "files", "jobs"]
    assert not_in_order(findings) == []
    assert all(finding["detail"] and not finding["hint"] for finding in findings.values())


def test_the_exit_code_is_1_and_the_lines_say_what_is_wrong(fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "LEAST_FREE_MB", 10**9)
    done = CliRunner().invoke(command_line, ["doctor"])
    assert done.exit_code == 1
    wrong = [line for line in done.output.splitlines() if line.startswith("FAIL")]
    assert len(wrong) == 1
    assert wrong[0].startswith("FAIL disk: ")
    assert "Make room: uploads need at least 1000000000 MiB." in wrong[0]


def test_a_disk_that_is_nearly_full_is_found(fresh_database: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with small_disk(tmp_path / "small", "8m") as disk:
        monkeypatch.setenv("BETALOOP_DATA_DIR", str(disk / "not made yet"))
        get_settings.cache_clear()
        findings = found(exit_code=1)
    assert not_in_order(findings) == ["disk"]
    assert findings["disk"]["detail"] == "8 MiB free"
    assert "Make room" in findings["disk"]["hint"]


class Nothing(BaseModel):
    """Asked for of the job that waits."""


def submitted(monkeypatch: pytest.MonkeyPatch) -> str:
    """Submit a job that waits for a worker."""
    monkeypatch.setattr(registry, "_kinds", dict(registry.kinds()))
    register(JobKind(name="wait", title="Wait", params=Nothing, orchestration="nowhere:never"))
    with transaction("test") as db:
        return service.submit(db, "wait", None, {}, "test").id


def seen(ago_s: float) -> None:
    """Store a worker that gave its last sign of life so long ago."""
    with transaction("test") as db:
        moment = now() - timedelta(seconds=ago_s)
        db.merge(Worker(id="one", pid=1, host="here", protocol=engine.PROTOCOL, code_version="x", started_at=moment, seen_at=moment))


def test_jobs_that_nobody_works_on_are_found(fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    submitted(monkeypatch)
    stuck = found(exit_code=1)
    assert not_in_order(stuck) == ["jobs"]
    assert stuck["jobs"]["detail"] == "1 waiting or running, 0 live workers"
    assert "betaloop worker" in stuck["jobs"]["hint"]
    seen(ago_s=0)
    assert found(exit_code=0)["jobs"]["detail"] == "1 waiting or running, 1 live workers"
    seen(ago_s=STALE_S + 60)
    assert not_in_order(found(exit_code=1)) == ["jobs"], "a worker that gives no sign of life is none"


def test_jobs_that_need_a_newer_worker_are_found_and_the_command_mends_it(fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as newer:
        newer.setattr(engine, "PROTOCOL", engine.PROTOCOL + 1)
        job = submitted(monkeypatch)
    seen(ago_s=0)
    stuck = found(exit_code=1)
    assert not_in_order(stuck) == ["jobs"]
    assert f"1 need a newer worker: job protocol {engine.PROTOCOL + 1}" in stuck["jobs"]["detail"]
    assert "betaloop take-back-jobs" in stuck["jobs"]["hint"]
    done = CliRunner().invoke(command_line, ["take-back-jobs"])
    assert (done.exit_code, done.output) == (0, "1 job of a newer version will run in this one.\n")
    found(exit_code=0)
    with transaction("test") as db:
        version = db.scalar(text("select application_version from dbos.workflow_status where workflow_uuid = :id"), {"id": job})
    assert version == str(engine.PROTOCOL)


def test_jobs_are_not_taken_back_from_a_newer_worker_that_lives(fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as newer:
        newer.setattr(engine, "PROTOCOL", engine.PROTOCOL + 1)
        seen(ago_s=0)
    done = CliRunner().invoke(command_line, ["take-back-jobs"])
    assert done.exit_code == 1
    assert "A worker of a newer version lives: one. Stop it first" in str(done.exception)


@pytest.mark.parametrize("apart_s", [90, -90])
def test_a_clock_of_the_database_that_goes_wrong_is_found(owner_db: Session, apart_s: int) -> None:
    # A clock cannot be set for one server alone. So the database answers a request for the time by another function of its own
    owner_db.execute(text("create schema elsewhere"))
    clock = f"select pg_catalog.clock_timestamp() + interval '{apart_s} seconds'"
    owner_db.execute(text(f"create function elsewhere.clock_timestamp() returns timestamptz language sql as $$ {clock} $$"))
    owner_db.execute(text("grant usage on schema elsewhere to public"))
    named = owner_db.scalar(text("select current_database()"))
    owner_db.execute(text(f"alter database {named} set search_path = elsewhere, pg_catalog, public"))
    owner_db.commit()
    close_connections()
    findings = found(exit_code=1)
    assert not_in_order(findings) == ["clock"]
    apart = float(findings["clock"]["detail"].split()[0])
    assert abs(apart - 90) < 2
    assert "NTP" in findings["clock"]["hint"]


def test_a_database_that_does_not_answer_is_found(fresh_database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BETALOOP_DATABASE_URL", "postgresql://nobody@127.0.0.1:1/none")
    get_settings.cache_clear()
    findings = found(exit_code=1)
    assert not_in_order(findings) == ["database"]
    assert "does not answer" in findings["database"]["detail"]
