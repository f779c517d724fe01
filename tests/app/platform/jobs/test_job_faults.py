"""Faults that jobs survive: kill -9 of workers and children, orderly stops, dead and sleeping workers, a restarted database."""

from __future__ import annotations

import signal

import psutil
import psycopg
import pytest
from sqlalchemy import text

from app.platform.database import new_session, transaction
from app.platform.jobs import engine, repository, service


def _gone(process: psutil.Process) -> bool:
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def _count_until(jobs, job_id, number):
    jobs.wait(lambda: len(jobs.numbers(job_id, 0)) >= number and len(jobs.numbers(job_id, 1)) >= number)


def _two_workers(jobs, **pace):
    """Start two workers and return their names. A job that is submitted before them may be over when the second one has started."""
    started = {worker.pid: worker for worker in (jobs.start_worker(**pace), jobs.start_worker(**pace))}
    with new_session() as db:
        jobs.wait(lambda: len(repository.live_workers(db, 60.0)) == 2 or db.rollback())
        return {row.id: started[row.pid] for row in repository.live_workers(db, 60.0)}


def _worker_of(jobs, job_id):
    """Name the worker that runs a job's steps."""
    (name,) = {step.worker for step in jobs.get(job_id).steps if step.worker}
    return name


def test_a_killed_worker_takes_its_children_along_and_the_next_one_finishes_the_job(jobs):
    worker = jobs.start_worker()
    job_id = jobs.submit(parts=2, numbers=30, pause_s=0.1)
    _count_until(jobs, job_id, 6)  # a part counts a number before its checkpoint has it, so five are stored for sure
    children = jobs.children(worker)
    assert len(children) == 2
    worker.send_signal(signal.SIGKILL)
    jobs.wait(lambda: all(_gone(c) for c in children), 2.0)
    assert jobs.get(job_id).status == "running"

    jobs.start_worker()
    job = jobs.ended(job_id)
    assert job.status == "succeeded"
    assert jobs.counted(job_id) == [0, 1]
    assert min(job.result["resumed_from"]) >= 5
    assert [s.attempts for s in job.steps] == [2, 2, 1]
    for part in range(2):
        # the number in flight may be counted again (a step is at least once), its result is not
        assert sorted(set(jobs.numbers(job_id, part))) == list(range(30))
        assert len(jobs.numbers(job_id, part)) <= 31


@pytest.mark.slow
def test_an_orderly_stop_kills_the_children_and_another_worker_takes_over_at_once(jobs):
    workers = _two_workers(jobs)  # stale after 60 s: the other one must not have to wait for that
    job_id = jobs.submit(parts=2, numbers=40, pause_s=0.1)
    _count_until(jobs, job_id, 3)
    stopped = workers.pop(_worker_of(jobs, job_id))
    children = jobs.children(stopped)
    assert len(children) == 2
    stopped.send_signal(signal.SIGTERM)
    assert stopped.wait(300) == 0
    assert all(_gone(c) for c in children)
    job = jobs.ended(job_id, 50)
    assert (job.status, jobs.counted(job_id)) == ("succeeded", [0, 1])
    assert {s.worker for s in job.steps} == set(workers)
    with new_session() as db:
        assert db.scalar(text("select recovery_attempts from dbos.workflow_status where workflow_uuid = :id"), {"id": job_id}) == 1


@pytest.mark.slow
def test_a_live_worker_takes_the_jobs_of_one_that_fell_silent(jobs):
    workers = _two_workers(jobs, stale_s=3.0)
    job_id = jobs.submit(parts=2, numbers=40, pause_s=0.1)
    _count_until(jobs, job_id, 3)
    workers.pop(_worker_of(jobs, job_id)).send_signal(signal.SIGKILL)
    job = jobs.ended(job_id)
    assert (job.status, jobs.counted(job_id)) == ("succeeded", [0, 1])
    assert {s.worker for s in job.steps} == set(workers)
    assert [w.poll() for w in workers.values()] == [None]


@pytest.mark.slow
def test_a_worker_that_was_frozen_drops_the_jobs_that_another_took_over(jobs):
    first = jobs.start_worker(stale_s=2.0)
    job_id = jobs.submit(parts=2, numbers=60, pause_s=0.1)
    _count_until(jobs, job_id, 3)
    frozen = [psutil.Process(first.pid), *jobs.children(first)]
    second = jobs.start_worker(stale_s=2.0)
    for process in frozen:
        process.suspend()
    jobs.wait(lambda: jobs.get(job_id).steps[0].attempts == 2, 20)
    for process in frozen:
        process.resume()
    jobs.wait(lambda: all(_gone(c) for c in frozen[1:]), 10)
    job = jobs.ended(job_id, 60)
    assert (job.status, jobs.counted(job_id)) == ("succeeded", [0, 1])
    assert (first.poll(), second.poll()) == (None, None)


@pytest.mark.slow
def test_two_workers_share_the_queue(jobs):
    jobs.start_worker(slots=1)
    jobs.start_worker(slots=1)
    with new_session() as db:
        jobs.wait(lambda: len(repository.live_workers(db, 60.0)) == 2 or db.rollback())
    ids = [jobs.submit(parts=1, numbers=5, pause_s=0.2) for _ in range(4)]
    workers = {jobs.ended(i).steps[0].worker for i in ids}
    assert len(workers) == 2
    assert all(jobs.counted(i) == [0] for i in ids)


