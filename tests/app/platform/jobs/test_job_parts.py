"""The small parts: slots, reports, keys, names, the event stream, the terminal's view."""

from __future__ import annotations

import asyncio
import io
import json
import threading
from pathlib import Path

import pytest
from pydantic import BaseModel
from rich.console import Console
from sqlalchemy import text

from app.platform import bucket
from app.platform.database import new_session, transaction
from app.platform.errors import NotFound
from app.platform.jobs import JobContext, StepFailed, StepReport, registry, repository, stream, write_atomically
from app.platform.jobs.children.limited import Slots
from app.platform.jobs.children.supervisor import ChildMessages
from app.platform.jobs.context import JobCancelled
from app.platform.jobs.ledger import Ledger
from app.platform.jobs.steps import JobRunner
from app.platform.jobs.stream import job_events
from app.platform.jobs.watch import show_progress, watch
from app.platform.jobs.worker import Identity, IdentityLost, Pace, WorkerMonitor
from app.settings import get_settings
from app.tables.jobs import JobStatus


def test_a_free_slot_goes_to_the_job_that_has_the_fewest():
    slots, order, gates = Slots(1), [], {}

    def hold(job, n):
        gates[job, n] = threading.Event()

        def run():
            with slots.hold(job, lambda: None):
                order.append(job)
                gates[job, n].wait(5)

        thread = threading.Thread(target=run)
        thread.start()
        return thread

    threads = [hold("first", 0)]
    while not order:
        threading.Event().wait(0.01)
    for n in range(1, 4):
        threads.append(hold("first", n))
        threading.Event().wait(0.02)
    threads.append(hold("second", 0))
    threading.Event().wait(0.1)
    for gate in list(gates.values()):
        gate.set()
    for thread in threads:
        thread.join(5)
    assert order == ["first", "second", "first", "first", "first"]


def test_waiting_for_a_slot_can_be_given_up_and_loses_none():
    slots = Slots(1)

    def cancelled():
        raise JobCancelled

    with slots.hold("a", lambda: None), pytest.raises(JobCancelled), slots.hold("b", cancelled):
        pass
    with slots.hold("b", cancelled):
        pass


def test_a_report_sends_the_latest_progress_and_every_point_but_not_every_call():
    sent = []
    report = StepReport(sent.append, interval_s=60.0)
    for i in range(100):
        report.progress(i / 100, f"step {i}")
        report.point(i, loss=1.0 / (i + 1), broken=float("nan"))
    report.flush()
    assert len(sent) == 2
    assert sent[0] == {"progress": 0.0, "message": "step 0"}
    assert (sent[1]["progress"], sent[1]["message"]) == (0.99, "step 99")
    assert sent[1]["points"] == [{"x": float(i), "values": {"loss": 1.0 / (i + 1)}} for i in range(100)]
    with pytest.raises(ValueError, match="NaN"):
        report.progress(float("nan"))


def test_what_was_heard_twice_is_merged():
    messages = ChildMessages()
    assert not messages
    for line in ({"progress": 0.1, "points": [1]}, {"progress": 0.2, "points": [2], "message": "on"}, {"log": "a"}, {"log": "b"}):
        messages.add(json.dumps(line))
    assert messages == ChildMessages(0.2, "on", [1, 2], ["a", "b"])


def test_a_file_is_replaced_whole(tmp_path: Path):
    path = tmp_path / "checkpoint"
    write_atomically(path, b"one")
    write_atomically(path, b"two")
    assert path.read_bytes() == b"two"
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint"]


class _Memory:
    """Steps that only remember, to test the context's own rules. Step `waits` has no slot until another failed."""

    def __init__(self, outcomes=None):
        self.declared, self.outcomes, self.started = [], outcomes or {}, []

    def declare(self, key, title, weight):
        self.declared.append(key)

    def compute(self, key, name, params, skip):
        for _ in range(200 if key == "waits" else 0):
            if skip():
                break
            threading.Event().wait(0.01)
        if skip():
            return {"ok": False, "skipped": True}
        self.started.append(key)
        return self.outcomes[key]


def _context(memory):
    return JobContext("id", "kind", None, {}, "test", memory)


@pytest.mark.parametrize("key", ["", "Train", "a b", "../etc", "a//b", "a/.b", "/a", "x" * 101])
def test_a_malformed_key_is_refused(key):
    with pytest.raises(ValueError, match="cannot be a step's key"):
        _context(_Memory()).step(key)


def test_a_key_cannot_be_run_twice():
    with pytest.raises(ValueError, match="run twice"):
        _context(_Memory()).compute_all([("a", "f", {}), ("a", "f", {})])


def test_after_a_failure_those_still_waiting_do_not_start():
    memory = _Memory({"a": {"ok": True, "result": {}}, "b": {"ok": False, "message": "broken"}, "waits": {"ok": True, "result": {}}})
    with pytest.raises(StepFailed, match="Step b failed: broken") as caught:
        _context(memory).compute_all([("a", "f", {}), ("b", "f", {}), ("waits", "f", {})])
    assert caught.value.key == "b"
    assert "waits" not in memory.started


