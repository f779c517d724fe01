"""Evaluations cancelled, and workers killed, in the middle of a fit: nothing runs on, nothing is done twice, the numbers stay."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.learning.policies import constant_onnx
from app.settings import get_settings
from app.tables.jobs import JobEvent

Upload = Callable[..., int]
Ended = Callable[..., dict[str, Any]]
ROOT = Path(__file__).resolve().parents[3]
JOBS = "/api/v1/participants/P1/jobs"
WORK = (
    "import signal, threading; from app.platform.jobs.worker import run_worker; stop = threading.Event();"
    "signal.signal(signal.SIGTERM, lambda *_: stop.set()); run_worker(2, stop)"
)

pytestmark = pytest.mark.slow


class Workers:
    """Workers in processes of their own, and the compute steps that run under them."""

    def __init__(self) -> None:
        self.started: list[subprocess.Popen[bytes]] = []

    def start(self) -> subprocess.Popen[bytes]:
        log = get_settings().data_dir / "worker.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as out:
            worker = subprocess.Popen([sys.executable, "-c", WORK], cwd=ROOT, stdout=out, stderr=out)
        self.started.append(worker)
        return worker

    def computing(self, worker: subprocess.Popen[bytes], step: str) -> psutil.Process | None:
        """Find the child that carries out a step."""
        folder = step.replace("/", "__")
        for process in psutil.Process(worker.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):  # ended between two looks
                if any(Path(held.path).parts[-2:] == (folder, ".lock") for held in process.open_files()):
                    return process
        return None

    def stop(self) -> None:
        for worker in self.started:
            if worker.poll() is None:
                worker.send_signal(signal.SIGKILL)
            worker.wait()


@pytest.fixture
def workers(fresh_database: str) -> Iterator[Workers]:
    hands = Workers()
    yield hands
    hands.stop()


@pytest.fixture
def policy(client: TestClient, upload: Upload) -> int:
    """A policy made elsewhere, for a participant with eight sessions by three controllers over two visits."""
    for k, (controller, level) in enumerate((("random", 1.0), ("cdbs", 1.0), ("random", 1.0), ("no_dbs", 0.0)) * 2):
        upload(controller, level=level, steps=120, qoc={"grasp_hz": 2 + 0.1 * k, "rating": 6 + k % 3, "tremor_percent": 5.0 * k})
    answer = client.post("/api/v1/participants/P1/policies", data={"name": "ext"}, files={"file": ("e.onnx", constant_onnx(0.6, 10))})
    return int(answer.json()["id"])


def wait(condition: Callable[[], Any], timeout_s: float) -> float:
    """Wait for a condition; return the seconds."""
    start = time.monotonic()
    while not condition():
        if time.monotonic() - start > timeout_s:
            raise AssertionError(f"nothing happened within {timeout_s} s\n{(get_settings().data_dir / 'worker.log').read_text()[-3000:]}")
        time.sleep(0.05)
    return time.monotonic() - start


def gone(process: psutil.Process) -> bool:
    try:
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def step(client: TestClient, job: str, key: str) -> dict[str, Any]:
    found: dict[str, Any] = next((s for s in client.get(f"/api/v1/jobs/{job}").json()["steps"] if s["key"] == key), {"progress": 0.0})
    return found


def points(db: Session, job: str, key: str) -> list[float]:
    """List where a step's learning curves have points, in the order in which they came."""
    db.rollback()
    events = db.scalars(select(JobEvent).where(JobEvent.job_id == job, JobEvent.step_key == key).order_by(JobEvent.id))
    return [point["x"] for e in events if e.kind == "points" for point in e.data["points"]]


