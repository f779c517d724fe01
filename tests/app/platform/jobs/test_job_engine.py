"""Contract of the workflow engine, its private recovery call included: fails when a new version behaves differently."""

from __future__ import annotations

import hashlib
import json
import logging
import threading
import time
from datetime import timedelta
from importlib.metadata import version

import pytest
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform.database import get_engine, new_session, transaction
from app.platform.jobs import engine, registry
from app.platform.jobs.context import WorkerStopping


@pytest.fixture
def ran(fresh_database):
    """An executor in this process that notes the jobs which it runs."""
    engine.prepare(fresh_database)
    ids: list[str] = []
    gate = threading.Event()
    gate.set()

    def run(job_id: str) -> None:
        gate.wait(10)
        if job_id.startswith("stops"):
            raise WorkerStopping
        ids.append(job_id)

    yield ids, gate, lambda name="live": engine.launch(fresh_database, name, 1, run)
    gate.set()
    engine.shutdown()


def _row(job_id, *columns):
    with new_session() as db:
        query = text(f"select {', '.join(columns)} from dbos.workflow_status where workflow_uuid = :id")
        return tuple(db.execute(query, {"id": job_id}).one())


def _enqueue(*job_ids, priority=50, **columns):
    with transaction("test") as db:
        for job_id in job_ids:
            engine.enqueue(db, job_id, priority)
            for column, value in columns.items():
                db.execute(
                    text(f"update dbos.workflow_status set {column} = :value where workflow_uuid = :id"), {"value": value, "id": job_id}
                )


def _wait(condition):
    pause = threading.Event()
    for _ in range(200):
        if condition():
            return
        pause.wait(0.05)
    raise AssertionError("nothing happened within 10 s")


def test_the_version_is_one_that_these_tests_were_written_for():
    major, minor, *_ = (int(part) for part in version("dbos").split(".")[:2])
    assert (major, minor) >= (3, 4)
    assert major < 4


def test_recovery_requeues_jobs_of_dead_executors_and_no_others(ran):
    ids, _, launch = ran
    _enqueue("dead", status="PENDING", executor_id="gone", application_version=str(engine.PROTOCOL))
    _enqueue("alive", status="PENDING", executor_id="other", application_version=str(engine.PROTOCOL))
    _enqueue("cancelled", status="CANCELLED", executor_id="gone", application_version=str(engine.PROTOCOL))
    launch()
    assert engine.recover(["gone"]) == ["dead"]
    assert engine.recover(["gone"]) == []
    _wait(lambda: ids == ["dead"])
    _wait(lambda: _row("dead", "status", "executor_id") == ("SUCCESS", "live"))
    assert _row("alive", "status", "executor_id") == ("PENDING", "other")
    assert _row("cancelled", "status") == ("CANCELLED",)


def test_a_restarted_executor_takes_its_own_interrupted_jobs_again(ran):
    ids, _, launch = ran
    _enqueue("mine", status="PENDING", executor_id="live", application_version=str(engine.PROTOCOL), recovery_attempts=1)
    launch()
    _wait(lambda: ids == ["mine"])
    assert _row("mine", "recovery_attempts") == (2,)


def test_lower_numbers_go_first_and_every_job_has_one(ran):
    ids, _, launch = ran
    _enqueue("batch", priority=90)
    _enqueue("normal", priority=50)
    _enqueue("before", priority=40)
    launch()
    _wait(lambda: len(ids) == 3)
    assert ids == ["before", "normal", "batch"]


def test_what_a_person_waits_for_runs_beside_as_many_other_jobs_as_a_worker_takes(ran):
    ids, gate, launch = ran
    gate.clear()
    _enqueue("normal")
    launch()
    _wait(lambda: _row("normal", "status") == ("PENDING",))
    _enqueue("interactive", priority=10)
    _wait(lambda: _row("interactive", "status") == ("PENDING",))
    assert ids == []


def test_a_worker_runs_its_own_protocol_and_adopts_older_ones_that_no_live_worker_speaks(ran):
    ids, _, launch = ran
    _enqueue("own")
    _enqueue("old", application_version=str(engine.PROTOCOL - 1))
    _enqueue("newer", application_version=str(engine.PROTOCOL + 1))
    launch()
    _wait(lambda: ids == ["own"])
    with transaction("test") as db:
        assert engine.adopt_older_protocols(db, {engine.PROTOCOL - 1, engine.PROTOCOL}) == []
        assert engine.adopt_older_protocols(db, {engine.PROTOCOL}) == ["old"]
        assert engine.adopt_older_protocols(db, {engine.PROTOCOL}) == []
    _wait(lambda: ids == ["own", "old"])
    assert _row("newer", "status", "application_version") == ("ENQUEUED", str(engine.PROTOCOL + 1)), "it is for newer workers"
    with transaction("test") as db:
        assert engine.take_back(db) == ["newer"]
    _wait(lambda: ids == ["own", "old", "newer"])


