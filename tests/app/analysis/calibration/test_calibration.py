"""Predicted against actual, from sessions with known beta and estimates with known values."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, update
from sqlalchemy.orm import Session

from app.tables.evaluations import Evaluation
from app.tables.plans import Plan
from app.tables.sessions import StudySession
from app.tables.visits import Visit
from tests.app.evaluations import estimate

Upload = Callable[..., int]
CALIBRATION = "/api/v1/participants/P1/calibration"
QOC = {"grasp_hz": 2.0, "rating": 8, "tremor_percent": 20.0}


@pytest.fixture(autouse=True)
def second_visit(client: TestClient, policies: list[int]) -> None:
    """A visit after the one whose sessions the estimates rest on."""
    assert client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2026-03-02"}).status_code == 201


def calibration(client: TestClient) -> dict[str, Any]:
    answer = client.get(CALIBRATION)
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def by_hand(client: TestClient, session: int, level: float, horizon: int = 60) -> float:
    """Compute r_end + discounted rewards of the first H steps, from the trace as the REST interface gives it."""
    beta = np.array(client.get(f"/api/v1/sessions/{session}/trace").json()["beta"][10 : 10 + horizon])
    steps = np.where(beta < 1.0, 0.0, -1.0) - 0.3 * level
    return float(steps @ 0.99 ** np.arange(beta.size) + 10 * 2.0 + 10 * 8 - 10 * 0.2)


def test_numbers_are_those_computed_by_hand(client: TestClient, upload: Upload, policies: list[int], evaluate: Callable[..., int]) -> None:
    a, b, _ = policies
    fqe = {"estimates": {str(a): estimate("fqe", 70.0, spread=40), str(b): estimate("fqe", 60.0)}}
    evaluation = evaluate({a: estimate("dlsm", 50.0), b: estimate("dlsm", 90.0)}, {1.0: 45.0}, fqe=fqe)
    levels = {a: [0.8, 0.8, 0.8], b: [0.4]}
    sessions = {i: [upload("rl", level=v, policy=i, visit=2, qoc=QOC) for v in own] for i, own in levels.items()}
    reference = upload("cdbs", visit=2, qoc=QOC)
    body = calibration(client)
    assert (body["missing"], body["left_out"], body["methods"]) == (None, [], ["dlsm", "fqe"])
    actual = {i: float(np.mean([by_hand(client, s, v) for s, v in zip(own, levels[i], strict=True)])) for i, own in sessions.items()}
    found = {p["policy_id"]: p for p in body["policies"] if p["reference"] is None}
    assert {i: p["sessions"] for i, p in found.items()} == {a: 3, b: 1}
    assert {p["evaluation_id"] for p in found.values()} == {evaluation}
    for i, p in found.items():
        dlsm = p["predictions"][0]
        assert dlsm["actual"] == pytest.approx(actual[i], abs=1e-4)
        assert (dlsm["predicted"], dlsm["method"], dlsm["parts"]) == ({a: 50.0, b: 90.0}[i], "dlsm", "return")
        shown = {q["name"]: (q["predicted"], q["actual"]) for q in dlsm["quantities"]}
        assert shown["rating"] == (7.5, 8.0)
        assert shown["grasp_hz"] == (2.1, 2.0)
        assert shown["energy"] == (0.4, pytest.approx(levels[i][0] ** 2, abs=1e-5))
    low, high = found[a]["predictions"][0]["actual_low"], found[a]["predictions"][0]["actual_high"]
    assert low <= actual[a] <= high
    assert found[b]["predictions"][0]["actual_low"] is None  # one session
    (cdbs,) = [p for p in body["policies"] if p["reference"] == "cdbs"]
    assert cdbs["predictions"][0]["actual"] == pytest.approx(by_hand(client, reference, 1.0), abs=1e-4)
    metrics = {(m["method"], m["visit"]): m for m in body["metrics"]}
    gap = abs(actual[a] - actual[b])
    for visit in (None, 2):
        dlsm = metrics["dlsm", visit]
        assert dlsm["policies"] == 2  # cDBS is shown and not counted
        assert dlsm["mae"]["value"] == pytest.approx((abs(50 - actual[a]) + abs(90 - actual[b])) / 2, abs=1e-4)
        taken = b  # the higher estimate
        lost = max(actual.values()) - actual[taken]
        assert dlsm["regret"]["value"] == pytest.approx(lost, abs=1e-4)
        assert dlsm["regret_of_range"]["value"] == pytest.approx(lost / gap, abs=1e-4)
        assert dlsm["regret_as_paper"]["value"] == pytest.approx(lost / max(actual.values()), abs=1e-4)
        assert dlsm["rank_correlation"]["value"] == pytest.approx(1.0 if actual[b] > actual[a] else -1.0)
    assert metrics["fqe", 2]["rank_correlation"]["value"] == -metrics["dlsm", 2]["rank_correlation"]["value"]
    errors = {(q["method"], q["name"]): q["mae"] for q in body["quantities"]}
    assert errors["dlsm", "rating"] == pytest.approx(0.5)
    page = client.get("/participants/P1/calibration")
    assert page.status_code == 200
    for text in ("Worth of a session, predicted and seen", "Regret@1", "cDBS (reference)", "Mean absolute error of every method", ">p0<"):
        assert text in page.text
    assert client.get("/participants/P1/calibration", params={"method": "fqe"}).status_code == 200
    assert client.get("/participants/P1/calibration", params={"method": "wis"}).status_code == 422


def test_the_prediction_of_a_visit_is_that_of_its_signed_plan(
    client: TestClient, upload: Upload, policies: list[int], evaluate: Callable[..., int], db: Session
) -> None:
    a = policies[0]
    planned = evaluate({a: estimate("dlsm", 50.0)})
    newer = evaluate({a: estimate("dlsm", 90.0)})
    for visit, pinned in ((2, planned), (3, None)):
        if visit == 3:
            client.post("/api/v1/participants/P1/visits", json={"number": 3, "date": "2026-04-02"})
        row = db.scalars(select(Visit).where(Visit.number == visit)).one()
        if pinned is not None:
            db.add(
                Plan(
                    visit_id=row.id, evaluation_id=pinned, status="approved", seed=1, rules={}, created_by="a", approved_by="b",
                    approved_at=row.created_at,
                )
            )  # fmt: skip
        db.commit()
        upload("rl", level=0.8, policy=a, visit=visit, qoc=QOC)
    found = {p["visit"]: p for p in calibration(client)["policies"]}
    assert {v: p["evaluation_id"] for v, p in found.items()} == {2: planned, 3: newer}
    assert [found[v]["predictions"][0]["predicted"] for v in (2, 3)] == [50.0, 90.0], "tested twice, the policy is two facts"


def test_an_evaluation_made_after_a_session_arrived_counts_for_nothing(
    client: TestClient, upload: Upload, policies: list[int], evaluate: Callable[..., int], db: Session
) -> None:
    a = policies[0]
    assert calibration(client)["missing"] == "an evaluation of this participant's policies"
    first = evaluate({i: estimate("dlsm", 50.0) for i in policies})
    assert "later visit" in client.get("/participants/P1/calibration").text
    assert calibration(client)["missing"] == "a session of a ranked policy at a visit whose sessions all arrived after that ranking"
    upload("rl", level=0.8, policy=a, visit=2, qoc=QOC)
    evaluate({i: estimate("dlsm", 99.0) for i in policies})
    # this session belongs to the same day: the later evaluation has seen the day's first session
    upload("rl", level=0.8, policy=a, visit=2, qoc=QOC)
    body = calibration(client)
    assert [(p["evaluation_id"], p["sessions"], p["predictions"][0]["predicted"]) for p in body["policies"]] == [(first, 2, 50.0)]
    # had the evaluations been stored a moment after the day's first session arrived, nothing could be compared
    arrived = db.scalars(select(StudySession.created_at).join(StudySession.visit).where(Visit.number == 2)).all()
    db.execute(update(Evaluation).values(created_at=min(arrived) + timedelta(microseconds=1)))
    db.commit()
    body = calibration(client)
    assert (body["policies"], body["metrics"]) == ([], [])
    assert "visit 2: no evaluation had been made before its sessions" in body["left_out"]


def test_sessions_that_cannot_be_compared_are_named_with_their_reason(
    client: TestClient, upload: Upload, policies: list[int], evaluate: Callable[..., int]
) -> None:
    a, b, c = policies
    evaluate({a: estimate("dlsm", 50.0), b: estimate("dlsm", 60.0)}, {1.0: 45.0})
    short = upload("rl", level=0.8, policy=a, visit=2, steps=5, qoc=QOC)
    silent = upload("rl", level=0.8, policy=a, visit=2, qoc={"rating": 8})
    excluded = upload("rl", level=0.8, policy=b, visit=2, qoc=QOC)
    client.patch(f"/api/v1/sessions/{excluded}", json={"excluded_reason": "tablet froze"})
    unranked = upload("rl", level=0.8, policy=c, visit=2, qoc=QOC)
    body = calibration(client)
    assert body["policies"] == []
    reasons = "\n".join(body["left_out"])
    assert f"session {short}: too few of its first 60 steps are known" in reasons
    assert f"session {silent}: an outcome that r_end needs was not measured" in reasons
    assert f"session {excluded}: excluded by a person: tablet froze" in reasons
    assert f"session {unranked}: evaluation" in reasons
    assert "Not compared" in client.get("/participants/P1/calibration").text


def test_a_method_without_r_end_is_held_against_the_step_returns(
    client: TestClient, upload: Upload, policies: list[int], evaluate: Callable[..., int]
) -> None:
    a = policies[0]
    steps = estimate("fqe", -30.0) | {"end_reward": None, "step_return": -30.0}
    evaluate({a: estimate("dlsm", 50.0)}, fqe={"estimates": {str(a): steps}})
    session = upload("rl", level=0.8, policy=a, visit=2, qoc=QOC)
    (p,) = calibration(client)["policies"]
    fqe = next(q for q in p["predictions"] if q["method"] == "fqe")
    assert (fqe["parts"], fqe["predicted"]) == ("steps", -30.0)
    assert fqe["actual"] == pytest.approx(by_hand(client, session, 0.8) - 98.0, abs=1e-4)
