"""A finished visit comes back into its plan: found, missing, confirmed in one step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.planning.slots.repository import slots_filled
from app.tables.sessions import StudySession
from tests.app.words import flat

DAY = "2026-04-06"
PAGE = {"Accept": "text/html"}


def recording(seed: int, controlled: bool) -> str:
    rows = "".join(f"{2 * k},{1.5 + 0.001 * seed + 0.001 * k},{0.6 if controlled and k % 2 else 1}\n" for k in range(-9, 301))
    return f"t_s,beta,amplitude_fraction\n{rows}"


@pytest.fixture
def plan(client: TestClient, study_world: Any, sign_plan: Callable[..., Any]) -> list[dict[str, Any]]:
    assert client.patch(f"/api/v1/visits/{study_world.visit}", json={"date": DAY, "reason": "agreed"}).status_code == 200
    body = {"policy_ids": list(study_world.policies[:2]), "order": "stated", "repeats": 2, "seed": 1}
    assert client.post(f"/api/v1/visits/{study_world.visit}/plan", json=body).status_code == 201
    plan = sign_plan(study_world.visit).json()
    sessions: list[dict[str, Any]] = plan["sessions"]
    assert [s["policy_id"] for s in sessions] == [1, None, 2, None, 1, None, 2]
    return sessions


def send(client: TestClient, number: int, minute: int, *, day: str = DAY, controlled: bool = True, **stated: str) -> dict[str, Any]:
    data = {"participant": "P1", "visit": "2", "started_at": f"{day}T09:{minute:02d}:00Z", **stated}
    answer = client.post("/api/v1/uploads", data=data, files={"file": (f"{number}.csv", recording(number, controlled))})
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def test_uploads_of_the_day_are_found_in_their_slots_and_confirmed_in_one_step(
    client: TestClient, study_world: Any, plan: list[dict[str, Any]], db: Session
) -> None:
    path = f"/api/v1/visits/{study_world.visit}/slots"
    for i, slot in enumerate(plan):
        if i == 3:
            continue  # the second cDBS session was not uploaded
        known = {"controller": slot["controller"]} | ({"policy": slot["policy"]} if slot["policy"] else {})
        send(
            client, i, 8 * i, controlled=slot["controller"] == "rl", **(known if i < 5 else {})
        )  # the controller of the last ones is not stated
    found = client.get(path).json()
    assert (found["planned"], found["found"], found["missing"]) == (7, 6, ["cDBS 2"])
    assert [r["confirmed"] for r in found["rows"]] == [False] * 7
    page = client.get(f"/visits/{study_world.visit}/slots", headers=PAGE).text
    assert "6 of 7 planned sessions found; cDBS 2 is missing" in page
    done = client.post(f"{path}/confirm", json={})
    assert done.status_code == 200, done.text
    rows = done.json()["comparison"]["rows"]
    assert [r["confirmed"] for r in rows] == [True, True, True, False, True, True, True]
    assert rows[3]["deviations"] == ["missing"]
    assert rows[0]["predicted"]["energy"] == pytest.approx(0.4)
    assert rows[0]["done"]["energy"] == pytest.approx((0.36 + 1) / 2)
    db.expire_all()
    held = db.scalars(select(StudySession).where(StudySession.visit_id == study_world.visit)).all()
    assert {s.status for s in held} == {"confirmed"}
    assert len({s.plan_item_id for s in held} - {None}) == 6
    again = client.post(f"{path}/confirm", json={})
    assert (again.status_code, "has nothing to confirm" in again.json()["detail"]) == (409, True)


def test_a_plan_that_is_signed_anew_keeps_what_was_done_that_day(
    client: TestClient, study_world: Any, plan: list[dict[str, Any]], sign_plan: Callable[..., Any], db: Session
) -> None:
    path = f"/api/v1/visits/{study_world.visit}/slots"
    for i, slot in enumerate(plan[:3]):
        known = {"controller": slot["controller"]} | ({"policy": slot["policy"]} if slot["policy"] else {})
        send(client, i, 8 * i, controlled=slot["controller"] == "rl", **known)
    confirmed = client.post(f"{path}/confirm", json={}).json()["comparison"]["rows"]
    held = {r["session_id"]: r["done"] for r in confirmed if r["session_id"]}
    assert len(held) == 3
    again = {"policy_ids": [study_world.policies[1]], "order": "stated", "seed": 1, "reason": "the device was refused"}
    drafted = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=again)
    assert drafted.status_code == 201, drafted.text
    assert sign_plan(study_world.visit).status_code == 200
    found = client.get(path).json()
    slots = len(drafted.json()["sessions"])
    assert (found["planned"], found["found"]) == (slots, 0), "the new plan asks for sessions of its own"
    kept = [r for r in found["rows"] if r["position"] is None]
    assert {r["session_id"]: r["done"] for r in kept} == held
    assert all(r["confirmed"] and r["deviations"] == ["earlier_plan"] and r["name"] == "planned before" for r in kept)
    page = flat(client.get(f"/visits/{study_world.visit}", headers=PAGE).text)
    assert f"0 of {slots} planned sessions found; 3 sessions of the plan signed before are kept" in page
    (progress,) = slots_filled(db, [1])
    assert (progress.slots, progress.filled) == (slots + 3, 3)


def test_sessions_of_another_year_are_asked_about(client: TestClient, study_world: Any, plan: list[dict[str, Any]]) -> None:
    send(client, 1, 0, day="2024-04-06", controller="rl", policy="rl-01")
    path = f"/visits/{study_world.visit}/slots"
    asked = client.post(f"/api/v1{path}/confirm", json={})
    assert (asked.status_code, asked.json()["asks"]) == (409, "other_day")
    assert "2024-04-06" in asked.json()["detail"]
    assert client.get(f"/api/v1{path}").json()["rows"][0]["deviations"] == ["other_day"]
    assert "Sessions of another day belong to this visit all the same" in flat(client.get(path, headers=PAGE).text)
    meant = client.post(f"{path}/confirm", data={"other_day": "yes"}, headers=PAGE)
    assert (meant.status_code, "Confirmed" in meant.text) == (200, True)


def test_a_visit_without_recordings_or_a_signature_has_nothing_to_confirm(
    client: TestClient, study_world: Any, sign_plan: Callable[..., Any]
) -> None:
    path = f"/api/v1/visits/{study_world.visit}/slots"
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[0]]})
    unsigned = client.get(path)
    assert (unsigned.status_code, "is not signed" in unsigned.json()["detail"]) == (409, True)
    assert sign_plan(study_world.visit).status_code == 200
    assert client.get(path).json()["found"] == 0
    assert client.post(f"{path}/confirm", json={}).status_code == 409
