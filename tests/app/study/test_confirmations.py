"""A declared confirmation: signed once, by locked margins; it counts all later sessions of its policy, whatever is planned afterwards."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from tests.app.analysis.conftest import add_session as add_session
from tests.app.evaluations import judge as judge
from tests.app.evaluations import policies as policies
from tests.conftest import PASSWORD

HOME = "/api/v1/participants/P1"
PRIMARY = f"{HOME}/analyses/primary"
AddSession = Callable[..., int]


def lock(client: TestClient, version: int = 1) -> None:
    body = {"version": version, "reason": "protocol 3.2", "password": PASSWORD}
    assert client.post(f"{HOME}/margins/locks", json=body).status_code == 201


def declare(client: TestClient, policy: int, **change: Any) -> Any:
    body = {"policy_id": policy, "reason": "the best of visit 3", "password": PASSWORD} | change
    return client.post(f"{HOME}/confirmations", json=body)


def add_visits(add_session: AddSession, visits: range, policy: int, hours: float = 1) -> None:
    """Add two sessions of either arm to each visit, which begin so many hours from now."""
    for visit in visits:
        for k in range(2):
            begins = datetime.now(UTC) + timedelta(hours=hours)
            day = {"grasp": 2.0 + 0.01 * visit + 0.02 * k, "rating": 8, "tremor": 10.0 + k, "visit": visit, "started_at": begins}
            add_session("cdbs", **day)
            add_session("rl", fraction=0.6 + 0.01 * ((visit + k) % 3), policy_id=policy, **day)


def test_a_confirmation_needs_locked_margins_a_signature_and_is_declared_once(
    client: TestClient, client_as: Callable[[str], TestClient], policies: list[int], db: Session
) -> None:
    early = declare(client, policies[0])
    assert (early.status_code, early.json()["detail"]) == (409, "The present margins are not locked.")
    assert "Lock the present margins first" in client.get("/participants/P1/margins").text
    lock(client)
    assert "Declare the confirmation" in client.get("/participants/P1/margins").text
    assert declare(client, policies[0], password="wrong").status_code == 403
    assert declare(client, 999).status_code == 404
    assert declare(client_as("viewer"), policies[0]).status_code == 403
    made = declare(client, policies[0])
    assert made.status_code == 201, made.text
    assert (made.json()["signature_state"], made.json()["margins_version"]) == ("stands", 1)
    assert declare(client, policies[0]).status_code == 409, "once"
    with pytest.raises(Exception, match="never changed"):
        db.execute(text("update declared_confirmation set reason = 'later'"))
    db.rollback()
    trail = client.get("/audit?entity=declared_confirmation").text
    assert "declared the confirmation of policy p0" in trail


def test_later_sessions_of_a_declared_policy_confirm_whatever_is_planned_and_locked_afterwards(
    client: TestClient, policies: list[int], add_session: AddSession, db: Session
) -> None:
    a, b = policies[:2]
    add_visits(add_session, range(2, 4), a, hours=-24)
    lock(client)
    assert declare(client, a).status_code == 201
    add_visits(add_session, range(4, 9), a)
    add_visits(add_session, range(10, 11), a, hours=-1)  # sent late: it began before
    add_visits(add_session, range(9, 10), b)
    visit = client.post(f"{HOME}/visits", json={"number": 20, "date": "2099-11-22"}).json()["id"]
    assert client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [a], "min_ma": 0.5}).status_code == 201
    db.execute(text("update plan set status = 'approved', approved_at = clock_timestamp(), approved_by = 'signer'"))
    db.commit()
    change = client.put(f"{HOME}/margins", json={"margins": {"rating_points": 3}, "reason": "looser"}).json()
    lock(client, change["version"])
    answer = client.get(PRIMARY).json()
    found = {(v["policy_id"], v["confirmatory"]): v for v in answer["policy_verdicts"]}
    assert found.keys() == {(a, True), (a, False), (b, False)}
    one = found[a, True]
    assert (one["visits"], one["margins"]["version"]) == ([4, 5, 6, 7, 8], 1)
    assert one["verdict"] == "non_inferior_and_saving", one["sentence"]
    assert "whatever was planned" in one["basis"]
    assert one["sentence"].startswith("p0 is non-inferior")
    standing = next(s["sentence"] for s in answer["standings"] if s["policy_id"] == a)
    assert standing.startswith("p0. Declared confirmation: p0 is non-inferior")
    compared = next(r for r in answer["results"] if r["policy_id"] == a)
    assert (compared["basis"], len(compared["session_ids"])) == ("confirmation", 10), "the newer plan takes no evidence away"
    page = client.get("/participants/P1/analyses").text
    assert one["sentence"] in page
    assert "Each policy by itself" in page


def test_without_a_lock_the_pages_say_what_that_costs(client: TestClient, policies: list[int], add_session: AddSession) -> None:
    add_visits(add_session, range(2, 5), policies[0])
    assert "Visits that begin before a lock can never confirm" in client.get("/participants/P1/analyses").text
    visit = client.post(f"{HOME}/visits", json={"number": 20, "date": "2099-11-22"}).json()["id"]
    draft = client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [policies[0]], "min_ma": 0.5}).json()
    assert "margins_not_locked" in [w["code"] for w in draft["warnings"]]
    assert "can never confirm a policy" in client.get(f"/visits/{visit}/plan", headers={"Accept": "text/html"}).text
    lock(client)
    later = client.get(f"/api/v1/visits/{visit}/plan").json()
    assert "margins_not_locked" not in [w["code"] for w in later["warnings"]]