def test_a_step_that_failed_before_a_crash_is_not_tried_again(jobs):
    """The worker may die between the step's failure and the job's: its successor must find the failure, not repeat the step."""
    job_id = jobs.submit()
    ledger = Ledger(job_id, "test", "worker", lambda: None)
    ledger.open()
    ledger.declare("train", "Train", 1.0)
    assert ledger.outcome("train") is None
    assert ledger.begin("train") is None
    ledger.fail_step("train", "out of memory", "")
    assert ledger.outcome("train") == ledger.begin("train") == {"ok": False, "message": "out of memory"}
    with new_session() as db:
        assert repository.step(db, job_id, "train").attempts == 1


@pytest.fixture
def registered(monkeypatch):
    """The registry, with what the test adds taken out again."""
    registry.load_kinds()  # before the copy: a module registers at its first import alone
    monkeypatch.setattr(registry, "_kinds", dict(registry._kinds))
    return registry


def _kind(name="taken_name", orchestration="one.module:run", compute=None):
    return registry.JobKind(name=name, title="A kind", params=BaseModel, orchestration=orchestration, compute=compute or {})


def test_a_name_belongs_to_one_function(registered):
    registered.register(_kind(compute={"work": "one.module:work"}))
    registered.register(_kind(compute={"work": "one.module:work"}))  # the same module imported twice is no conflict
    registered.register(_kind("second", compute={"work": "one.module:work"}))
    assert registered.compute_reference("work") == "one.module:work"
    with pytest.raises(ValueError, match="two orchestrations register the job kind 'taken_name'"):
        registered.register(_kind(orchestration="other.module:run"))
    with pytest.raises(ValueError, match="two functions register the compute function 'work'"):
        registered.register(_kind("third", compute={"work": "other.module:work"}))


@pytest.mark.parametrize("wrong", [{"name": "No Name"}, {"orchestration": "one.module.run"}, {"compute": {"work": "work"}}])
def test_a_kind_names_its_functions_by_module_and_name(wrong):
    with pytest.raises(ValueError, match=r"cannot name a job kind|names no function: write module:function"):
        _kind(**wrong)


def _lines(job_id, last=None):
    async def collect():
        return [message async for message in job_events(job_id, last)]

    return asyncio.run(collect())


def test_the_stream_starts_with_the_state_resumes_after_an_id_and_ends(jobs):
    job_id = jobs.submit()
    ledger = Ledger(job_id, "test", "here", lambda: None)
    ledger.open()
    ledger.declare("a", "A", 1.0)
    ledger.begin("a")
    ledger.record("a", ChildMessages(0.5, "half", [{"x": 0.0, "values": {"loss": 1.0}}], ["a\nline"]))
    ledger.commit_step("a", lambda db: {"v": 1})
    ledger.close(JobStatus.SUCCEEDED, {"v": 1})
    messages = _lines(job_id)
    names = [m.split("event: ")[1].split("\n")[0] for m in messages]
    assert (names[0], names[-1]) == ("job", "end")
    assert set(names[1:-1]) == {"status", "step", "progress", "points", "log"}
    assert all(m.endswith("\n\n") and m.count("\n\n") == 1 for m in messages)
    ids = [int(m.split("\n")[0].removeprefix("id: ")) for m in messages[1:-1]]
    assert ids == sorted(ids)
    again = _lines(job_id, str(ids[2]))
    assert again[1:-1] == messages[4:-1]
    assert json.loads(messages[-1].split("data: ")[1])["status"] == "succeeded"
    with pytest.raises(NotFound):
        _lines("no-such-job")


def test_the_stream_stops_for_whom_may_listen_no_more(jobs, monkeypatch):
    monkeypatch.setattr(stream, "ASK_AGAIN_S", 0.0)
    monkeypatch.setattr(stream, "POLL_S", 0.01)
    job_id = jobs.submit()  # no worker: it would be followed for ever
    asked = []

    def still(_):
        asked.append(True)
        return len(asked) < 3

    async def collect():
        async with asyncio.timeout(30):
            return [message async for message in job_events(job_id, None, still)]

    messages = asyncio.run(collect())
    assert len(asked) == 3
    assert "event: end" not in "".join(messages)


def test_progress_is_the_weighted_mean_of_the_steps_and_never_falls(jobs):
    job_id = jobs.submit()
    ledger = Ledger(job_id, "test", "here", lambda: None)
    ledger.open()
    ledger.declare("a", "A", 3.0)
    ledger.declare("b", "B", 1.0)
    ledger.declare("a", "A again", 9.0)
    ledger.begin("a")
    ledger.record("a", ChildMessages(progress=0.5))
    assert jobs.get(job_id).progress == pytest.approx(0.375)
    ledger.begin("a")
    assert jobs.get(job_id).progress == pytest.approx(0.375)
    ledger.commit_step("a", lambda db: {})
    assert jobs.get(job_id).progress == pytest.approx(0.75)


