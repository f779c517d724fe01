"""Sweeps go by the posterior with what tested sessions showed, as the ranking does."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.schemas import TrainParams
from app.learning.snapshots import take_snapshot
from app.learning.training_compute import known_tests, stored_gains
from app.learning.training_configs import training_groups
from app.learning.trajectories import read_buffer
from app.pipeline import next_generation, training
from app.pipeline.stages import snapshot_facts
from app.pipeline.training import training_calls, training_plan
from app.platform import files
from app.study.repository import participant_by_code
from app.tables.evaluations import Evaluation
from app.tables.learning import Policy
from ml.ope.registry import POSTERIOR
from ml.policies.policy import ConstantPolicy
from tests.app.evaluations import policies as policies


def test_every_step_of_a_training_knows_what_tested_sessions_showed_and_gains_move_by_it(
    client: TestClient, db: Session, policies: list[int], upload: Callable[..., int]
) -> None:
    client.post("/api/v1/participants/P1/visits", json={"number": 2})
    for k in range(3):
        upload("cdbs", visit=2, qoc={"grasp_hz": 2.9 + 0.1 * k, "rating": 9, "tremor_percent": 5.0})
        upload("rl", visit=2, policy=str(policies[1]), qoc={"grasp_hz": 1.0 + 0.1 * k, "rating": 1, "tremor_percent": 90.0})
    snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    params = TrainParams(count=2)
    planned = {"snapshot": snapshot_facts(db, snapshot)} | training_plan(db, snapshot, params, SYSTEM)
    tested = planned["tested_so_far"]
    assert ([p["id"] for p in tested["policies"]], len(tested["tests"])) == ([policies[1]], 1), "what nobody tested tells nothing"
    calls = training_calls(params, planned, training_groups(params, planned["starts"]))
    assert {name for _, name, _ in calls} == {"train", "baselines"}
    assert all(json.loads(json.dumps(call))["tested"] == tested for _, _, call in calls), "as a job stores it"

    buffer = read_buffer(snapshot.file_sha256)
    like_it = {"0": ConstantPolicy(0.6)}  # as the tested one acts
    blind, told = (
        stored_gains(buffer, like_it)["0"],
        stored_gains(buffer, like_it, None, known_tests(calls[0][2]["tested"], buffer))["0"],
    )
    assert blind is not None
    assert told is not None
    assert told["value"] < blind["value"]
    assert told["standard_error"] < blind["standard_error"]
    before = stored_gains(buffer, like_it, None, known_tests(None, buffer))["0"]
    assert before == blind, "without tests"


def retire(client: TestClient, policy_id: int) -> None:
    assert client.patch(f"/api/v1/policies/{policy_id}", json={"retired_reason": "tremor came back"}).status_code == 200


def test_a_retired_policy_is_evidence_as_before_and_no_parent_and_one_without_its_file_is_left_out(
    client: TestClient, db: Session, policies: list[int], upload: Callable[..., int]
) -> None:
    client.post("/api/v1/participants/P1/visits", json={"number": 2})
    for controller, more in (("cdbs", {}), ("cdbs", {}), ("rl", {"policy": str(policies[1])})):
        upload(controller, visit=2, **more)
    participant = participant_by_code(db, "P1", SYSTEM)
    snapshot = take_snapshot(db, participant, SYSTEM)
    row = db.get_one(Policy, policies[1])
    row.kind, row.algorithm, row.snapshot_id = "trained", "ddpg", snapshot.id
    db.commit()
    before = training.tested_so_far(db, snapshot, SYSTEM)
    assert [p["id"] for p in before["policies"]] == [policies[1]]
    assert [t.policy.id for t in next_generation.tested_policies(db, participant)] == [policies[1]]
    db.commit()
    retire(client, policies[1])
    db.expire_all()
    assert training.tested_so_far(db, snapshot, SYSTEM) == before
    assert next_generation.tested_policies(db, participant) == []
    files.path_of(db.get_one(Policy, policies[1]).onnx_sha256).unlink()
    assert training.tested_so_far(db, snapshot, SYSTEM) == {"tests": [], "policies": []}


@pytest.fixture
def policies_then_worker(policies: list[int], request: pytest.FixtureRequest) -> list[int]:
    """A worker that begins earlier would hold the database that the policies are copied from."""
    request.getfixturevalue("worker")
    return policies


@pytest.mark.slow
def test_an_evaluation_of_one_policy_knows_what_others_showed_and_says_which_sessions_it_does_not_know(
    client: TestClient, db: Session, policies_then_worker: list[int], upload: Callable[..., int], ended: Callable[..., dict[str, Any]]
) -> None:
    """The first two are like each other in what they do; the second is retired after a bad test, the third's file is lost."""
    like_it, retired, lost = policies_then_worker
    client.post("/api/v1/participants/P1/visits", json={"number": 2})
    for k in range(2):
        upload("cdbs", visit=2, qoc={"grasp_hz": 2.9 + 0.1 * k, "rating": 9, "tremor_percent": 5.0})
        upload("rl", visit=2, policy=str(lost))
    asked = {"kind": "evaluate", "preset": "quick", "methods": ["linear"], "policies": [like_it], "again": True}

    def posterior_of_it() -> tuple[float, list[dict[str, Any]], set[int]]:
        done = ended(client.post("/api/v1/participants/P1/jobs", json=asked).json()["id"], 200)
        assert done["status"] == "succeeded", done
        db.expire_all()
        rows = [row for row in db.get_one(Evaluation, done["result"]["evaluation_id"]).estimates if row.method == POSTERIOR]
        (own,) = (row for row in rows if row.policy_id == like_it)
        return own.predicted["rating"], [f for f in own.flags if f["code"] == "tests_not_counted"], {row.policy_id for row in rows}

    rating, said, estimated = posterior_of_it()
    assert (said, estimated & {retired, lost}) == ([], set())
    for _ in range(3):
        upload("rl", visit=2, policy=str(retired), qoc={"grasp_hz": 0.5, "rating": 1, "tremor_percent": 95.0})
    retire(client, retired)
    files.path_of(db.get_one(Policy, lost).onnx_sha256).unlink()
    after, said, estimated = posterior_of_it()
    assert after < rating - 0.5
    assert [(f["value"], f["facts"]["without_policy"]) for f in said] == [(2.0, 2.0)]
    assert estimated & {retired, lost} == set(), "what is no candidate is replayed beside them and gets no estimate"
