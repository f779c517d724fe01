"""The job before a visit of the simulated study: what it goes on from is chosen as for any participant, by the posterior."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from dataclasses import replace

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.snapshots import take_snapshot
from app.pipeline.next_generation import outlook
from app.simulation.design import PRESETS, Design, Remembered
from app.simulation.loop import ParticipantLoop, Signer
from app.study.repository import participant_by_code
from app.tables.jobs import Job
from app.tables.learning import Policy
from app.tables.participants import Participant
from tests.app.evaluations import judge as judge
from tests.app.evaluations import judged
from tests.app.evaluations import policies as policies
from tests.app.simulation.test_slots_filled import Silent

DESIGN = Design(participants=("P1",), visits=3, seed=3, preset=PRESETS["quick"])
TUNES = 3
"""The visit of this design whose job fine-tunes."""


@pytest.fixture
def loop() -> ParticipantLoop:
    return ParticipantLoop("P1", DESIGN, Remembered(3, {}, dt.date(2024, 3, 4)), SYSTEM, Signer(SYSTEM, "-"), Silent(), lambda: None)


@pytest.fixture
def person(client: TestClient, db: Session, policies: list[int], upload: Callable[..., int]) -> Participant:
    """P1 with three policies that can be trained further; the first two ran in a session of visit 2."""
    snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    db.execute(update(Policy).where(Policy.id.in_(policies)).values(kind="trained", algorithm="ddpg", snapshot_id=snapshot.id))
    db.commit()
    client.post("/api/v1/participants/P1/visits", json={"number": 2})
    low, high = {"grasp_hz": 1.0, "rating": 2, "tremor_percent": 80.0}, {"grasp_hz": 3.0, "rating": 10, "tremor_percent": 0.0}
    upload("rl", visit=2, policy=str(policies[0]), qoc=high)
    upload("rl", visit=2, policy=str(policies[1]), qoc=low)
    return participant_by_code(db, "P1", SYSTEM)


def test_the_loop_fine_tunes_the_best_by_the_posterior_and_not_by_the_mean_of_what_sessions_returned(
    loop: ParticipantLoop, db: Session, person: Participant, policies: list[int], judge: Callable[..., int]
) -> None:
    judge({policies[0]: judged(80.0), policies[1]: judged(95.0), policies[2]: judged(99.0)})
    job = loop._start(db, person, TUNES)
    assert (job.kind, job.params["parents"], job.params["count"]) == ("next_generation", 1, 4)
    assert outlook(db, person, SYSTEM).parents(1) == [policies[1]], "the first returned more in its one session"


def test_another_visit_and_one_before_any_test_train_from_scratch(
    loop: ParticipantLoop, db: Session, person: Participant, policies: list[int]
) -> None:
    scratch = loop._start(db, person, TUNES - 1)
    assert (scratch.kind, scratch.params["policies"]) == ("pipeline", [])
    db.execute(update(Policy).where(Policy.id.in_(policies)).values(kind="external"))
    untested = replace(loop, design=replace(DESIGN, seed=4))._start(db, person, TUNES)
    assert (untested.kind, untested.params["policies"]) == ("pipeline", [])


def test_a_study_that_goes_on_takes_the_jobs_of_both_kinds_that_were_begun(loop: ParticipantLoop, db: Session, person: Participant) -> None:
    for visit in (TUNES - 1, TUNES):
        job = loop._start(db, person, visit)
        db.execute(update(Job).where(Job.id == job.id).values(status="succeeded", started_at=func.now(), finished_at=func.now()))
        db.commit()
    for visit in (TUNES - 1, TUNES):
        loop._learn(db, person, visit)
    assert db.scalars(select(Job.kind).order_by(Job.created_at)).all() == ["pipeline", "next_generation"]
