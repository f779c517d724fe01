"""Background jobs: durable, cancellable, resumed after kill -9 without losing or doubling anything.

How to add a job kind
---------------------
A kind has two parts. The *orchestration* runs in a worker and defines the steps and their order. The *compute functions* do the work, each
call in a child process of its own (true cancel, memory returned, a crash harms no other call). One record registers a kind, in a module
that `registry.KIND_MODULES` names; API, pages and form derive from it::

    class TrainParams(BaseModel):                          # what POST .../jobs accepts besides `kind`; checked on submit
        policies: list[int]
        iterations: int = 1000

    def train(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:   # child process: JSON in, JSON out
        buffer = read_buffer(files.path_of(params["snapshot_sha256"]))      # stored files are read by their hash
        start = load_checkpoint(workdir / "checkpoint.pt")                  # workdir survives restarts: resume from it
        for i in range(start, params["iterations"]):
            ...
            report.progress((i + 1) / params["iterations"], f"iteration {i + 1}")
            report.point(i, critic_loss=loss, estimated_return=value)       # learning curve: x and named numbers
        (workdir / "policy.onnx").write_bytes(...)                          # big results are files in workdir
        return {"final_loss": loss}                                         # small results are JSON

    def run_train(job: JobContext) -> dict[str, Any]:
        jobs = [(f"train/{i}", "train", {**job.params, "seed": i}) for i in job.params["policies"]]
        for key, _, _ in jobs:
            job.step(key, title=f"Train policy {key}", weight=10)           # declared up front: an honest progress bar from the start
        job.step("store", title="Store the policies", weight=0.1)
        results = job.compute_all(jobs)                                     # fan-out, results in the same order
        return job.transact("store", lambda db: service.store_policies(db, job.id, results, job.workdir("train/0")))

    register(
        JobKind(
            name="train",
            title="Train policies",
            params=TrainParams,
            orchestration="app.pipeline.training:run_train",                # imported by workers
            compute={"train": "app.learning.training_compute:train"},       # imported by children
            requires=(usable_sessions,),                                    # called before the job is put on the queue
        )
    )

Rules
-----
* The orchestration is replayed from its start after a crash, and finished steps give their recorded results. So it must be deterministic:
  no clock, no random numbers, no database reads and no files outside `job.transact` and compute functions. Database reads that choose
  the steps go into a first `job.transact("plan", ...)`.
* A step's `key` is its identity in the job (at most 100 of `a-z 0-9 _ . / -`), stable over restarts; no key twice.
* `job.transact(key, fn)` runs `fn(db)` and records its result in one transaction: exactly once. `fn` returns a JSON dict and never
  commits. The audit trail names the person who submitted the job. Keep it short: no computing in it.
* A compute function may be killed at any moment and called again with the same params and workdir. Write checkpoints to another name
  and rename them (`write_atomically`). When the params differ (they are compared by hash), the workdir is emptied first.
* Raise `JobError("what, where, what to do")` for errors that a person can correct; its text is shown as it is. Any other exception shows
  its last line and keeps the traceback in the step's log. A failed step raises `StepFailed` in the orchestration, which fails the job.
* Do not catch `BaseException` in an orchestration: cancelling and stopping travel as such.
* Records name functions by strings, so that the web service, which knows every kind, never loads torch. A compute module imports what it
  needs at its top; the child imports only the module of its function.

Other entry points
------------------
`service.submit(db, kind, participant_id, params, created_by)` enqueues within the caller's transaction. The module `repository` holds the
queries; `stream.job_events` serves server-sent events; `watch.watch(job_id)` feeds a terminal's progress bar. The worker is
`worker.run_worker(slots, stop_event)`. Every migration run calls `engine.prepare(url)`.
"""

from __future__ import annotations

from app.platform.jobs.children.report import StepReport, write_atomically
from app.platform.jobs.context import JobContext, JobError, StepFailed
from app.platform.jobs.registry import JobKind, Priority, register

__all__ = ["JobContext", "JobError", "JobKind", "Priority", "StepFailed", "StepReport", "register", "write_atomically"]