def test_nothing_that_goes_on_has_a_hundred_per_cent(jobs):
    job_id = jobs.submit()
    ledger = Ledger(job_id, "test", "here", lambda: None)
    ledger.open()
    ledger.declare("a", "A", 1.0)
    ledger.begin("a")

    def shown():
        with new_session() as db:
            job, step = repository.get(db, job_id), repository.step(db, job_id, "a")
            return str(step.status), step.progress, str(job.status), job.progress

    ledger.record("a", ChildMessages(progress=1.0, message="update 4000 of 4000"))
    assert shown() == ("running", 0.99, "running", 0.99)
    ledger.commit_step("a", lambda db: {})
    assert shown() == ("succeeded", 1.0, "running", 0.99)


def test_a_step_is_stored_once_however_often_it_is_committed(jobs):
    job_id = jobs.submit()
    ledger = Ledger(job_id, "test", "here", lambda: None)
    ledger.open()
    ledger.declare("a", "A", 1.0)
    calls = []

    def store(db):
        calls.append(1)
        return {"n": len(calls)}

    assert [ledger.commit_step("a", store) for _ in range(3)] == [{"n": 1}] * 3
    assert ledger.begin("a") == {"ok": True, "result": {"n": 1}}


def test_nothing_more_is_recorded_for_a_job_that_was_cancelled(jobs):
    job_id = jobs.submit()
    ledger = Ledger(job_id, "test", "here", lambda: None)
    ledger.open()
    ledger.declare("a", "A", 1.0)
    with transaction("test") as db:
        repository.end_job(db, repository.locked(db, job_id), JobStatus.CANCELLED)
    with pytest.raises(JobCancelled):
        ledger.commit_step("a", lambda db: {})
    assert jobs.get(job_id).steps[0].status == "cancelled"


def test_a_worker_name_is_held_by_one_and_free_again_when_its_connection_ends(jobs):
    first, second = Identity(), Identity()
    assert (first.claim()[-2:], second.claim()[-2:]) == ("-0", "-1")
    first.release()
    third = Identity()
    assert third.claim() == first.id
    with pytest.raises(IdentityLost, match="another worker took the name"):
        first.keep()
    second.keep()
    for identity in (second, third):
        identity.release()


def test_a_sign_of_life_tells_how_long_the_worker_was_silent(jobs):
    with transaction("test") as db:
        assert repository.beat(db, "w", "host", 1, 4, "x") == 0.0
    with transaction("test") as db:
        db.execute(text("update worker set seen_at = seen_at - interval '70 seconds'"))
        assert repository.live_workers(db, 60.0) == []
        assert repository.beat(db, "w", "host", 1, 4, "x") == pytest.approx(70, abs=5)
        assert [w.id for w in repository.live_workers(db, 60.0)] == ["w"]
        repository.leave(db, "w")
        assert repository.live_workers(db, 60.0) == []


def test_folders_of_jobs_that_ended_long_ago_are_removed_and_others_kept(jobs):
    old, recent, running = jobs.submit(), jobs.submit(), jobs.submit()
    with transaction("test") as db:
        for job_id in (old, recent):
            repository.end_job(db, repository.locked(db, job_id), JobStatus.CANCELLED)
        db.execute(text("update job set finished_at = now() - interval '15 days' where id = :id"), {"id": old})
    for job_id in (old, recent, running):
        (get_settings().jobs_dir / job_id / "step").mkdir(parents=True)
    identity, runner = Identity(), JobRunner("w", 1)
    identity.claim()
    WorkerMonitor(identity, runner, Pace()).tidy()
    assert {p.name for p in get_settings().jobs_dir.iterdir()} == {recent, running}
    runner.stop(1.0)
    identity.release()


def test_a_bucket_that_hangs_does_not_make_a_worker_silent(jobs, monkeypatch):
    answers, begun = threading.Event(), []

    def hangs():
        begun.append(threading.current_thread())
        answers.wait(60)

    monkeypatch.setattr(bucket, "prune_copies", hangs)
    monkeypatch.setattr(get_settings(), "files_url", "s3://clinic")
    identity, runner = Identity(), JobRunner("w", 1)
    identity.claim()
    monitor = WorkerMonitor(identity, runner, Pace(beat_s=0.0, housekeeping_s=0.0))
    for _ in range(3):
        monitor.look()
    with new_session() as db:
        assert [w.id for w in repository.live_workers(db, 60.0)] == [identity.id]
    answers.set()
    begun[0].join(5)
    assert len(begun) == 1, "one at a time"
    runner.stop(1.0)
    identity.release()


def test_the_terminal_sees_the_job_until_it_ends(jobs):
    job_id = jobs.submit()
    views = watch(job_id, poll_s=0.01)
    assert next(views).status == "queued"
    ledger = Ledger(job_id, "test", "here", lambda: None)
    ledger.open()
    ledger.declare("a", "Part A", 1.0)
    ledger.begin("a")
    seen = next(views)
    assert (seen.status, seen.steps[0].title, seen.steps[0].status) == ("running", "Part A", "running")
    ledger.close(JobStatus.FAILED, error="broken")
    assert list(views)[-1].error == "broken"
    screen = io.StringIO()
    assert show_progress(job_id, Console(file=screen, force_terminal=True, width=100)).status == "failed"
    assert "Part A" in screen.getvalue()
