"""The order of the queue: studies take turns, participants within them, and what a person waits for begins before all else."""

from __future__ import annotations

import time

import pytest
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.platform.database import new_session, transaction
from app.platform.jobs import Priority, repository, service
from app.tables.jobs import JobStatus


@pytest.fixture
def people(jobs, owner_db: Session) -> dict[str, int]:
    """Participants of two studies by code: P1 and P2 of one, Q1 of the other."""
    study, site = "insert into study (code, name) values (:code, :code) returning id", "insert into site (study_id, code, name)"
    found = {}
    for code, names in (("A", ("P1", "P2")), ("B", ("Q1",))):
        of_study = owner_db.scalar(text(study), {"code": code})
        of_site = owner_db.scalar(text(f"{site} values (:study, :code, :code) returning id"), {"study": of_study, "code": code})
        for name in names:
            made = text("insert into participant (site_id, code) values (:site, :code) returning id")
            found[name] = owner_db.scalar(made, {"site": of_site, "code": name})
    owner_db.commit()
    return found


def submit(participant: int, count: int = 1, urgency: int = Priority.NORMAL, **params: object) -> list[str]:
    """Ask for jobs of one participant, each in a transaction of its own."""
    ids = []
    for _ in range(count):
        with transaction("test") as db:
            asked = {"parts": 1, "numbers": 1, **params}
            ids.append(service.submit(db, "count", participant, asked, "test", urgency=urgency).id)
    return ids


def in_order() -> list[str]:
    """List codes of participants in the order in which their waiting jobs begin."""
    of_job = "select p.code from job j join participant p on p.id = j.participant_id"
    query = f"{of_job} where j.status = 'queued' order by urgency, place, j.created_at"
    with new_session() as db:
        return list(db.scalars(text(query)))


def test_studies_take_turns_and_participants_within_a_study(people: dict[str, int]) -> None:
    submit(people["P1"], 6)
    submit(people["P2"], 2)
    submit(people["Q1"], 2)
    submit(people["Q1"], urgency=Priority.INTERACTIVE)
    assert in_order() == ["Q1", "P1", "Q1", "P1", "P2", "Q1", "P1", "P1", "P2", "P1", "P1"], "a person waits for the first"


def test_a_study_that_keeps_asking_does_not_hold_up_another(people: dict[str, int]) -> None:
    waiting = submit(people["P1"], 3)
    for _ in range(5):
        submit(people["Q1"])
        with transaction("test") as db:
            first = db.execute(text("select id from job where status = 'queued' order by urgency, place, created_at limit 1")).scalar_one()
            repository.end_job(db, repository.locked(db, first), JobStatus.CANCELLED)
    with new_session() as db:
        assert all(repository.get(db, job_id).status == "cancelled" for job_id in waiting[:2])


def test_the_page_of_a_waiting_job_knows_what_is_before_it(people: dict[str, int]) -> None:
    submit(people["P1"], 3)
    (last,) = submit(people["P1"])
    with new_session() as db:
        assert service.in_queue(db, repository.get(db, last)) == (3, None), "no job of the kind has ever run"
    with transaction("test") as db:
        done = "update job set status = 'succeeded', started_at = now() - interval '80 seconds', finished_at = now() where id = :id"
        db.execute(text(done), {"id": submit(people["P2"])[0]})
    with new_session() as db:
        assert service.in_queue(db, repository.get(db, last)) == (3, pytest.approx(240))


def test_what_a_person_waits_for_begins_after_one_step_whatever_else_waits(jobs, people: dict[str, int]) -> None:
    jobs.start_worker(slots=1)
    long = submit(people["P1"], 3, Priority.BATCH, parts=40, numbers=2, pause_s=0.3)
    jobs.wait(lambda: jobs.get(long[0]).started_at)
    begun = sum(step.started_at is not None for step in jobs.get(long[0]).steps)
    (urgent,) = submit(people["Q1"], 1, Priority.INTERACTIVE)
    jobs.wait(lambda: any(step.started_at for step in jobs.get(urgent).steps))
    asked, started = jobs.get(urgent).created_at, min(s.started_at for s in jobs.get(urgent).steps if s.started_at)
    between = [s for i in long for s in jobs.get(i).steps if s.started_at is not None and asked < s.started_at < started]
    assert jobs.get(long[0]).status == "running", "it did not have to end before"
    assert begun + len(between) < 40


def test_asking_for_two_hundred_jobs_is_quick(people: dict[str, int]) -> None:
    begun = time.process_time()
    submit(people["P1"], 200, Priority.BATCH)
    assert (time.process_time() - begun) / 200 < 0.05, "processor time of the service for each"