def test_the_start_of_a_newer_worker_strands_no_later_job_of_this_version(ran, fresh_database, monkeypatch):
    ids, _, launch = ran
    with monkeypatch.context() as newer:
        newer.setattr(engine, "PROTOCOL", engine.PROTOCOL + 1)
        launch("newer")
        engine.shutdown()
    launch()
    _enqueue("later")
    _wait(lambda: ids == ["later"])
    assert _row("later", "application_version") == (str(engine.PROTOCOL),), "of this version, whatever a newer one left behind"


def test_params_of_a_kind_change_with_the_protocol():
    schemas = {
        name: kind.params.model_json_schema() for name, kind in sorted(registry.kinds().items()) if kind.orchestration.startswith("app.")
    }
    digest = hashlib.sha256(json.dumps(schemas, sort_keys=True).encode()).hexdigest()[:12]
    assert (engine.PROTOCOL, digest) == (5, "08dd74d3f1c7"), (
        "a worker of before cannot run these params: raise engine.PROTOCOL, and note both here"
    )


def test_a_stopping_worker_leaves_its_job_pending_and_takes_back_the_attempt(ran):
    _, _, launch = ran
    launch()
    _enqueue("stops-here")
    _wait(lambda: _row("stops-here", "status", "executor_id") == ("PENDING", "live"))
    assert _row("stops-here", "recovery_attempts") == (1,)
    with transaction("test") as db:
        assert engine.owners(db) == {"stops-here": "live"}
        engine.forgive_attempt(db, "live")
    assert _row("stops-here", "status", "recovery_attempts", "error") == ("PENDING", 0, None)


def test_what_ended_is_told_apart_and_deleted_when_it_is_old(ran, fresh_database):
    ids, _, launch = ran
    launch()
    _enqueue("done", "late")
    _enqueue("waits", application_version="0")
    _wait(lambda: set(ids) == {"done", "late"})
    _wait(lambda: _row("late", "status") == ("SUCCESS",))
    with transaction("test") as db:
        assert engine.ended(db, ["done", "waits", "never"]) == {"done": "SUCCESS", "never": "GONE"}
        db.execute(text("update dbos.workflow_status set completed_at = completed_at - 86400000 * 15 where workflow_uuid = 'done'"))
    assert engine.delete_finished(fresh_database, timedelta(days=14)) == 1
    with new_session() as db:
        assert set(db.scalars(text("select workflow_uuid from dbos.workflow_status"))) == {"late", "waits"}


def test_what_is_stored_is_json_and_reads_back_the_same(ran):
    serializer = engine.JsonSerializer()
    assert serializer.deserialize(serializer.serialize({"args": ("id",), "kwargs": {}})) == {"args": ("id",), "kwargs": {}}
    assert serializer.deserialize(serializer.serialize({"a": [1, 2.5, None, "x"]})) == {"a": [1, 2.5, None, "x"]}
    assert str(serializer.deserialize(serializer.serialize(KeyError("gone")))) == "KeyError: 'gone'"
    with pytest.raises(TypeError, match="object is not JSON"):
        serializer.serialize(object())
    _enqueue("job", application_version="0")
    assert _row("job", "serialization") == ("betaloop_json",)
    with new_session() as db:
        assert db.scalar(text("select inputs from dbos.workflow_input")) == '{"args": ["job"], "kwargs": {}}'


def test_tracebacks_of_cancelled_workflows_are_dropped_and_others_kept():
    class SomeCancelledError(Exception):
        pass

    def record(error):
        return logging.LogRecord("dbos", logging.ERROR, __file__, 1, "a workflow failed", None, (type(error), error, None))

    assert not engine.CancelNoise().filter(record(SomeCancelledError()))
    assert engine.CancelNoise().filter(record(ValueError()))


def test_an_idle_process_keeps_two_connections_of_a_burst(owner_db: Session) -> None:
    get_engine().dispose()
    burst = [get_engine().connect() for _ in range(7)]
    ours = [connection.scalar(text("select pg_backend_pid()")) for connection in burst]
    for connection in burst:
        connection.close()
    count = text("select count(*) from pg_stat_activity where pid = any(:pids)")
    deadline = time.monotonic() + 300
    while (left := owner_db.scalar(count, {"pids": ours})) > 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    assert left == 2


def test_the_engine_of_an_idle_worker_keeps_few_connections(jobs, owner_db: Session) -> None:
    jobs.start_worker(slots=4)
    for job_id in [jobs.submit(parts=1) for _ in range(4)]:
        assert jobs.ended(job_id).status == "succeeded"
    count = text("select count(*) from pg_stat_activity where datname = current_database() and application_name = 'dbos_transact'")

    def few() -> bool:
        owner_db.rollback()
        return 1 <= owner_db.scalar(count) <= 3  # one listens, two are kept

    jobs.wait(few)
