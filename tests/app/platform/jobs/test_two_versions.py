"""Two versions at once, each from a checkout of its own: who runs what during a rolling upgrade, and after one that was given up."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from app.platform.database import new_session, transaction
from app.platform.jobs import engine, repository, service
from app.platform.upkeep.doctor import examine
from tests.app.platform.jobs.conftest import HERE, ROOT, Jobs


@pytest.fixture
def newer(tmp_path: Path) -> dict[str, str]:
    """A checkout whose job protocol is one newer, as the environment of its processes."""
    for package in ("app", "ml"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    path = tmp_path / "app" / "platform" / "jobs" / "engine.py"
    changed, count = re.subn(r"^PROTOCOL = \d+$", f"PROTOCOL = {engine.PROTOCOL + 1}", path.read_text(), flags=re.MULTILINE)
    assert count == 1
    path.write_text(changed)
    return {"PYTHONPATH": os.pathsep.join([str(HERE), str(tmp_path)]), "PYTHONSAFEPATH": "1"}


def submit(checkout: dict[str, str], numbers: int) -> str:
    """Ask for a job as the web service of a checkout does."""
    code = (
        "import sample_job_kinds; from app.platform.database import transaction; from app.platform.jobs import service\n"
        "with transaction('newer') as db:\n"
        f"    print(service.submit(db, 'count', None, {{'parts': 1, 'numbers': {numbers}, 'pause_s': 0.1}}, 'newer').id)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | checkout, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def protocols(jobs: Jobs) -> list[int]:
    with new_session() as db:
        return sorted(worker.protocol for worker in repository.live_workers(db, service.STALE_S))


def stop(jobs: Jobs, worker: subprocess.Popen[bytes]) -> None:
    worker.send_signal(signal.SIGTERM)
    worker.wait(60)


def stuck_jobs() -> str:
    """Return the finding of doctor on jobs; empty where all is well."""
    (found,) = [f for f in examine() if f.name == "jobs"]
    return "" if found.ok else f"{found.detail}. {found.hint}"


@pytest.mark.slow
def test_old_and_newer_workers_run_each_what_they_may_and_the_newer_ones_take_over(jobs: Jobs, newer: dict[str, str]) -> None:
    old, new = jobs.start_worker(), jobs.start_worker(**newer)
    jobs.wait(lambda: protocols(jobs) == [engine.PROTOCOL, engine.PROTOCOL + 1])
    of_old, of_new = jobs.submit(parts=1), submit(newer, 1)
    assert [jobs.ended(i).protocol for i in (of_old, of_new)] == [engine.PROTOCOL, engine.PROTOCOL + 1]
    unfinished = jobs.submit(parts=2, numbers=100, pause_s=0.1)
    jobs.wait(lambda: jobs.numbers(unfinished, 0))
    stop(jobs, old)
    taken = jobs.ended(unfinished)
    assert (taken.status, taken.protocol) == ("succeeded", engine.PROTOCOL + 1)
    numbers = jobs.numbers(unfinished, 0)
    assert (sorted(set(numbers)), len(numbers) <= 101) == (list(range(100)), True), "the stop may fall between a number and its checkpoint"
    of_an_old_web = jobs.submit(parts=1)
    assert jobs.ended(of_an_old_web).status == "succeeded"
    stop(jobs, new)


@pytest.mark.slow
def test_an_upgrade_that_was_given_up_strands_no_job(jobs: Jobs, newer: dict[str, str]) -> None:
    old, new = jobs.start_worker(), jobs.start_worker(**newer)
    jobs.wait(lambda: protocols(jobs) == [engine.PROTOCOL, engine.PROTOCOL + 1])
    begun = submit(newer, 100)
    jobs.wait(lambda: jobs.numbers(begun, 0))
    stop(jobs, new)
    stop(jobs, old)
    jobs.start_worker()
    jobs.wait(lambda: protocols(jobs) == [engine.PROTOCOL])
    assert jobs.ended(jobs.submit(parts=1)).status == "succeeded", "later jobs of this version run"
    assert jobs.get(begun).finished_at is None
    assert "take-back-jobs" in stuck_jobs()
    with transaction("test") as db:
        assert service.take_back(db) == 1
    assert stuck_jobs() == ""
    assert jobs.ended(begun).status == "succeeded"
