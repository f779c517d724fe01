"""A job from submit to its end, with a worker in a process of its own."""

from __future__ import annotations

import os
import time
from pathlib import Path

import psutil
import pytest
from sqlalchemy import text

from app.platform.database import new_session, transaction
from app.platform.errors import Conflict, Invalid
from app.platform.jobs import repository, service
from app.platform.jobs.children.forked import MODULE as FORKING
from app.platform.jobs.context import UnknownKind


def test_a_job_runs_in_children_stores_once_tells_its_story_and_names_its_submitter(jobs):
    worker = jobs.start_worker()
    job = jobs.ended(jobs.submit(by="ada@clinic.example", parts=3, numbers=4))
    assert (job.status, job.progress, job.error, job.created_by) == ("succeeded", 1.0, None, "ada@clinic.example")
    assert job.result == {"stored": 3, "resumed_from": [0, 0, 0]}
    assert jobs.counted(job.id) == [0, 1, 2]
    assert [(s.key, s.status, s.attempts) for s in job.steps] == [
        ("count/0", "succeeded", 1), ("count/1", "succeeded", 1), ("count/2", "succeeded", 1), ("store", "succeeded", 1),
    ]  # fmt: skip
    pids = {s.result["pid"] for s in job.steps[:3]}
    assert len(pids) == 3
    assert worker.pid not in pids

    with new_session() as db:
        assert db.scalar(text("select count(*) from dbos.operation_outputs")) == 0  # a step is recorded once, by our own ledger
        events = service.events_after(db, job.id, 0)
        audit = db.execute(text("select actor, after ->> 'status' as status from audit_event where entity = 'job' order by id")).all()
    assert [e.id for e in events] == sorted({e.id for e in events})
    assert [e.data["status"] for e in events if e.kind == "status"] == ["queued", "running", "succeeded"]
    for part in range(3):
        points = [p for e in events if e.kind == "points" and e.step_key == f"count/{part}" for p in e.data["points"]]
        assert points == [{"x": float(i), "values": {"square": float(i * i)}} for i in range(4)]
    progress = [e.data["job_progress"] for e in events if e.kind == "progress"]
    assert progress == sorted(progress)
    left = [(e.data["job_progress"], e.data["seconds_left"]) for e in events if e.kind == "progress"]
    assert all((seconds is None) == (share < 0.05) and (seconds is None or seconds >= 0) for share, seconds in left)
    assert any(seconds is not None for _, seconds in left)
    assert [row.actor for row in audit] == ["ada@clinic.example", *["worker for ada@clinic.example"] * 2]
    assert [row.status for row in audit] == ["queued", "running", "succeeded"]


def test_a_step_steps_back_behind_every_other_process_as_far_as_the_settings_say(jobs):
    worker = jobs.start_worker(BETALOOP_JOB_NICENESS="7")
    jobs.submit(parts=1, numbers=1000, pause_s=0.2)
    wanted, switch = min(os.getpriority(os.PRIO_PROCESS, worker.pid) + 7, 19), Path("/proc/sys/kernel/sched_autogroup_enabled")
    shared = switch.exists() and switch.read_text().strip() == "1"

    def standing():
        found = [(c.nice(), Path(f"/proc/{c.pid}/autogroup")) for c in jobs.children(worker)]
        # where the kernel shares the processor out among sessions, the group of the step's own session has to step back too
        return [(nice, int(group.read_text().split()[-1]) if shared else wanted) for nice, group in found]

    jobs.wait(lambda: standing() == [(wanted, wanted)])
    assert os.getpriority(os.PRIO_PROCESS, worker.pid) < wanted


def test_a_job_does_not_exist_when_the_callers_transaction_is_rolled_back(jobs):
    with new_session() as db:
        lost = service.submit(db, "count", None, {"parts": 1}, "test").id
        db.rollback()
    jobs.start_worker()
    kept = jobs.ended(jobs.submit(parts=1, numbers=1))
    with new_session() as db:
        ids = set(db.scalars(text("select id from job union select workflow_uuid from dbos.workflow_status where queue_name = 'jobs'")))
    assert ids == {kept.id}
    assert lost not in ids


def _logs(job_id):
    with new_session() as db:
        return "".join(e.data["text"] for e in repository.events_after(db, job_id, 0) if e.kind == "log")


