"""Objects that are named together belong together: two ids in a path, and ids in bodies, of two participants, mixed and matched."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning import policies as learning
from app.pipeline import service as pipeline
from app.planning.bundles import service as bundles
from app.platform.errors import NotFound
from app.study.repository import participant_by_code
from app.tables.jobs import Job
from app.tables.learning import Policy
from ml.rl import MlpPolicy
from tests.app.planning.bundles.port_answers import port_answers
from tests.app.planning.found_rule import add_found_rule
from tests.conftest import PASSWORD

BUNDLE_FORM = {"data": {"min_ma": "0", "max_ma": "3", "ramp_ma_per_s": "1.5"}}
PORTS = "/participants/{code}/policies/{policy_id}/ports"
RELEASE = "/participants/{code}/policies/{policy_id}/release"
PAIRS: dict[tuple[str, str], dict[str, Any]] = {
    # every route with two or more ids in its path, and what makes the call of a matched pair succeed
    ("GET", "/participants/{code}/policies/{policy_id}"): {},
    ("POST", RELEASE): {"data": BUNDLE_FORM["data"] | {"password": PASSWORD}},
    ("GET", "/participants/{code}/policies/{policy_id}/threshold-rule"): {},
    ("GET", "/participants/{code}/policies/{policy_id}/threshold-rule.pdf"): {},
    ("POST", "/participants/{code}/policies/{policy_id}/threshold-rule"): {
        "data": {"min_ma": "0", "preset": "quick", "device": "percept_pc"}
    },
    ("GET", "/api/v1/participants/{code}/policies/{policy_id}/threshold-rule"): {},
    ("GET", "/api/v1/participants/{code}/policies/{policy_id}/threshold-rule/sheet"): {},
    ("POST", "/participants/{code}/policies/{policy_id}/retire"): {"data": {"reason": "worn out"}},
    ("GET", "/participants/{code}/policies/{policy_id}/bundle"): {},
    ("GET", "/api/v1/policies/{policy_id}/port-checks/{check_id}/page"): {},
    ("GET", "/api/v1/policies/{policy_id}/port-checks/{check_id}/page.pdf"): {},
    ("POST", PORTS): {"data": {"target": "TFLite"}},  # and the answers of a copy of the policy
    ("POST", "/participants/{code}/policies/{policy_id}/bundle"): BUNDLE_FORM,
    ("PATCH", "/api/v1/studies/{study_code}/sites/{site_code}"): {"json": {"name": "Moved", "reason": "new house"}},
    ("POST", "/api/v1/studies/{study_code}/sites/{site_code}/end"): {"json": {"reason": "closed"}},
    ("POST", "/api/v1/studies/{study_code}/sites/{site_code}/reopen"): {"json": {"reason": "opened"}},
    ("POST", "/studies/{study_code}/sites/{site_code}"): {"data": {"name": "Moved", "reason": "new house"}},
    ("POST", "/studies/{study_code}/sites/{site_code}/end"): {"data": {"reason": "closed"}},
    ("POST", "/studies/{study_code}/sites/{site_code}/reopen"): {"data": {"reason": "opened"}},
}
Ids = dict[str, Any]


def routes_with_two_ids(app: Any) -> set[tuple[str, str]]:
    """List (method, path) of every page and route whose path names two objects; `key` is a word, `position` a place in a plan."""
    found = set()
    for context in iter_route_contexts(app.routes):
        if context.path and context.path.replace("{key}", "").replace("{position}", "").count("{") >= 2:
            found |= {(method, context.path) for method in (context.methods or set()) - {"HEAD", "OPTIONS"}}
    return found


def study_world(client: TestClient, code: str, seed: int, sign_plan: Callable[..., Any]) -> Ids:
    """Build a participant with one object of every sort; return their ids."""
    api, home = "/api/v1", f"/api/v1/participants/{code}"
    settings = {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}
    assert client.post(f"{api}/participants", json={"code": code, "site": "main", "settings": settings}).status_code == 201
    own = {"code": f"study-{code}", "name": "x", "site": {"code": f"site-{code}", "name": "x"}}
    assert client.post(f"{api}/studies", json=own).status_code == 201
    visits = [client.post(f"{home}/visits", json={"number": n}).json()["id"] for n in (1, 2)]
    rng = np.random.default_rng(seed)

    def send(visit: str | None, controller: str | None) -> dict[str, Any]:
        rows = "".join(f"{2 * k},{rng.uniform(0.5, 2):.4f},{rng.uniform(0.3, 1):.4f}\n" for k in range(-9, 40))
        fields = {"participant": code} | ({"visit": visit, "controller": controller} if visit else {})
        sent = client.post(f"{api}/uploads", data=fields, files={"file": (f"{code}.csv", f"t_s,beta,amplitude_fraction\n{rows}")})
        assert sent.status_code == 201, sent.text
        return dict(sent.json())

    upload, waiting = send("1", "random"), send(None, None)
    session = upload["sessions"][0]["id"]
    assert client.put(f"{api}/sessions/{session}/qoc", json={"rating": 7, "grasp_hz": 2.0, "tremor_percent": 5.0}).status_code == 200
    onnx = MlpPolicy(10, (8,), mean=1.0, std=0.5, seed=seed).to_onnx()
    policy = client.post(f"{home}/policies", data={"name": f"made for {code}"}, files={"file": ("x.onnx", onnx)}).json()["id"]
    grasp = client.post(
        f"{api}/uploads", data={"participant": code}, files={"file": (f"{code}-grasps.csv", _grasps(seed))}
    ).json()["files"][0]["id"]  # fmt: skip
    plan = client.post(f"{api}/visits/{visits[1]}/plan", json={"policy_ids": [policy]})
    assert sign_plan(visits[1], plan_id=plan.json()["id"]).status_code == 200
    answers = port_answers(client.get(f"{api}/policies/{policy}/bundle").content)
    checked = client.post(f"{api}/policies/{policy}/port-checks", data={"target": "C"}, files={"file": ("a.csv", answers)})
    assert checked.status_code == 201, checked.text
    job = client.post(f"{home}/jobs", json={"kind": "evaluate", "preset": "quick"})
    assert job.status_code == 202, job.text
    return {
        "code": code,
        "study_code": f"study-{code}",
        "site_code": f"site-{code}",
        "visit_id": visits[0],
        "open_visit": visits[1],
        "session_id": session,
        "proposal": waiting["proposals"][0]["session"]["id"],
        "upload_id": upload["id"],
        "file_id": grasp,
        "policy_id": policy,
        "plan_id": plan.json()["id"],
        "snapshot_id": client.post(f"{home}/snapshots").json()["id"],
        "job_id": job.json()["id"],
        "check_id": checked.json()["id"],
        "answers": answers,
    }


def _grasps(seed: int) -> str:
    return "hand,open_fist_s\n" + "".join(f"right,{0.4 * k + 0.01 * seed:.3f}\n" for k in range(40))


@pytest.fixture
def clinician(client_as: Callable[[str], TestClient]) -> TestClient:
    """A user who brought no policy from elsewhere."""
    return client_as("clinician")


@pytest.fixture
def both(client: TestClient, clinician: TestClient, sign_plan: Callable[..., Any], db: Session) -> tuple[Ids, Ids]:
    found = study_world(client, "P1", 1, sign_plan), study_world(client, "P2", 2, sign_plan)
    for one in found:
        add_found_rule(db, db.get_one(Policy, one["policy_id"]), 1)
    db.commit()
    return found


def test_every_route_with_two_ids_refuses_another_participants(
    service_app: Any, client: TestClient, clinician: TestClient, both: tuple[Ids, Ids], db: Session
) -> None:
    others = {RELEASE: clinician}  # no user releases what they brought from elsewhere themselves
    signed_in = TestClient(service_app, base_url="http://testserver")
    assert signed_in.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 200
    others |= {path: signed_in for _, path in PAIRS if path.startswith("/studies/")}  # forms that no token sends
    assert routes_with_two_ids(service_app) == set(PAIRS), "say in PAIRS how a matched pair of these is called"
    for (method, path), call in PAIRS.items():
        names = [part.split("}")[0] for part in path.split("{")[1:]]
        for owners in product((0, 1), repeat=len(names)):
            chosen = {name: both[owner][name] for name, owner in zip(names, owners, strict=True)}
            if path == PORTS:
                call = call | {"files": {"file": ("a.csv", both[owners[names.index("policy_id")]]["answers"])}}
            before = _written(db)
            caller = others.get(path, client)
            answer = caller.request(method, path.format(**chosen), headers={"Accept": "text/html"}, follow_redirects=False, **call)
            if len(set(owners)) == 1:
                assert answer.status_code in (200, 303), (method, path, chosen, answer.text[-500:])
            else:
                assert answer.status_code == 404, (method, path, chosen)
                assert _written(db) == before, (method, path, "something was written for a mismatched pair")


def _written(db: Session) -> Any:
    db.rollback()
    return db.execute(text("select max(id), count(*) from audit_event")).one()


def test_the_services_refuse_what_does_not_belong_together(both: tuple[Ids, Ids], db: Session) -> None:
    """The check is the service's: every caller is refused."""
    participant, policy = participant_by_code(db, "P2", SYSTEM), db.get_one(Policy, both[0]["policy_id"])
    job = db.get_one(Job, both[0]["job_id"])
    for call in (
        lambda: bundles.bundle(db, participant, policy, bundles.Limits(), None, SYSTEM),
        lambda: bundles.preview(db, participant, policy, bundles.Limits(), None, SYSTEM),
        lambda: learning.retire(db, participant, policy, "worn out", SYSTEM),
        lambda: pipeline.cancel_job(db, participant, job, SYSTEM),
        lambda: pipeline.retry_job(db, participant, job, SYSTEM),
    ):
        with pytest.raises(NotFound, match="P2 has no"):
            call()


