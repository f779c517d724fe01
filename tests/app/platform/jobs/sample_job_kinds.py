"""Job kinds of the tests, imported by the tests, by workers in processes of their own, and by their children."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform import files
from app.platform.jobs import JobContext, JobError, JobKind, StepReport, register, write_atomically
from app.platform.jobs.worker import Pace, run_worker
from app.platform.upkeep.start import Watchdog
from app.platform.web.schemas import Text

PREPARED: list[int] = []
"""The processes that have prepared this module, those of which ours is a fork among them."""


def prepare() -> None:
    """Prepare, as called by the process whose forks compute."""
    PREPARED.append(os.getpid())
    if os.environ.get("TEST_PREPARE_FAILS"):
        raise RuntimeError("this module cannot be prepared")


def who_prepared(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Return the processes that have prepared this module, the one that forked us, and how nice we are."""
    return {"prepared": PREPARED, "forked_by": os.getppid(), "nice": os.nice(0)}


def write_to_a_full_disk(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Fail by it."""
    Path("/dev/full").write_bytes(b"a checkpoint")
    return {}


def fill_the_disk(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Fail by a disk that this fills; numpy does not say why it cannot write."""
    with suppress(OSError), (Path(params["disk"]) / "filler").open("ab", buffering=0) as out:
        while True:
            out.write(bytes(1))
    np.save(workdir / "checkpoint.npy", np.zeros(1 << 16))
    return {}


class CountParams(BaseModel):
    """Numbers of a count: parts, how far each counts, how long each number takes."""

    parts: int = Field(2, ge=1)
    numbers: int = Field(3, ge=1)
    pause_s: float = 0.0


def count(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Count slowly, with a checkpoint after every number."""
    checkpoint = workdir / "checkpoint"
    start = int(checkpoint.read_text()) if checkpoint.exists() else 0
    for i in range(start, params["numbers"]):
        time.sleep(params["pause_s"])
        with (workdir / "counted").open("a") as counted:
            counted.write(f"{i}\n")
        write_atomically(checkpoint, str(i + 1).encode())
        report.progress((i + 1) / params["numbers"], f"number {i + 1}")
        report.point(i, square=i * i)
    return {"part": params["part"], "counted": params["numbers"], "resumed_from": start, "pid": os.getpid()}


def run_count(job: JobContext) -> dict[str, Any]:
    """Count in parts, then store one row per part."""
    calls = [(f"count/{i}", "count", {**job.params, "part": i}) for i in range(job.params["parts"])]
    for i, (key, _, _) in enumerate(calls):
        job.step(key, f"Part {i}", weight=10)
    job.step("store", "Store", weight=1)
    results = job.compute_all(calls)
    stored = job.transact("store", lambda db: _store(db, job.id, results))
    return {"stored": stored["rows"], "resumed_from": [r["resumed_from"] for r in results]}


def _store(db: Session, job_id: str, results: list[dict[str, Any]]) -> dict[str, Any]:
    for result in results:
        db.execute(text("insert into counted (job_id, part) values (:job, :part)"), {"job": job_id, "part": result["part"]})
    return {"rows": len(results)}


class FailParams(BaseModel):
    """Kind of failure."""

    how: Text


def fail(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Fail as asked."""
    how = params["how"]
    if how == "worded":
        raise JobError("Participant P1 has no session.", "Upload one first.")
    if how == "bug":
        raise ZeroDivisionError("division by zero")
    if how == "memory":
        hoard = [bytearray(1 << 24)]
        while True:
            hoard.append(bytearray(b"x" * (1 << 24)))
    if how == "torch":
        import torch

        return {"norm": float(torch.ones(1 << 30).norm())}
    if how == "killed once":
        (workdir / "tries").open("a").write("x")
        if (workdir / "tries").stat().st_size > 1:
            return {"tries": (workdir / "tries").stat().st_size}
    if how in {"killed", "killed once"}:
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "nan":
        return {"value": float("nan")}
    return {}


def run_fail(job: JobContext) -> dict[str, Any]:
    """Fail in a child, in a transaction or in the orchestration."""
    if job.params["how"] == "transaction":
        return job.transact("store", _store_and_break)
    if job.params["how"] == "orchestration":
        raise KeyError("missing")
    if job.params["how"] == "kills worker":
        return job.transact("kill", _kill_worker)
    return job.compute("fail", "fail", job.params)


def _store_and_break(db: Session) -> dict[str, Any]:
    db.execute(text("insert into counted (job_id, part) values ('broken', 1)"))
    db.flush()
    raise JobError("The buffer is empty.", "Upload a session.")


class FilesParams(BaseModel):
    """The file to read, what to write, and a file without which the job fails after both."""

    sha256: Text
    content: Text = "written"
    needs: Text | None = None


def read_file(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Read a stored file."""
    return {"size": len(files.read(params["sha256"])), "pid": os.getpid()}


def needs_file(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Fail where a file is missing."""
    if params["needs"] and not Path(params["needs"]).exists():
        raise JobError("The file is not there.", "Make it.")
    return {}


def run_files(job: JobContext) -> dict[str, Any]:
    """Store a file in a transaction, read one in a child, then need another."""
    written = job.transact("write", lambda db: {"sha256": files.store(db, job.params["content"].encode()).sha256})
    read = job.compute("read", "read_file", {"sha256": job.params["sha256"]})
    job.compute("need", "needs_file", {"needs": job.params["needs"]})
    return {"written": written["sha256"], **read}


def run_read(job: JobContext) -> dict[str, Any]:
    """Read a file in a child."""
    return job.compute("read", "read_file", {"sha256": job.params["sha256"]})


def _kill_worker(db: Session) -> dict[str, Any]:
    os.kill(os.getpid(), signal.SIGKILL)
    return {}


for name, schema in (("count", CountParams), ("fail", FailParams)):
    register(
        JobKind(
            name=name,
            title=name.capitalize(),
            params=schema,
            orchestration=f"sample_job_kinds:run_{name}",
            compute={name: f"sample_job_kinds:{name}"},
        )
    )
for name in ("files", "read"):
    register(
        JobKind(
            name=name,
            title=name.capitalize(),
            params=FilesParams,
            orchestration=f"sample_job_kinds:run_{name}",
            compute={name: f"sample_job_kinds:{name}" for name in ("read_file", "needs_file")},
        )
    )


def work(slots: int, beat_s: float, stale_s: float) -> None:
    """Run a worker process, as the command line starts it."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    run_worker(slots, stop, Pace(beat_s=beat_s, stale_s=stale_s), Watchdog(stop, stale_s).beat)
    sys.exit(0)