@pytest.mark.slow
def test_a_step_that_fails_fails_its_job_with_its_message_and_nothing_else(jobs):
    memory = "The step needs more memory than its limit of 512 MiB. Make the job smaller or raise BETALOOP_JOB_MEMORY_MB for the worker."
    messages = {
        "worded": "Participant P1 has no session. Upload one first.",
        "bug": "ZeroDivisionError: division by zero",
        "nan": "TypeError: compute function 'fail' must return JSON, without NaN, arrays or other objects",
        "killed": "The step's process was killed from outside (SIGKILL), most likely because the machine ran out of memory.",
        "memory": memory,
        "torch": memory,
        "transaction": "The buffer is empty. Upload a session.",
    }
    worker = jobs.start_worker(BETALOOP_JOB_MEMORY_MB="512")
    ids = {how: jobs.submit("fail", how=how) for how in messages}
    for how, message in messages.items():
        job = jobs.ended(ids[how])
        step = job.steps[0]
        assert (job.status, step.status) == ("failed", "failed"), how
        assert step.message.startswith(message), how
        assert job.error == f"Step {step.key} failed: {step.message}"
        assert how in {"killed", "memory", "torch"} or "Traceback" in _logs(job.id), how
    assert jobs.counted("broken") == []

    job = jobs.ended(jobs.submit("fail", how="orchestration"))
    assert (job.status, job.error) == ("failed", "KeyError: 'missing'")
    assert "run_fail" in _logs(job.id)
    assert jobs.ended(jobs.submit(parts=1, numbers=1)).status == "succeeded"
    assert worker.poll() is None


@pytest.mark.slow
def test_a_step_whose_process_was_killed_is_tried_once_more(jobs):
    jobs.start_worker()
    once, always = jobs.submit("fail", how="killed once"), jobs.submit("fail", how="killed")
    job = jobs.ended(once)
    assert (job.status, job.result, [s.attempts for s in job.steps]) == ("succeeded", {"tries": 2}, [2])
    job = jobs.ended(always)
    assert (job.status, [s.attempts for s in job.steps]) == ("failed", [2])


@pytest.mark.slow
def test_cancelling_kills_the_children_within_two_seconds(jobs):
    worker = jobs.start_worker(beat_s=5.0)
    job_id = jobs.submit(parts=3, numbers=1000, pause_s=0.1)
    jobs.wait(lambda: len(jobs.children(worker)) == 2)
    jobs.wait(lambda: sum(bool(jobs.numbers(job_id, part)) for part in range(3)) == 2)
    children = jobs.children(worker)
    with transaction("boss@clinic.example") as db:
        service.cancel(db, repository.get(db, job_id), "boss@clinic.example")
    took = jobs.wait(lambda: not any(c.is_running() and c.status() != psutil.STATUS_ZOMBIE for c in children), 5.0)
    job = jobs.ended(job_id, 2.0)
    assert took < 2.0
    assert job.status == "cancelled"
    with new_session() as db:
        assert [e.data for e in service.events_after(db, job_id, 0) if e.kind == "cancel"] == [{"by": "boss@clinic.example"}]
    assert {s.status for s in job.steps} == {"cancelled"}
    assert jobs.counted(job_id) == []
    assert "Traceback" not in jobs.log.read_text()
    assert jobs.ended(jobs.submit(parts=1, numbers=1)).status == "succeeded"


def test_a_waiting_job_is_cancelled_at_once_and_never_starts(jobs):
    first, second = jobs.submit(parts=1, numbers=1), jobs.submit(parts=1, numbers=1)
    with transaction("test") as db:
        assert service.cancel(db, repository.get(db, first), "test").status == "cancelled"
    jobs.start_worker()
    jobs.ended(second)
    time.sleep(0.5)
    job = jobs.get(first)
    assert (job.status, job.started_at, job.steps) == ("cancelled", None, [])
    with transaction("test") as db, pytest.raises(Conflict, match="already cancelled"):
        service.cancel(db, repository.get(db, first), "test")


@pytest.mark.slow
def test_retry_makes_a_new_job_with_the_same_params(jobs):
    jobs.start_worker()
    old = jobs.ended(jobs.submit(parts=2, numbers=1))
    with transaction("test") as db:
        new_id = service.retry(db, repository.get(db, old.id), "second@clinic.example").id
    new = jobs.ended(new_id)
    assert (new.id != old.id, new.params, new.created_by) == (True, old.params, "second@clinic.example")
    assert jobs.counted(new.id) == [0, 1]


def test_a_running_job_cannot_be_retried(jobs):
    job_id = jobs.submit()
    with transaction("test") as db, pytest.raises(Conflict, match="still queued"):
        service.retry(db, repository.get(db, job_id), "test")


def test_submit_refuses_unknown_kinds_and_params_that_do_not_fit(jobs, monkeypatch):
    monkeypatch.setattr("app.platform.jobs.registry.KIND_MODULES", ())
    with new_session() as db:
        with pytest.raises(UnknownKind, match="no job kind 'dance'"):
            service.submit(db, "dance", None, {}, "test")
        with pytest.raises(Invalid, match="parts: Input should be greater than or equal to 1"):
            service.submit(db, "count", None, {"parts": 0}, "test")


def test_the_web_process_takes_no_job(jobs):
    job_id = jobs.submit(parts=1, numbers=1)
    time.sleep(2.0)
    job = jobs.get(job_id)
    assert (job.status, job.started_at) == ("queued", None)
    below = psutil.Process(os.getpid()).children(recursive=True)
    assert [p for p in below if FORKING in psutil.Process(p.ppid()).cmdline()] == []