def test_a_bundle_holds_the_approvals_of_its_own_participant_alone(both: tuple[Ids, Ids], db: Session) -> None:
    first, second = (participant_by_code(db, ids["code"], SYSTEM) for ids in both)
    assert len(bundles.approvals(db, first.id, both[0]["policy_id"])) == 1
    assert bundles.approvals(db, second.id, both[0]["policy_id"]) == ()


def _bodies(own: Ids, other: Ids) -> list[tuple[str, str, dict[str, Any]]]:
    """List calls on objects of `own` whose bodies name an object of `other`."""
    api, page, policy = "/api/v1", f"/participants/{own['code']}", other["policy_id"]
    plan, session, proposal = f"/visits/{own['open_visit']}/plan", f"/sessions/{own['session_id']}", f"/proposals/{own['proposal']}"
    grasps, theirs = f"/uploaded-files/{own['file_id']}/session", other["proposal"]
    rows = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},{1 + k / 100},0.77\n" for k in range(-9, 12))
    table = {"files": {"file": ("other.csv", rows)}}
    form = {"participant": own["code"], "visit": "1", "controller": "rl"}
    mine = {"version": 1, "controller": "rl"}
    jobs = [{"kind": kind, "policies": [policy]} for kind in ("train", "distill", "evaluate", "pipeline")]
    return [
        ("POST", f"{api}{plan}", {"json": {"policy_ids": [policy], "reason": "x"}}),
        ("POST", f"{api}{plan}/approve", {"json": {"plan_id": other["plan_id"]}}),
        ("POST", plan, {"data": {"policy_ids": str(policy), "reason": "x"}}),
        ("POST", f"{plan}/approve", {"data": {"plan_id": str(other["plan_id"])}}),
        ("POST", f"{page}/plan/draft", {"data": {"policy_ids": str(policy), "visit_number": "9", "visit_date": "2199-01-01"}}),
        ("POST", f"{page}/plan/draft", {"data": {"policy_ids": str(own["policy_id"]), "visit_id": str(other["open_visit"])}}),
        *(("POST", f"{api}{page}/jobs", {"json": body}) for body in jobs),
        ("PATCH", f"{api}{session}", {"json": {"controller": "rl", "policy_id": policy, "reason": "x"}}),
        ("POST", f"{session}/correction", {"data": {"controller": "rl", "policy": str(policy), "reason": "x"}}),
        ("PATCH", f"{api}{proposal}", {"json": mine | {"policy": f"made for {other['code']}"}}),
        ("POST", f"{api}{proposal}/confirm", {"json": mine | {"visit": 1, "policy": str(policy)}}),
        ("POST", f"{page}/proposals", {"data": {"do": f"discard:{theirs}", f"version-{theirs}": "1", f"reason-{theirs}": "x"}}),
        ("POST", f"{api}{grasps}", {"json": {"session_id": other["session_id"]}}),
        ("POST", grasps, {"data": {"session_id": str(other["session_id"])}}),
        ("POST", f"{api}/uploads", {"data": form | {"policy": str(policy)}, **table}),
        ("POST", f"{api}/uploads", {"data": {"participant": own["code"], "session": str(other["session_id"])}, **table}),
        ("POST", f"{page}/upload", {"data": {"visit": "1", "controller": "rl", "policy": str(policy)}, **table}),
        ("POST", f"{page}/upload", {"data": {"session": str(other["session_id"])}, **table}),
    ]


