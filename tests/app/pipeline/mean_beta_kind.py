"""A job kind that betaloop does not have: the mean beta amplitude of a snapshot. One registration, at the end, is all that it takes."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from app.learning.trajectories import read_buffer
from app.pipeline.kinds import usable_sessions
from app.pipeline.stages import plan_on_snapshot
from app.platform.jobs import JobContext, JobKind, StepReport, register
from app.platform.jobs.worker import run_worker
from app.platform.web.schemas import Int, Model


class MeanBetaParams(Model):
    """Parameters of `mean_beta`."""

    newest: Int = Field(1000, ge=1, description="How many of the newest beta amplitudes are averaged.")


def mean_beta(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Compute the mean, in the participant's unit; runs in a child process."""
    beta = np.concatenate([session.padded_beta for session in read_buffer(params["snapshot_sha256"]).sessions])
    report.progress(1.0, "averaged")
    return {"mean": float(np.nanmean(beta[-params["newest"] :]))}


def run_mean_beta(job: JobContext) -> dict[str, Any]:
    """Take a snapshot, then average; runs in a worker."""
    snapshot = plan_on_snapshot(job)["snapshot"]
    return job.compute("average", "mean_beta", {"snapshot_sha256": snapshot["sha256"], "newest": job.params["newest"]})


def work() -> None:
    """Run a worker process that knows this kind."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    run_worker(1, stop)


register(
    JobKind(
        name="mean_beta",
        title="Mean beta amplitude",
        params=MeanBetaParams,
        orchestration="mean_beta_kind:run_mean_beta",
        compute={"mean_beta": "mean_beta_kind:mean_beta"},
        requires=(usable_sessions,),
    )
)
