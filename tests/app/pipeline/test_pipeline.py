"""Real jobs in a real worker: small, but every step runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.policies import constant_onnx
from app.learning.trajectories import read_buffer
from app.platform import files
from app.study.repository import participant_by_code
from app.tables.evaluations import Evaluation
from app.tables.learning import BufferSnapshot, Policy
from ml.deploy.bundle import verify_bundle
from ml.ope.compare.skill import held_out_skill
from ml.ope.registry import estimators, quick_estimators
from ml.ope.support.diagnostics import diagnose
from ml.policies.onnx_policy import OnnxPolicy

Upload = Callable[..., int]
Ended = Callable[..., dict[str, Any]]
JOBS = "/api/v1/participants/P1/jobs"


@pytest.fixture
def sessions(upload: Upload) -> list[int]:
    """Eight sessions of P1 by four controllers over two visits."""
    mix = (
        ("random", 1.0),
        ("cdbs", 1.0),
        ("random", 1.0),
        ("no_dbs", 0.0),
        ("random", 1.0),
        ("other", 0.6),
        ("random", 1.0),
        ("cdbs", 1.0),
    )
    return [
        upload(controller, level=level, steps=50 + k, qoc={"grasp_hz": 2 + 0.1 * k, "rating": 6 + k % 3, "tremor_percent": 5.0 * k})
        for k, (controller, level) in enumerate(mix)
    ]


CHEAP = ["linear", "fqe", "wdr", "wis", "pdis", "cwpdis"]


@pytest.mark.slow
@pytest.mark.usefixtures("worker")
def test_an_evaluation_gives_the_numbers_that_the_estimators_give(
    client: TestClient, sessions: list[int], ended: Ended, db: Session
) -> None:
    added = client.post("/api/v1/participants/P1/policies", data={"name": "ext"}, files={"file": ("e.onnx", constant_onnx(0.6, 10))}).json()
    body = {"kind": "evaluate", "preset": "quick", "methods": [*CHEAP, "aggregate"], "policies": [added["id"]]}
    done = ended(client.post(JOBS, json=body).json()["id"], 300)
    assert done["status"] == "succeeded", done
    assert {s["status"] for s in done["steps"]} == {"succeeded"}
    assert {f"estimate/{m}" for m in CHEAP} | {"coverage", "choose-method"} <= {s["key"] for s in done["steps"]}
    ranking = client.get("/api/v1/participants/P1/ranking").json()
    assert ranking["evaluation_id"] == done["result"]["evaluation_id"]
    (policy,) = ranking["policies"]
    assert (policy["policy_id"], policy["kind"]) == (added["id"], "external")
    buffer = read_buffer(db.get_one(BufferSnapshot, done["result"]["snapshot_id"]).file_sha256)
    panel, held = estimators(0, demo=True), OnnxPolicy(constant_onnx(0.6, 10), 10)
    checked = diagnose(buffer, {"x": held}, buffer.median_steps())["x"]
    assert {c["name"]: c["verdict"] for c in policy["coverage"]["checks"]} == {c.name: c.verdict for c in checked.checks}
    assert policy["coverage"]["supported"] is checked.supported
    assert all(r["coverage"] for r in ranking["references"])
    for method in CHEAP:
        direct = panel[method].fit(buffer).evaluate({"x": held}, buffer.median_steps())["x"]
        shown = policy["estimates"][method]
        assert (shown["value"], shown["step_return"]) == (
            pytest.approx(direct.value, rel=1e-9),
            pytest.approx(direct.step_return, rel=1e-9),
        )
    quick = {name: e for name, e in quick_estimators(0).items() if name in CHEAP}
    skill = held_out_skill(buffer, quick, horizon_steps=buffer.median_steps())
    held_out = db.get_one(Evaluation, done["result"]["evaluation_id"]).diagnostics["held_out"]
    assert {s["method"]: s["difference_error"] for s in held_out["table"]} == {
        s.method: pytest.approx(s.difference_error) for s in skill.table
    }
    # the posterior was not named: it ranks all the same, and its verdict is next to it
    assert (ranking["default_method"], ranking["choice"]) == ("posterior", None)
    assert policy["decision"] in ("test", "test_with_care", "same_as_cdbs", "unsafe", "cannot_tell")
    assert policy["decision_reasons"]
    values = [policy["estimates"][m]["value"] for m in CHEAP]
    assert min(values) <= policy["estimates"]["aggregate"]["value"] <= max(values)
    assert ranking["stale"] is False
    assert {r["reference"] for r in ranking["references"]} >= {"cdbs", "proportional"}


@pytest.mark.slow
@pytest.mark.usefixtures("worker", "sessions")
def test_sessions_of_any_design_a_foreign_policy_and_no_end_reward_go_through_the_same_door(
    client: TestClient, upload: Upload, ended: Ended, db: Session
) -> None:
    changed = {"c2": 0.0, "c3": 0.0, "c4": 0.0, "pool_shapes": True}
    assert client.put("/api/v1/participants/P1/settings", json={"settings": changed}).status_code == 200
    for k, design in enumerate(("stratified", "paper", "ladder")):
        designed = upload("random", steps=60, visit=1)
        stated = client.put(f"/api/v1/sessions/{designed}/conditions", json={"design": design, "seed": k, "reason": "as planned"})
        assert stated.status_code == 200, stated.text
    added = client.post("/api/v1/participants/P1/policies", data={"name": "ext"}, files={"file": ("e.onnx", constant_onnx(0.6, 10))}).json()
    methods = [*CHEAP, "impulse", "dlmm", "dual_dice", "aggregate"]
    done = ended(
        client.post(JOBS, json={"kind": "evaluate", "preset": "quick", "methods": methods, "policies": [added["id"]]}).json()["id"], 400
    )
    assert done["status"] == "succeeded", done
    ranking = client.get("/api/v1/participants/P1/ranking").json()
    (policy,) = ranking["policies"]
    assert set(policy["estimates"]) == {*methods, "posterior"}
    for method, told in policy["estimates"].items():
        assert np.isfinite([told["value"], told["low"], told["high"]]).all(), method
        assert told["low"] <= told["value"] <= told["high"], method
        assert told["end_reward"] == pytest.approx(0.0, abs=1e-9), method
        assert all(abs(flag["value"]) < 1e4 for flag in told["flags"] if flag["value"] is not None), (method, told["flags"])
    assert policy["predicted"]["grasp_hz"] == pytest.approx(2.0, abs=1.0), "outcomes are predicted where they earn nothing"
    stored = db.get_one(Evaluation, done["result"]["evaluation_id"])
    assert set(stored.diagnostics["dose_shapes"]["evidence"]) == {"grasp", "rating", "tremor"}
    assert {o: p["participants"] for o, p in stored.diagnostics["dose_shapes"]["pooling"].items()} == {"grasp": 1, "rating": 1, "tremor": 1}
    assert stored.config["pooled_evaluations"] == []
    assert "grasp: not pooled, because 0 other participants" in client.get("/participants/P1/ranking").text


@pytest.mark.slow
@pytest.mark.usefixtures("worker")
def test_the_pipeline_walks_from_sessions_to_a_ranking(client: TestClient, sessions: list[int], ended: Ended, db: Session) -> None:
    body = {
        "kind": "pipeline",
        "preset": "quick",
        "count": 2,
        "updates": 60,
        "distil_updates": 60,
        "methods": ["dlsm", "linear", "pdis"],
        "seed": 4,
    }
    job = client.post(JOBS, json=body).json()["id"]
    done = ended(job, 400)
    assert done["status"] == "succeeded", done
    assert done["progress"] == 1.0
    assert {s["status"] for s in done["steps"]} == {"succeeded"}
    policies = {p.id: p for p in db.scalars(select(Policy).where(Policy.job_id == job))}
    assert sorted(p.name for p in policies.values()) == ["rl-01", "rl-01-small", "rl-02", "rl-02-small"]
    students = [p for p in policies.values() if p.kind == "distilled"]
    assert {s.teacher_id for s in students} == {p.id for p in policies.values() if p.kind == "trained"}
    ranking = client.get("/api/v1/participants/P1/ranking").json()
    assert sorted(p["policy_id"] for p in ranking["policies"]) == sorted(policies)
    assert (ranking["default_method"], ranking["choice"]) == ("posterior", None)
    told = all(p["rank"] for p in ranking["policies"])
    if told:
        assert [p["rank"] for p in ranking["policies"]] == [1, 2, 3, 4]
        asked = any(p["supported"] and p["decision"] != "unsafe" for p in ranking["policies"])
        assert sum(p["probability_best"] for p in ranking["policies"]) == pytest.approx(1.0 if asked else 0.0)
    else:  # eight short sessions may not distinguish policies: then nothing is ordered, and nothing proposed
        assert {(p["rank"], p["probability_best"], p["decision"]) for p in ranking["policies"]} == {(None, None, "cannot_tell")}
    assert ranking["horizon_steps"] == int(np.median([50 + k for k in range(8)]))
    for policy in ranking["policies"]:
        assert set(policy["estimates"]) == {"dlsm", "linear", "pdis", "posterior"}
        assert {"energy", "mean_beta", "grasp_hz", "rating", "tremor_percent"} <= set(policy["estimates"]["dlsm"]["predicted"])
    assert (ranking["stale"], ranking["failed_methods"], ranking["first_answer"]) == (False, {}, False)
    first, last = db.scalars(select(Evaluation).where(Evaluation.job_id == job).order_by(Evaluation.id))
    assert (first.first_answer, last.first_answer, last.id) == (True, False, ranking["evaluation_id"])
    assert first.diagnostics["candidates"] == []
    references = {r["policy_id"] for r in ranking["references"]} - {p.id for p in db.scalars(select(Policy)) if p.algorithm == "cloning"}
    assert {e.policy_id for e in first.estimates} == references, "before a policy is trained, the references are answered for"
    bundle = client.get(f"/api/v1/policies/{students[0].id}/bundle")
    assert verify_bundle(bundle.content).normalisation_mean == pytest.approx(students[0].metrics["beta_mean"])
    page = client.get(f"/jobs/{job}").text
    for text in ("Training: mean Q of each policy", "DLSM: score on held-out sessions", "Run again"):
        assert text in page
    assert "Promised return of the policy" in client.get(f"/participants/P1/policies/{min(policies)}").text

    # the same job again, on the same snapshot and seed, gives the same weights
    again = ended(client.post(f"/api/v1/jobs/{job}/retry").json()["id"], 400)
    assert again["result"]["snapshot_id"] == done["result"]["snapshot_id"]
    weights = [[db.get_one(Policy, i).onnx_sha256 for i in result["result"]["policy_ids"]] for result in (done, again)]
    assert weights[0] == weights[1]
    assert db.get_one(Policy, again["result"]["policy_ids"][0]).name == "rl-03"


@pytest.mark.slow
@pytest.mark.usefixtures("worker")
def test_policies_are_trained_fine_tuned_and_distilled(client: TestClient, sessions: list[int], ended: Ended, db: Session) -> None:
    first = ended(client.post(JOBS, json={"kind": "train", "preset": "quick", "count": 1, "updates": 40}).json()["id"], 200)
    (parent,) = first["result"]["policy_ids"]
    tuned = ended(client.post(JOBS, json={"kind": "train", "policies": [parent], "updates": 40}).json()["id"], 200)
    assert tuned["status"] == "succeeded", tuned
    row = db.get_one(Policy, tuned["result"]["policy_ids"][0])
    assert row.parent_id == parent
    assert 1e-7 <= row.config["actor_lr"] <= 1e-5
    states = read_buffer(db.get_one(BufferSnapshot, row.snapshot_id).file_sha256).transitions().states
    before = OnnxPolicy(files.read(db.get_one(Policy, parent).onnx_sha256)).act(states)
    after = OnnxPolicy(files.read(row.onnx_sha256)).act(states)
    assert 0 < np.abs(after - before).max() < 0.01  # 40 small steps from the parent, not a fresh start
    distilled = ended(client.post(JOBS, json={"kind": "distill", "updates": 800, "hidden": [12, 6]}).json()["id"], 200)
    assert distilled["status"] == "succeeded", distilled
    students = [db.get_one(Policy, i) for i in distilled["result"]["policy_ids"]]
    assert [s.teacher_id for s in students] == [parent, row.id]
    for student in students:
        assert student.config["hidden"] == [12, 6]
        assert student.metrics["on_buffer"]["mean"] < 0.05
    participant = participant_by_code(db, "P1", SYSTEM)
    assert participant.current_settings.id == students[0].settings_version_id


@pytest.mark.slow
@pytest.mark.usefixtures("worker")
def test_with_too_few_sessions_the_dlsm_says_so_and_the_others_rank(client: TestClient, upload: Upload, ended: Ended) -> None:
    for _ in range(3):
        upload("random")
    client.post("/api/v1/participants/P1/policies", data={"name": "ext"}, files={"file": ("e.onnx", constant_onnx(0.6, 10))})
    done = ended(client.post(JOBS, json={"kind": "evaluate", "preset": "quick", "methods": ["dlsm", "linear"]}).json()["id"], 200)
    assert done["status"] == "succeeded", done
    ranking = client.get("/api/v1/participants/P1/ranking").json()
    assert "at least 4 sessions" in ranking["failed_methods"]["dlsm"]
    assert ranking["default_method"] == "posterior"
