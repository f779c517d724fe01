"""Sessions as a clinic uploads them (beta follows an autoregression that the amplitude pushes down), and a worker for their jobs."""

from __future__ import annotations

import io
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from numpy.typing import NDArray

from app.settings import get_settings

ROOT = Path(__file__).resolve().parents[2]
Upload = Callable[..., int]


def table(amplitude: NDArray[np.float64], rng: np.random.Generator, lead: int = 10) -> str:
    """A CSV of one session: `lead` rows before its start, then one row per amplitude."""
    driven = np.concatenate([np.full(lead, amplitude[0]), amplitude])
    beta, level = np.empty(driven.size), 1.2
    for i, a in enumerate(driven):
        level = 0.8 * level + 0.2 * (1.6 - 0.9 * a) + 0.1 * rng.standard_normal()
        beta[i] = max(level, 0.05)
    sink = io.StringIO()
    sink.write("t_s,beta,amplitude_fraction\n")
    for i, (b, a) in enumerate(zip(beta, driven, strict=True)):
        sink.write(f"{2 * (i - lead + 1)},{b:.5f},{a:.4f}\n")
    return sink.getvalue()


@pytest.fixture
def upload(client: TestClient, enrolled: str) -> Upload:
    """Upload a session of P1 and enter its QoCs; returns its id."""
    rng = np.random.default_rng(20)

    def send(
        controller: str = "random",
        steps: int = 60,
        visit: int = 1,
        level: float = 1.0,
        qoc: dict[str, Any] | None = None,
        lead: int = 10,
        **fields: Any,
    ) -> int:
        amplitude = rng.uniform(0.3, 1.0, steps) if controller == "random" else np.full(steps, level)
        answer = client.post(
            "/api/v1/uploads",
            data={"participant": enrolled, "visit": visit, "controller": controller, **fields},
            files={"file": (f"{controller}-{rng.integers(10**9)}.csv", table(amplitude, rng, lead), "text/csv")},
        )
        assert answer.status_code == 201, answer.text
        session_id = int(answer.json()["sessions"][0]["id"])
        values = {"grasp_hz": 2.0, "rating": 7, "tremor_percent": 10.0} if qoc is None else qoc
        if values:
            assert client.put(f"/api/v1/sessions/{session_id}/qoc", json=values).status_code == 200
        return session_id

    return send


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
