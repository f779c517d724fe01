"""A database with the engine's schema, workers in processes of their own, and helpers to wait for jobs."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import psutil
import pytest
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform.database import new_session, transaction
from app.platform.jobs import repository, service
from app.platform.jobs.children.forked import MODULE as FORKING
from app.settings import get_settings
from app.tables.jobs import Job

HERE = Path(__file__).parent
ROOT = HERE.parents[3]
PATIENCE_S = 180.0
"""How long a test waits for what is no promise about time: machines that are busy with other work are slow."""


@pytest.fixture
def kinds(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The sample kinds, registered in this process."""
    monkeypatch.syspath_prepend(str(HERE))
    import sample_job_kinds

    return sample_job_kinds


@pytest.fixture
def jobs(owner_db: Session, kinds: ModuleType) -> Iterator[Jobs]:
    """A database for jobs and the hands to work it."""
    owner_db.execute(text("create table counted (job_id text, part int)"))
    owner_db.execute(text("grant select, insert on counted to betaloop_service"))
    owner_db.commit()
    hands = Jobs()
    yield hands
    hands.stop()


@dataclass
class Jobs:
    """Submit jobs, start and kill workers, wait."""

    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)
    log: Path = field(default_factory=lambda: get_settings().data_dir / "worker.log")

    def submit(self, kind: str = "count", by: str = "engineer@clinic.example", **params: Any) -> str:
        with transaction(by) as db:
            return service.submit(db, kind, None, params, by).id

    def start_worker(self, slots: int = 2, beat_s: float = 0.5, stale_s: float = 60.0, **env: str) -> subprocess.Popen[bytes]:
        self.log.parent.mkdir(parents=True, exist_ok=True)
        code = f"import sample_job_kinds as kinds; kinds.work({slots}, {beat_s}, {stale_s})"
        path = os.pathsep.join([str(HERE), str(ROOT)])
        with self.log.open("ab") as out:
            worker = subprocess.Popen([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path} | env, stdout=out, stderr=out)
        self.workers.append(worker)
        return worker

    def get(self, job_id: str) -> Job:
        with new_session() as db:
            return repository.get(db, job_id)

    def wait(self, condition: Callable[[], Any], timeout_s: float = PATIENCE_S) -> float:
        """Wait for a condition; return the seconds."""
        start = time.monotonic()
        while not condition():
            if time.monotonic() - start > timeout_s:
                log = self.log.read_text() if self.log.exists() else ""
                raise AssertionError(f"nothing happened within {timeout_s} s; the workers logged:\n{log[-4000:]}")
            time.sleep(0.05)
        return time.monotonic() - start

    def ended(self, job_id: str, timeout_s: float = PATIENCE_S) -> Job:
        self.wait(lambda: self.get(job_id).finished_at, timeout_s)
        return self.get(job_id)

    def children(self, worker: subprocess.Popen[bytes]) -> list[psutil.Process]:
        """List live compute children of a worker."""
        found = []
        for process in psutil.Process(worker.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):  # ended between two looks
                if FORKING in psutil.Process(process.ppid()).cmdline():
                    found.append(process)
        return found

    def counted(self, job_id: str) -> list[int]:
        """List parts that were stored, in order, once for every time."""
        with new_session() as db:
            return list(db.scalars(text("select part from counted where job_id = :id order by part"), {"id": job_id}))

    def numbers(self, job_id: str, part: int) -> list[int]:
        """List numbers that a part counted, once for every time."""
        path = get_settings().jobs_dir / job_id / f"count__{part}" / "counted"
        return [int(line) for line in path.read_text().split()] if path.exists() else []

    def stop(self) -> None:
        for worker in self.workers:
            if worker.poll() is None:
                worker.send_signal(signal.SIGKILL)
            worker.wait()
