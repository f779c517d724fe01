"""A whole small study through the service: killed twice, gone on with, and checked against the paper's rules."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import func, select

from app.accounts.permissions import SYSTEM
from app.analysis.pooled import trial_time
from app.evaluation.ranking.results import driven_sessions, results_by_policy
from app.platform.audit.signatures import signatures_of
from app.platform.database import new_session
from app.platform.errors import Conflict
from app.settings import get_settings
from app.simulation.design import STATE_FILE, design
from app.simulation.run import ACCOUNT, SIGNER, simulate
from app.study import repository as study
from app.study.blinding import arm
from app.study.sessions.usable_steps import session_data
from app.study.settings import mdp_settings
from app.tables.audit import AuditEvent
from app.tables.evaluations import Evaluation
from app.tables.jobs import Job, JobStatus
from app.tables.learning import BufferSnapshot
from app.tables.outcomes import QocRevision
from app.tables.plans import BundleRelease, DayEntry, Plan
from app.tables.recordings import Recording
from app.tables.sessions import Controller, StudySession
from app.tables.uploads import UploadFile

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = """
import sys
from app.simulation.design import Design, Preset
from app.simulation.run import simulate

size = Preset(
    visits=2, random_visits=1, random_sessions=1, session_minutes=5, policies_per_kind=1,
    pipeline={"preset": "quick", "count": 1, "updates": 20, "distil_updates": 20, "methods": ["linear", "wis"]},
)
simulate(Design(participants=("P2",), visits=2, seed=3, preset=size), slots=1)
"""


def start() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", PROGRAM], cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, stderr=subprocess.PIPE)


def kill_when(reached: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + 120
    while not reached():
        assert process.poll() is None, process.communicate()[1].decode()[-3000:]
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.communicate()


def count(query) -> int:
    with new_session() as db:
        return db.scalar(query)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_simulated_study_that_is_killed_goes_on_with_nothing_lost_and_nothing_twice(fresh_database):
    kill_when(lambda: count(select(func.count()).select_from(StudySession)) >= 2, start())
    kill_when(lambda: count(select(func.count()).select_from(Job).where(Job.status == JobStatus.RUNNING)) >= 1, start())
    last = start()
    assert last.wait(600) == 0, last.communicate()[1].decode()[-3000:]

    with new_session() as db:
        person = study.participant_by_code(db, "P2", SYSTEM)
        held = study.sessions_of_participant(db, person.id)
        assert [(s.visit.number, s.ordinal) for s in held] == [(v, i) for v, n in ((1, 3), (2, 4)) for i in range(1, n + 1)]
        arms = [arm(s, SYSTEM).controller for s in held]
        assert arms[:3] == [Controller.CDBS, Controller.RANDOM, Controller.NO_DBS]
        (random,) = [s for s, a in zip(held, arms, strict=True) if a == Controller.RANDOM]
        assert random.conditions.design == "stratified"
        planned = random.conditions.design_parameters
        assert sum(h["steps"] for h in planned["holds"]) == 150
        fraction = session_data(db, random).table.fraction[-150:]
        wanted = np.repeat([h["amplitude"] for h in planned["holds"]], [h["steps"] for h in planned["holds"]])
        assert np.abs(fraction - wanted).max() <= 1e-5  # no amplitude of the design is below the limits that were signed
        learned = [i for i, c in enumerate(arms) if c in (Controller.RL, Controller.DISTILLED)]
        assert {arms[i] for i in learned} == {Controller.RL, Controller.DISTILLED}
        assert all(Controller.CDBS in arms[i:j] for i, j in pairwise(learned))
        assert arms[-1] == Controller.NO_DBS
        assert all(s.duration_s == 300 for s in held)
        assert (held[3].visit.date - held[0].visit.date).days == 28

        assert db.scalar(select(func.count()).select_from(Recording)) == 7
        assert db.scalar(select(func.count()).select_from(UploadFile).where(UploadFile.status == "decoded")) == 7
        # rating and grasp from the clinic day, then tremor from the watch
        assert sorted(db.scalars(select(QocRevision.revision))) == [1] * 7 + [2] * 7
        assert db.scalar(select(func.count()).select_from(DayEntry)) == 7 * 8 + 2
        assert db.scalars(select(Job.status).where(Job.kind == "pipeline")).all() == [JobStatus.SUCCEEDED]
        first, plan = db.scalars(select(Plan).order_by(Plan.id)).all()
        for one in (first, plan):
            assert (one.status, one.approved_by) == ("approved", SIGNER)
            (signature,) = signatures_of(db, "plan", one.id)
            assert (signature.signer, one.created_by) == (SIGNER, ACCOUNT)
        slots = [item.id for item in (*first.items, *plan.items)]
        assert [s.plan_item_id for s in held] == slots, "each session is in its slot"
        with_bundle = {item.id for item in (*first.items, *plan.items) if item.controller != "no_dbs"}
        assert set(db.scalars(select(BundleRelease.plan_item_id))) == with_bundle
        assert plan.evaluation_id == db.scalar(select(func.max(Evaluation.id)))
        actors = set(db.scalars(select(AuditEvent.actor).where(AuditEvent.entity.in_(("participant", "visit", "session", "plan")))))
        assert ACCOUNT in actors

        ran = [s for s in held if arm(s, SYSTEM).policy_id is not None]
        estimated = {e.policy_id for e in db.get_one(Evaluation, plan.evaluation_id).estimates}
        assert {arm(s, SYSTEM).policy_id for s in ran} <= estimated  # what the figure of estimates against actual returns is drawn from
        evaluation = db.get_one(Evaluation, plan.evaluation_id)
        held_against = driven_sessions(db, db.get_one(BufferSnapshot, evaluation.snapshot_id), SYSTEM)
        returned = results_by_policy(held_against, mdp_settings(person.current_settings), evaluation.horizon_steps, None)
        assert {policy: told.sessions_with_return for policy, told in returned.items()} == {arm(s, SYSTEM).policy_id: 1 for s in ran}
        table = {t.controller: (t.sessions, t.minutes) for t in trial_time(db, [person], SYSTEM).rows[0].tested}
        assert table[Controller.CDBS] == (2, 10)
        assert table[Controller.RL] == table[Controller.DISTILLED] == (1, 5)
        assert table[Controller.NO_DBS] == (2, 10)


def test_a_participant_that_people_enrolled_is_left_alone(participant_code, db):
    with pytest.raises(Conflict, match="P1 was enrolled by"):
        simulate(design(["P1"], 2, 0, "quick"), slots=1)
    assert db.scalar(select(func.count()).select_from(StudySession)) == 0
    assert not (get_settings().data_dir / STATE_FILE).exists()
