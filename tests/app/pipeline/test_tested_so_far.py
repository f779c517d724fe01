"""Sweeps go by the posterior with what tested sessions showed, as the ranking does."""

from __future__ import annotations

import json
from collections.abc import Callable

from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.schemas import TrainParams
from app.learning.snapshots.buffers import read_buffer
from app.learning.snapshots.service import take_snapshot
from app.learning.training.compute import known_tests, stored_gains
from app.learning.training.configs import training_groups
from app.pipeline.stages import snapshot_facts
from app.pipeline.training import training_calls, training_plan
from app.study.repository import participant_by_code
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
    assert before == blind, "a job that an earlier version began"
