"""Memory of a worker after its last step."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import psutil
import pytest
from fastapi.testclient import TestClient

from tests.app.pipeline.test_smoke import SETTINGS, SMALL

MOST_MIB = 200
WITHIN_S = 60.0


def used_mib(worker: int) -> float:
    """Sum the memory of a process and all below it; a page that several share counts once among them."""
    used, process = 0, psutil.Process(worker)
    for one in [process, *process.children(recursive=True)]:
        with suppress(psutil.NoSuchProcess, FileNotFoundError):  # it ended between two looks
            used += one.memory_full_info().pss
    return used / (1 << 20)


@pytest.mark.slow
@pytest.mark.usefixtures("worker")
def test_a_worker_gives_back_what_a_training_took(client: TestClient, participant_code: str, upload: Callable[..., int]) -> None:
    of_participant = f"/api/v1/participants/{participant_code}"
    assert client.put(f"{of_participant}/settings", json={"settings": SETTINGS}).status_code == 200
    for controller in ("random", "cdbs", "random", "random", "cdbs"):
        upload(controller, steps=150)
    job: dict[str, Any] = client.post(f"{of_participant}/jobs", json={"kind": "pipeline", **SMALL}).json()
    until = time.monotonic() + 600
    while job["finished_at"] is None:
        assert time.monotonic() < until, job
        time.sleep(0.5)
        job = client.get(f"/api/v1/jobs/{job['id']}").json()
    assert job["status"] == "succeeded", job
    (worker,) = (p.pid for p in psutil.Process().children() if "run_worker" in " ".join(p.cmdline()))
    until = time.monotonic() + 2 * WITHIN_S
    while (used := used_mib(worker)) > MOST_MIB:
        assert time.monotonic() < until, f"{used:.0f} MiB; {WITHIN_S:.0f} s are promised, on a machine that is not busy"
        time.sleep(1)
