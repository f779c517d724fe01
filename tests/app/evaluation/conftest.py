"""A worker in a process of its own."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.settings import get_settings

ROOT = Path(__file__).resolve().parents[3]
Upload = Callable[..., int]


@pytest.fixture
def worker(fresh_database: str) -> Iterator[None]:
    """A worker in a process of its own, on the test's database."""
    code = (
        "import signal, sys, threading; from app.platform.jobs.worker import run_worker; stop = threading.Event();"
        "signal.signal(signal.SIGTERM, lambda *_: stop.set()); run_worker(2, stop)"
    )
    log = get_settings().data_dir / "worker.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as out:
        process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=out, stderr=out)
    yield
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@pytest.fixture
def ended(client: TestClient) -> Callable[[str, float], dict[str, Any]]:
    """Wait for a job's end."""

    def wait(job_id: str, timeout_s: float = 60.0) -> dict[str, Any]:
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            job: dict[str, Any] = client.get(f"/api/v1/jobs/{job_id}").json()
            if job["finished_at"]:
                return job
            time.sleep(0.2)
        raise AssertionError(
            f"the job did not end within {timeout_s} s: {job}\n{(get_settings().data_dir / 'worker.log').read_text()[-3000:]}"
        )

    return wait
