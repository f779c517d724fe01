"""The next generation: goes on from what did best in its sessions, is trained once from the same data, and only by who may."""

from __future__ import annotations

from collections.abc import Callable
from html import unescape
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.schemas import DEFAULT_SWEEP, TrainParams
from app.learning.snapshots import take_snapshot
from app.learning.training_configs import generation_groups, training_groups
from app.pipeline.next_generation import best
from app.pipeline.training import training_starts
from app.study.repository import participant_by_code
from app.tables.evaluations import Evaluation
from app.tables.jobs import Job
from app.tables.learning import Policy
from ml.rl.algorithms.rebrac import RebracConfig
from tests.app.evaluations import judged
from tests.app.words import flat

Upload = Callable[..., int]
Judge = Callable[..., int]
HOME = "/participants/P1"
API = f"/api/v1{HOME}"
JOBS = f"{API}/jobs"
FORM = {"preset": "quick", "parents": "2", "tuned": "2", "count": "6"}


def policy(number: int, teacher: int | None = None) -> Policy:
    return Policy(id=number, name=f"rl-{number}", kind="distilled" if teacher else "trained", teacher_id=teacher)


def test_parents_are_the_best_by_the_posterior_and_a_student_counts_as_its_teacher() -> None:
    tested = [policy(1), policy(2), policy(3, teacher=2), policy(4)]
    posterior = {1: 90.0, 2: 96.0, 3: 97.0, 4: 80.0}
    assert [p.id for p in best(tested, posterior, 2)] == [3, 1], "not the teacher of the first beside it"
    assert [p.id for p in best(tested, {4: 80.0}, 2)] == [4], "what has no estimate is not taken"


def test_each_parent_gets_slow_and_fast_rates_of_the_paper_and_fresh_policies_those_from_scratch() -> None:
    parents = [{"policy_id": 3, "algorithm": "rebrac"}, {"policy_id": 4, "algorithm": "ddpg"}]
    groups = generation_groups(TrainParams(algorithms=["ddpg", "rebrac"], count=4, seed=10), parents, 2)
    tuned, fresh = [g for g in groups if g["start"]], [g for g in groups if not g["start"]]
    assert [(g["start"]["policy_id"], g["algorithm"]) for g in tuned] == [(3, "rebrac"), (4, "ddpg")] * 2
    rates = [g["configs"][0]["actor_lr"] for g in tuned]
    assert (min(rates), max(rates)) == (pytest.approx(1e-7), pytest.approx(1e-5))
    assert rates[0] < rates[1] < rates[2] < rates[3]
    from_scratch = [c["actor_lr"] for g in fresh for c in g["configs"]]
    assert (len(from_scratch), min(from_scratch), max(from_scratch)) == (4, pytest.approx(1e-5), pytest.approx(1e-3))
    seeds = [c["seed"] for g in groups for c in g["configs"]]
    assert sorted(seeds) == list(range(10, 18)), "no seed twice"
    assert len({g["key"] for g in groups}) == len(groups)


@pytest.fixture
def policies_tested(client: TestClient, db: Session, policies: list[int], upload: Upload) -> list[int]:
    """Three policies that can be trained further; the first two ran in a session of visit 2."""
    snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    db.execute(update(Policy).where(Policy.id.in_(policies)).values(kind="trained", algorithm="ddpg", snapshot_id=snapshot.id))
    db.commit()
    client.post("/api/v1/participants/P1/visits", json={"number": 2})
    for policy_id in policies[:2]:
        upload("rl", visit=2, policy=str(policy_id))
    return policies


def test_a_parent_is_trained_further_as_firmly_bound_as_it_was(db: Session, policies_tested: list[int]) -> None:
    held = RebracConfig(aim="return", anchor="constant", anchor_amplitude=0.6, actor_penalty=0.3)
    parent = db.get_one(Policy, policies_tested[0])
    # a checkpoint says that its own algorithm goes on; its bytes are not read to plan a training
    parent.algorithm, parent.config, parent.checkpoint_sha256 = "rebrac", held.to_json(), parent.onnx_sha256
    db.commit()
    params = TrainParams(policies=[parent.id], **DEFAULT_SWEEP)
    (group,) = training_groups(params, training_starts(db, parent.participant_id, params))
    (config,) = group["configs"]
    assert {name: config[name] for name in ("aim", "anchor", "anchor_amplitude", "actor_penalty")} == {
        "aim": "return", "anchor": "constant", "anchor_amplitude": 0.6, "actor_penalty": 0.3,
    }  # fmt: skip
    assert RebracConfig.from_json(config).actor_penalty == 0.3