@pytest.mark.parametrize(
    ("preset", "methods", "middle_of"),
    [
        ("full", ["dlsm"], ["fit/0", "fit/1"]),  # a quick one may end between two looks
        ("full", ["fqe", "dual_dice"], ["estimate/dual_dice"]),
        ("full", ["fqe"], ["estimate/fqe"]),
    ],
    ids=["two members of the DLSM", "DualDICE", "fitted Q evaluation"],
)
def test_an_evaluation_cancelled_in_the_middle_of_a_fit_ends_promptly_and_leaves_no_process(
    client: TestClient, policy: int, workers: Workers, ended: Ended, preset: str, methods: list[str], middle_of: list[str]
) -> None:
    worker = workers.start()
    for seed in range(5):  # on a busy machine one fit may end before the other begins
        job = client.post(JOBS, json={"kind": "evaluate", "preset": preset, "methods": methods, "seed": seed}).json()["id"]
        far: list[float] = []

        def looked(job: str = job, far: list[float] = far) -> bool:
            far[:] = [step(client, job, key)["progress"] for key in middle_of]
            return min(far) > 0.02 or max(far) == 1.0

        wait(looked, 90.0)
        if max(far) < 1.0:
            break
        client.post(f"/api/v1/jobs/{job}/cancel")
        ended(job, 60.0)
    assert max(far) < 1.0, "the fits never ran at once"
    children = [child for key in middle_of if (child := workers.computing(worker, key)) is not None]
    assert len(children) == len(middle_of)
    family = [*children, *(below for child in children for below in child.children(recursive=True))]
    assert client.post(f"/api/v1/jobs/{job}/cancel").status_code == 200
    assert wait(lambda: all(gone(process) for process in family), 10.0) < 2.5
    body = ended(job, 5.0)
    assert body["status"] == "cancelled"
    assert {s["status"] for s in body["steps"] if s["key"] in middle_of} == {"cancelled"}
    assert body["result"] is None
    assert client.get("/api/v1/participants/P1/ranking").status_code == 404  # nothing half-done is stored
    assert worker.poll() is None


def test_a_killed_workers_evaluation_goes_on_where_it_was_and_gives_the_same_numbers(
    client: TestClient, policy: int, workers: Workers, ended: Ended, db: Session
) -> None:
    body = {"kind": "evaluate", "preset": "quick", "methods": ["dlsm", "dual_dice"], "policies": [policy], "seed": 3}
    worker = workers.start()
    undisturbed = ended(client.post(JOBS, json=body).json()["id"], 300)
    assert undisturbed["status"] == "succeeded", undisturbed
    expected = client.get("/api/v1/participants/P1/ranking").json()

    job = client.post(JOBS, json=body).json()["id"]
    # first in the middle of both members, later in the middle of DualDICE, when the members have long been stored
    wait(lambda: min(max(points(db, job, f"fit/{k}"), default=0.0) for k in range(2)) >= 50, 120.0)
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    reached = [max(points(db, job, f"fit/{k}")) for k in range(2)]
    seen = [len(points(db, job, f"fit/{k}")) for k in range(2)]
    worker = workers.start()
    wait(lambda: 0.02 < step(client, job, "estimate/dual_dice")["progress"] < 1.0, 180.0)
    before = {s["key"]: s["attempts"] for s in client.get(f"/api/v1/jobs/{job}").json()["steps"] if s["status"] == "succeeded"}
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    workers.start()
    done = ended(job, 300)
    assert done["status"] == "succeeded", done

    attempts = {s["key"]: s["attempts"] for s in done["steps"]}
    assert {key: attempts[key] for key in before} == before  # what was finished is not done again
    assert (attempts["plan"], attempts["fit/0"], attempts["fit/1"], attempts["estimate/dual_dice"]) == (1, 2, 2, 2)
    for k in range(2):
        # a member goes on from its last check, not from the start; one that had stored its last has nothing left to report
        later = points(db, job, f"fit/{k}")[seen[k] :]
        assert min(later, default=reached[k]) > 0.3 * reached[k]
    found = client.get("/api/v1/participants/P1/ranking").json()
    assert (found["evaluation_id"], found["snapshot"]["id"]) == (done["result"]["evaluation_id"], expected["snapshot"]["id"])
    for ours, theirs in zip(found["policies"] + found["references"], expected["policies"] + expected["references"], strict=True):
        assert ours["estimates"] == theirs["estimates"]
        assert ours["coverage"] == theirs["coverage"]
    assert found["default_method"] == expected["default_method"]