def test_ids_in_bodies_of_another_participants_objects_are_refused(client: TestClient, both: tuple[Ids, Ids], db: Session) -> None:
    for own, other in (both, both[::-1]):
        for method, path, call in _bodies(own, other):
            before = _written(db)
            headers = {} if path.startswith("/api/") else {"Accept": "text/html"}
            answer = client.request(method, path, headers=headers, follow_redirects=False, **call)
            assert answer.status_code in (404, 409, 422), (method, path, call, answer.status_code, answer.text[-800:])
            assert _written(db) == before, (method, path, call, "something was written")


def test_the_same_bodies_with_own_objects_are_taken(client: TestClient, both: tuple[Ids, Ids]) -> None:
    """So that the test above cannot pass by impossible calls."""
    own = both[0]
    policy = own["policy_id"]
    api = "/api/v1"
    for method, path, body in [
        ("POST", f"{api}/visits/{own['open_visit']}/plan", {"policy_ids": [policy], "reason": "x"}),
        ("POST", f"{api}/participants/P1/jobs", {"kind": "evaluate", "policies": [policy]}),
        ("POST", f"{api}/participants/P1/jobs", {"kind": "distill", "policies": [policy]}),
        ("PATCH", f"{api}/sessions/{own['session_id']}", {"controller": "rl", "policy_id": policy, "reason": "x"}),
        ("PATCH", f"{api}/proposals/{own['proposal']}", {"version": 1, "controller": "rl", "policy": "made for P1"}),
        ("POST", f"{api}/uploaded-files/{own['file_id']}/session", {"session_id": own["session_id"]}),
    ]:
        answer = client.request(method, path, json=body)
        assert answer.status_code in (200, 201, 202), (path, answer.text)
