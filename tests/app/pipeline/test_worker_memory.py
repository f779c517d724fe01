"""Memory of a worker after its last step."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import psutil
import pytest
from fastapi.testclient import TestClient

from tests.app.pipeline.test_smoke import SETTINGS, SMALL

MOST_MIB = 200
WITHIN_S = 60.0


def used_mib(worker: int) -> float:
    """Memory of a process and all below it; a page that several share counts once among them."""
    process = psutil.Process(worker)
    return sum(p.memory_full_info().pss for p in [process, *process.children(recursive=True)]) / (1 << 20)


@pytest.mark.slow
@pytest.mark.usefixtures("worker")
def test_a_worker_gives_back_what_a_training_took(
    client: TestClient, participant_code: str, upload: Callable[..., int], ended: Callable[..., dict[str, Any]]
) -> None:
    of_participant = f"/api/v1/participants/{participant_code}"
    assert client.put(f"{of_participant}/settings", json={"settings": SETTINGS}).status_code == 200
    for controller in ("random", "cdbs", "random", "random", "cdbs"):
        upload(controller, steps=150)
    done = ended(client.post(f"{of_participant}/jobs", json={"kind": "pipeline", **SMALL}).json()["id"], 600)
    assert done["status"] == "succeeded", done
    (worker,) = (p.pid for p in psutil.Process().children() if "run_worker" in " ".join(p.cmdline()))
    until = time.monotonic() + 2 * WITHIN_S
    while (used := used_mib(worker)) > MOST_MIB:
        assert time.monotonic() < until, f"{used:.0f} MiB; {WITHIN_S:.0f} s are promised, on a machine that is not busy"
        time.sleep(1)