@pytest.mark.slow
def test_a_job_that_nobody_runs_any_more_is_cancelled_at_once(jobs):
    worker = jobs.start_worker()
    job_id = jobs.submit(parts=1, numbers=1000, pause_s=0.1)
    jobs.wait(lambda: jobs.numbers(job_id, 0))
    worker.send_signal(signal.SIGTERM)
    worker.wait(300)
    with transaction("test") as db:
        assert service.cancel(db, repository.get(db, job_id), "test").status == "cancelled"
    counted = len(jobs.numbers(job_id, 0))
    jobs.start_worker()
    jobs.ended(jobs.submit(parts=1, numbers=1))
    assert jobs.get(job_id).status == "cancelled"
    assert len(jobs.numbers(job_id, 0)) == counted


@pytest.mark.slow
def test_jobs_of_an_older_protocol_are_moved_and_their_finished_steps_kept(jobs):
    worker = jobs.start_worker()
    job_id = jobs.submit(parts=2, numbers=20, pause_s=0.1)
    _count_until(jobs, job_id, 3)
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    with transaction("test") as db:
        db.execute(text("update dbos.workflow_status set application_version = '0' where workflow_uuid = :id"), {"id": job_id})
    jobs.start_worker()
    assert jobs.ended(job_id).status == "succeeded"
    assert jobs.counted(job_id) == [0, 1]
    with new_session() as db:
        version = db.scalar(text("select application_version from dbos.workflow_status where workflow_uuid = :id"), {"id": job_id})
    assert version == str(engine.PROTOCOL)


@pytest.mark.slow
def test_broken_database_connections_fail_no_job_and_stop_no_worker(jobs):
    worker = jobs.start_worker()
    job_id = jobs.submit(parts=2, numbers=40, pause_s=0.1)
    for number in (3, 15):
        _count_until(jobs, job_id, number)
        with new_session() as db:
            broken = db.scalars(
                text(
                    "select pg_terminate_backend(pid) from pg_stat_activity"
                    " where datname = current_database() and usename = current_user and pid <> pg_backend_pid()"
                )
            ).all()
        assert len(broken) >= 3
    job = jobs.ended(job_id, 60)
    assert (job.status, jobs.counted(job_id)) == ("succeeded", [0, 1])
    assert [s.attempts for s in job.steps] == [1, 1, 1]
    assert worker.poll() is None


@pytest.mark.slow
def test_a_job_that_kills_every_worker_is_given_up(jobs):
    job_id = jobs.submit("fail", how="kills worker")
    for _ in range(engine.MAX_RECOVERIES + 1):
        worker = jobs.start_worker()
        assert worker.wait(300) == -signal.SIGKILL
    survivor = jobs.start_worker()
    job = jobs.ended(job_id)
    assert job.status == "failed"
    assert "The worker died 4 times while it ran this job" in job.error
    assert survivor.poll() is None


@pytest.mark.slow
def test_rounds_of_kill_nine_at_any_moment_lose_and_double_nothing(jobs):
    job_ids = [jobs.submit(parts=3, numbers=10, pause_s=0.05) for _ in range(3)]
    for wait_s in (2.5, 3.1, 3.7):
        worker = jobs.start_worker()
        try:
            worker.wait(wait_s)
        except Exception:
            worker.send_signal(signal.SIGKILL)
            worker.wait()
    jobs.start_worker()
    for job_id in job_ids:
        job = jobs.ended(job_id, 60)
        assert (job.status, job.error, jobs.counted(job_id)) == ("succeeded", None, [0, 1, 2])


def test_a_worker_runs_a_job_again_that_is_its_own_and_does_not_run(jobs):
    """As a database leaves it that took no writes when the engine had a job: no other worker would ever take it."""
    jobs.start_worker()
    with new_session() as db:
        jobs.wait(lambda: repository.live_workers(db, 60.0) or db.rollback())
        (worker,) = repository.live_workers(db, 60.0)
    with transaction("test") as db:
        job_id = service.submit(db, "count", None, {"parts": 1, "numbers": 1}, "test").id
        mine = "update dbos.workflow_status set status = 'PENDING', executor_id = :worker, application_version = :version"
        db.execute(text(f"{mine} where workflow_uuid = :id"), {"worker": worker.id, "version": str(engine.PROTOCOL), "id": job_id})
    job = jobs.ended(job_id)
    assert (job.status, jobs.counted(job_id)) == ("succeeded", [0])


@pytest.mark.slow
def test_a_database_that_takes_no_writes_for_a_while_fails_no_job(jobs, server):
    jobs.start_worker()
    job_id = jobs.submit(parts=2, numbers=20, pause_s=0.1)
    _count_until(jobs, job_id, 3)
    try:
        with psycopg.connect(server.admin_conninfo(), autocommit=True) as admin:
            admin.execute("alter system set default_transaction_read_only = on")
            admin.execute("select pg_reload_conf()")
        waiting = jobs.log.read_text().count("the database is away")
        jobs.wait(lambda: jobs.log.read_text().count("the database is away") > waiting + 1)
    finally:
        with psycopg.connect(server.admin_conninfo(), autocommit=True) as admin:
            admin.execute("alter system reset default_transaction_read_only")
            admin.execute("select pg_reload_conf()")
    job = jobs.ended(job_id)
    assert (job.status, jobs.counted(job_id)) == ("succeeded", [0, 1])
