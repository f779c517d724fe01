"""A session that was stopped for the participant's sake counts as one value, in learning, evaluation and analyses alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.analysis.evidence import evidence
from app.analysis.facts import choose, of_controller
from app.analysis.primary_verdict import judged_outcome
from app.evaluation.ranking.results import driven_sessions
from app.learning.gate import decide
from app.learning.snapshots import collect, take_snapshot
from app.study.repository import participant_by_code, sessions_of_participant
from app.study.sessions.usable_steps import failed_qoc_of
from app.tables.learning import GateChoice
from app.tables.sessions import Controller
from ml.ope.scale import outcome_table
from ml.outcomes import OUTCOMES
from ml.qoc import Margins, Qoc
from ml.rl import MlpPolicy
from ml.statistics.noninferiority import FailureRule

AddSession = Callable[..., int]


@pytest.fixture
def policy(client: TestClient, participant_code: str) -> int:
    onnx = MlpPolicy(10, (8,), mean=1.0, std=0.5, seed=1).to_onnx()
    answer = client.post(f"/api/v1/participants/{participant_code}/policies", data={"name": "own"}, files={"file": ("p.onnx", onnx)})
    assert answer.status_code == 201, answer.text
    return int(answer.json()["id"])


def test_learning_evaluation_and_analyses_take_a_stopped_session_for_the_same(
    client: TestClient, db: Session, add_session: AddSession, policy: int
) -> None:
    rng = np.random.default_rng(3)

    def add(controller: str, grasp: float, rating: int, tremor: float, **fields: object) -> int:
        beta = (1.0 + 0.3 * rng.standard_normal(150)).tolist()
        return add_session(controller, beta=beta, grasp=grasp, rating=rating, tremor=tremor, **fields)

    for visit in (1, 2, 3):
        add("cdbs", 2.4, 8, 4.0, visit=visit)
        add("rl", 2.3, 7, 6.0, visit=visit, policy_id=policy)
    add("random", 1.6, 6, 30.0, fraction=0.5, visit=2)  # the slowest that counts, of neither arm
    add("random", 0.4, 2, 90.0, fraction=0.5, visit=2, excluded="cable off")
    stopped = add("rl", 2.2, 7, 5.0, visit=3, policy_id=policy, stopped="tremor came back")
    stopped_cdbs = add("cdbs", 2.1, 5, 9.0, visit=3, stopped="wanted a rest")

    participant = participant_by_code(db, "P1", SYSTEM)
    one = failed_qoc_of(sessions_of_participant(db, participant.id))
    assert one == Qoc(1.6, 1, 100.0)

    decide(db, participant, GateChoice.OPEN, "sessions of policies are learnt from here", SYSTEM)
    buffer = collect(db, participant).buffer  # learning
    learnt = {s.session_id: s.counted_qoc for s in buffer.sessions}
    assert (learnt[stopped], learnt[stopped_cdbs]) == (one, Qoc(2.1, 5, 9.0))
    row = [s.session_id for s in buffer.sessions].index(stopped)
    assert outcome_table(buffer)[row, 1:].tolist() == [1.6, 1.0, 100.0]

    ran = driven_sessions(db, take_snapshot(db, participant, SYSTEM), SYSTEM)  # evaluation
    tested = {s.session_id: s.trajectory.counted_qoc for s in ran if s.trajectory}
    assert (tested[stopped], tested[stopped_cdbs]) == (one, Qoc(2.1, 5, 9.0))

    held = evidence(db, participant, SYSTEM)  # analyses
    assert held.failed == one
    for outcome in OUTCOMES:
        chosen = choose(held.sessions, outcome.key, of_controller(Controller.RL))
        value = getattr(one, outcome.field)
        judged = judged_outcome(outcome, chosen.data, chosen.stopped, Margins().of(outcome), value)
        assert judged is not None
        at = [s.session_id for s in chosen.sessions].index(stopped)
        sign = 1.0 if outcome.higher_is_better else -1.0
        assert judged.counted(FailureRule.WORST_CASE).value[at] == sign * value
        assert judged.counted(FailureRule.END_OF_SCALE).value[at] == sign * outcome.worst_possible
        assert replace(judged, failure=None).counted(FailureRule.AS_MEASURED).value[at] != sign * value
    page = client.get("/participants/P1/analyses").text
    assert "counts as the worst that the scales allow, grasp 0, rating 1, tremor 100" in page


def test_a_slower_grasp_that_comes_later_changes_what_is_learnt_from_a_stopped_session(db: Session, add_session: AddSession) -> None:
    for visit in (1, 2):
        add_session("random", beta=[1.0, 1.1, 0.9] * 50, grasp=2.0, rating=6, tremor=10.0, fraction=0.7, visit=visit)
    add_session("random", beta=[1.0, 1.1, 0.9] * 50, grasp=2.0, rating=6, tremor=10.0, fraction=0.6, visit=2, stopped="dyskinesia")
    participant = participant_by_code(db, "P1", SYSTEM)
    before = collect(db, participant)
    assert collect(db, participant).pins_sha256 == before.pins_sha256
    add_session("cdbs", beta=None, grasp=1.1, rating=6, tremor=10.0, visit=2)  # enters no buffer, and was measured all the same
    db.expire_all()
    after = collect(db, participant)
    assert [s.counted_qoc.grasp_hz for s in (*before.buffer.sessions, *after.buffer.sessions) if s.stopped] == [2.0, 1.1]
    assert after.pins_sha256 != before.pins_sha256
