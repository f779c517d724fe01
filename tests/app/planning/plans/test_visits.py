"""Choice of a plan's visit, moves of its sessions, and removal of visits that did not take place."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.audit import AuditEvent
from app.tables.visits import Visit

PAGE = {"Accept": "text/html"}


def test_a_visit_with_nothing_but_a_draft_is_removed_with_a_reason(client: TestClient, study_world: Any, db: Session) -> None:
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[0]]})
    assert client.post(f"/api/v1/visits/{study_world.visit}/removal", json={"reason": " "}).status_code == 422
    gone = client.post(f"/visits/{study_world.visit}/remove", data={"reason": "she cannot come"}, headers=PAGE, follow_redirects=False)
    assert (gone.status_code, gone.headers["location"]) == (303, "/participants/P1/plans?done=removed")
    assert db.scalars(select(Visit.number)).all() == [1]
    events = db.scalars(select(AuditEvent).where(AuditEvent.action == "delete", AuditEvent.entity == "visit")).all()
    assert [(e.entity_id, e.reason) for e in events] == [(str(study_world.visit), "she cannot come")]


def test_a_visit_with_sessions_or_a_signed_plan_stays(client: TestClient, study_world: Any, sign_plan: Callable[..., Any]) -> None:
    held = client.post(f"/api/v1/visits/{study_world.held_visit}/removal", json={"reason": "x"})
    assert (held.status_code, "it has sessions or proposals" in held.json()["detail"]) == (409, True)
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[0]]})
    assert sign_plan(study_world.visit).status_code == 200
    signed = client.post(f"/api/v1/visits/{study_world.visit}/removal", json={"reason": "x"})
    assert (signed.status_code, "a plan that was signed" in signed.json()["detail"]) == (409, True)


def test_a_visit_that_a_data_query_is_about_stays_and_the_refusal_says_why(client: TestClient, study_world: Any) -> None:
    query = {"visit_id": study_world.visit, "field": "date", "text": "Is this the day?"}
    assert client.post("/api/v1/participants/P1/data-queries", json=query).status_code == 201
    held = client.post(f"/api/v1/visits/{study_world.visit}/removal", json={"reason": "x"})
    assert (held.status_code, held.json()["detail"]) == (409, "Visit 2 is not empty: it has data queries.")


def test_tested_sessions_change_places_and_cdbs_stays_between(
    client: TestClient, client_as: Callable[..., TestClient], study_world: Any, sign_plan: Callable[..., Any]
) -> None:
    path = f"/api/v1/visits/{study_world.visit}/plan"
    body = {"policy_ids": list(study_world.policies[:3]), "order": "stated", "repeats": 1, "break_minutes": 20}
    before = client.post(path, json=body).json()["sessions"]
    assert [s["policy_id"] for s in before] == [1, None, 2, None, 3]
    assert [s["start_minute"] for s in before] == [0, 15, 30, 65, 80]
    moved = client_as("engineer").post(f"{path}/moves", json={"position": 5, "earlier": True})
    assert moved.status_code == 200, moved.text
    after = moved.json()
    assert [s["policy_id"] for s in after["sessions"]] == [1, None, 3, None, 2]
    assert [s["start_minute"] for s in after["sessions"]] == [s["start_minute"] for s in before]
    assert after["created_by"] == "engineer@clinic.example", "who moved it has drafted it"
    page = client.post(
        f"/visits/{study_world.visit}/plan/move", data={"position": "3", "earlier": "no"}, headers=PAGE, follow_redirects=False
    )
    assert page.status_code == 303
    assert [s["policy_id"] for s in client.get(path).json()["sessions"]] == [1, None, 2, None, 3]
    for position, earlier in ((1, True), (2, True), (5, False), (9, False)):
        assert client.post(f"{path}/moves", json={"position": position, "earlier": earlier}).status_code == 422
    assert client.post(f"{path}/moves", json={"position": 1, "earlier": False, "places": 3}).status_code == 422
    far = client.post(f"{path}/moves", json={"position": 1, "earlier": False, "places": 2}).json()
    assert [s["policy_id"] for s in far["sessions"]] == [2, None, 3, None, 1], "past both, which keep their order"
    assert sign_plan(study_world.visit).status_code == 200
    assert client.post(f"{path}/moves", json={"position": 5, "earlier": True}).status_code == 409


def test_a_move_after_which_two_policies_would_have_no_cdbs_between_them_is_refused(client: TestClient, study_world: Any) -> None:
    path = f"/api/v1/visits/{study_world.visit}/plan"
    body = {"policy_ids": list(study_world.policies[:2]), "order": "stated", "random_sessions": 1}
    for seed in range(20):
        before = client.post(path, json=body | {"seed": seed}).json()["sessions"]
        if [s["controller"] for s in before] == ["rl", "random", "cdbs", "rl"]:
            break
    else:
        raise AssertionError("no seed puts the random session there")
    refused = client.post(f"{path}/moves", json={"position": 4, "earlier": True})
    assert (refused.status_code, refused.json()["rule"]) == (422, "cdbs_between_policies")
    assert "Sessions 1 and 2 would test policies without a cDBS session between them." in refused.json()["detail"]
    assert client.get(path).json()["sessions"] == before, "nothing was moved"
    assert client.post(f"{path}/moves", json={"position": 1, "earlier": False}).status_code == 200


def test_williams_order_goes_on_from_visit_to_visit(client: TestClient, study_world: Any) -> None:
    orders = []
    visits = [study_world.visit] + [client.post("/api/v1/participants/P1/visits", json={"number": n}).json()["id"] for n in (3, 4, 5)]
    for visit in visits:
        plan = client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": list(study_world.policies), "order": "williams"}).json()
        orders.append([s["policy_id"] for s in plan["sessions"] if s["policy_id"]])
        assert plan["block"] == len(orders) - 1
    assert {frozenset(column) for column in zip(*orders, strict=True)} == {frozenset(study_world.policies)}
    assert len({pair for order in orders for pair in pairwise(order)}) == 12, "each after each other once"
    page = client.get(f"/visits/{visits[1]}/plan", headers=PAGE).text
    assert "Williams&#39; design, balanced over visits, block 2" in page


def test_repeats_are_counted_and_five_policies_refused_by_name(client: TestClient, study_world: Any, external: int) -> None:
    path = f"/api/v1/visits/{study_world.visit}/plan"
    plan = client.post(path, json={"policy_ids": list(study_world.policies[:2]), "repeats": 2}).json()
    assert sorted((s["policy_id"], s["repeat"]) for s in plan["sessions"] if s["policy_id"]) == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert [s["repeat"] for s in plan["sessions"] if s["controller"] == "cdbs"] == [1, 2, 3]
    refused = client.post(path, json={"policy_ids": [*study_world.policies, external], "total_minutes": 300})
    assert (refused.status_code, refused.json()["rule"]) == (422, "policies_per_visit")
    single = client.post(path, json={"policy_ids": [study_world.policies[0]]}).json()
    assert "one_policy" in [w["code"] for w in single["warnings"]]