def press(client: TestClient) -> str:
    answer = client.post(f"{HOME}/next-generation", data=FORM, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    return str(answer.headers["location"]).removeprefix("/jobs/").split("?")[0]


@pytest.mark.usefixtures("policies")
def test_nothing_starts_before_a_policy_was_tested(client: TestClient) -> None:
    page = client.get(f"{HOME}/next-generation").text
    assert "No policy that can be trained further has run in a confirmed session." in page
    assert f'action="{HOME}/next-generation"' not in page
    answer = client.post(JOBS, json={"kind": "next_generation"})
    assert (answer.status_code, client.get(JOBS).json()["total"]) == (422, 0)
    assert "has been tested in a session yet" in answer.json()["detail"]
    assert "next-generation" not in client.get(f"{HOME}/ranking").text


BLOCKED = {
    "a serious event or stop": ("A serious event or stop under it is not cleared.", "stop"),
    "retirement": ("It was retired (tremor came back). Take it back on its page.", "retired"),
    "another window": ("beta amplitudes, the settings say 5. Set the window back, or train new policies.", "window"),
    "a foreign policy": ("It was made elsewhere, and cannot be trained further here.", "external"),
}


@pytest.mark.parametrize("cause", BLOCKED)
def test_a_policy_that_ran_and_is_blocked_is_named_with_its_cause_and_the_way_on(
    cause: str, client: TestClient, db: Session, policies: list[int], policies_tested: list[int], upload: Upload
) -> None:
    words, act = BLOCKED[cause]
    for policy_id in policies_tested[:2]:
        if act == "stop":
            session = upload("rl", visit=2, policy=str(policy_id))
            change = {"stopped_reason": "dizzy", "reason": "notes"}
            assert client.patch(f"/api/v1/sessions/{session}", json=change).status_code == 200
        elif act == "retired":
            assert client.patch(f"/api/v1/policies/{policy_id}", json={"retired_reason": "tremor came back"}).status_code == 200
        elif act == "external":
            db.execute(update(Policy).where(Policy.id == policy_id).values(kind="external"))
            db.commit()
    if act == "window":
        assert client.put(f"{API}/settings", json={"settings": {"window": 5}}).status_code == 200
    page = unescape(flat(client.get(f"{HOME}/next-generation").text))
    assert page.count(words) == 2, page[-2500:]
    assert "has run in a confirmed session" not in page
    assert f'href="{HOME}/adverse-events"' in client.get(f"{HOME}/next-generation").text
    answer = client.post(JOBS, json={"kind": "next_generation"})
    assert (answer.status_code, words in answer.json()["detail"]) == (422, True)


def test_a_participant_whose_policies_are_retired_is_not_without_policies(client: TestClient, policies: list[int]) -> None:
    visit = client.post(f"{API}/visits", json={"number": 2, "date": "2099-11-22"}).json()["id"]
    for policy_id in policies:
        assert client.patch(f"/api/v1/policies/{policy_id}", json={"retired_reason": "old"}).status_code == 200
    words = "No policy is in use: 3 policies retired."
    for path in (f"/visits/{visit}/plan", f"{HOME}/compare"):
        assert words in unescape(flat(client.get(path, headers={"Accept": "text/html"}).text)), path
    answer = client.post(JOBS, json={"kind": "evaluate", "methods": ["linear"]})
    assert (answer.status_code, words in answer.json()["detail"]) == (422, True)


def test_pressed_twice_there_is_one_job_which_the_page_follows(client: TestClient, policies_tested: list[int]) -> None:
    first = press(client)
    assert press(client) == first
    assert client.post(JOBS, json={"kind": "next_generation"}).json()["id"] == first, "nor does the interface start a second one"
    body = client.get(f"/api/v1/jobs/{first}").json()
    assert (body["kind"], body["status"], client.get(JOBS).json()["total"]) == ("next_generation", "queued", 1)
    assert (body["params"]["algorithms"], body["params"]["parents"], body["params"]["count"]) == (["ddpg", "rebrac"], 2, 6)
    page = client.get(f"{HOME}/next-generation").text
    assert f'href="/jobs/{first}"' in page
    assert "Train the next generation</button>" not in page
    client.post(f"/api/v1/jobs/{first}/cancel")
    assert press(client) != first, "a cancelled one is no generation"


def test_the_page_names_what_it_goes_on_from_and_a_trained_generation_is_not_trained_again(
    client: TestClient, db: Session, policies_tested: list[int], judge: Judge, upload: Upload
) -> None:
    before = client.get(f"{HOME}/next-generation").text
    assert "the job first assesses these policies" in before
    evaluation = judge({policies_tested[0]: judged(80.0), policies_tested[1]: judged(95.0), policies_tested[2]: judged(99.0)})
    page = client.get(f"{HOME}/next-generation").text
    rows = [row for row in page.split("<tr") if "/policies/" in row]
    assert ["p1" in rows[0], "p0" in rows[1], len(rows)] == [True, True, 2], "p2, the best by its estimate, was never tested"
    assert all("goes on from it" in row for row in rows)
    assert f'href="{HOME}/next-generation"' in client.get(f"{HOME}/ranking").text
    visits = client.get("/api/v1/participants/P1/visits").json()["items"]
    assert [f'href="{HOME}/next-generation"' in client.get(f"/visits/{v['id']}").text for v in visits] == [v["number"] == 2 for v in visits]

    job = press(client)
    db.rollback()
    db.execute(update(Job).where(Job.id == job).values(status="succeeded", finished_at=func.now(), started_at=func.now()))
    db.execute(update(Evaluation).where(Evaluation.id == evaluation).values(job_id=job))
    db.commit()
    assert press(client) == job, "nothing was recorded since"
    judge({i: judged(80.0) for i in policies_tested})
    assert press(client) == job, "nor does another evaluation of the same data ask for a second generation"
    assert "The next generation is trained" in client.get(f"{HOME}/next-generation").text
    upload("rl", visit=2, policy=str(policies_tested[0]))
    assert press(client) != job


def test_who_may_not_run_jobs_starts_none(client_as: Callable[[str], TestClient], policies_tested: list[int]) -> None:
    for role, may in (("viewer", False), ("monitor", False), ("coordinator", False), ("clinician", True), ("engineer", True)):
        user = client_as(role)
        assert user.get(f"{HOME}/next-generation").status_code == (200 if may else 403), role
        assert user.post(f"{HOME}/next-generation", data=FORM, follow_redirects=False).status_code == (303 if may else 403), role


@pytest.mark.slow
@pytest.mark.usefixtures("worker")
def test_the_best_tested_policy_is_fine_tuned_beside_fresh_ones_and_all_are_ranked(
    client: TestClient, db: Session, upload: Upload, ended: Callable[..., dict[str, Any]]
) -> None:
    levels = (("random", 1.0), ("cdbs", 1.0), ("random", 1.0), ("no_dbs", 0.0), ("random", 1.0), ("cdbs", 1.0))
    for k, (controller, level) in enumerate(levels):
        upload(controller, level=level, steps=40, qoc={"grasp_hz": 2 + 0.1 * k, "rating": 6 + k % 3, "tremor_percent": 5.0 * k})
    first = ended(client.post(JOBS, json={"kind": "train", "preset": "quick", "count": 2, "updates": 20}).json()["id"], 240)
    good, poor = first["result"]["policy_ids"]
    client.post("/api/v1/participants/P1/visits", json={"number": 2})
    upload("cdbs", visit=2, steps=40, qoc={"grasp_hz": 2.0, "rating": 7, "tremor_percent": 10.0})
    for _ in range(3):
        upload("rl", visit=2, steps=40, level=0.7, policy=str(good), qoc={"grasp_hz": 3.0, "rating": 10, "tremor_percent": 0.0})
        upload("rl", visit=2, steps=40, level=0.7, policy=str(poor), qoc={"grasp_hz": 1.0, "rating": 2, "tremor_percent": 80.0})
    asked = {
        "kind": "next_generation",
        "preset": "quick",
        "parents": 1,
        "count": 2,
        "updates": 20,
        "distil_updates": 20,
        "methods": ["linear"],
    }
    done = ended(client.post(JOBS, json=asked).json()["id"], 500)
    assert done["status"] == "succeeded", done
    assert done["progress"] == 1.0
    assert {s["status"] for s in done["steps"]} == {"succeeded"}
    assert done["result"]["parent_ids"] == [good], "what its sessions showed decides"
    made = {p.id: p for p in db.scalars(select(Policy).where(Policy.job_id == done["id"], Policy.kind != "baseline"))}
    trained = [p for p in made.values() if p.kind == "trained"]
    assert sorted((p.parent_id or 0, p.kind) for p in trained) == [(0, "trained"), (0, "trained"), (good, "trained"), (good, "trained")]
    assert {p.algorithm for p in trained if p.parent_id is None} == {"ddpg", "rebrac"}
    assert all(1e-7 <= p.config["actor_lr"] <= 1e-5 for p in trained if p.parent_id)
    assert {p.teacher_id for p in made.values() if p.kind == "distilled"} == {p.id for p in trained}
    ranking = client.get("/api/v1/participants/P1/ranking").json()
    assert (ranking["job_id"], ranking["stale"]) == (done["id"], False)
    assert {p["policy_id"] for p in ranking["policies"]} == {good, poor, *made}
    again = client.post(f"{HOME}/next-generation", data=FORM, follow_redirects=False)
    assert again.headers["location"].startswith(f"/jobs/{done['id']}"), "the same data have their generation"
