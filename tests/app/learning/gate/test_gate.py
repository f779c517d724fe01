"""The gate of the replay buffer: what lets sessions of learned policies in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.snapshots import collect
from app.study.repository import participant_by_code
from app.tables.learning import BufferGateDecision

Upload = Callable[..., int]
GATE = "/api/v1/participants/P1/buffer-gate"


def qoc(grasp: float, rating: int, tremor: float) -> dict[str, Any]:
    return {"grasp_hz": grasp, "rating": rating, "tremor_percent": tremor}


def sessions(upload: Upload, learned: list[dict[str, Any]], random: list[dict[str, Any]]) -> tuple[list[int], list[int]]:
    return [upload("rl", steps=20, level=0.6, qoc=q) for q in learned], [upload("random", steps=20, qoc=q) for q in random]


def left_out(db: Session) -> dict[int, str]:
    db.rollback()
    return {m.session.id: m.left_out for m in collect(db, participant_by_code(db, "P1", SYSTEM)).members if m.left_out}


def test_sessions_of_learned_policies_stay_out_while_nothing_shows_that_they_are_better(
    upload: Upload, client: TestClient, db: Session
) -> None:
    learned, _ = sessions(upload, [qoc(2.0, 7, 10.0)] * 2, [qoc(2.0, 7, 10.0)] * 2)
    gate = client.get(GATE).json()
    assert gate["open"] is False
    assert "not enough sessions" in gate["grounds"]
    reasons = left_out(db)
    assert set(reasons) == set(learned)
    assert all("these are not learned from" in why for why in reasons.values())


def test_they_enter_once_a_qoc_is_significantly_better_and_none_is_worse(upload: Upload, client: TestClient, db: Session) -> None:
    sessions(
        upload,
        [qoc(2.0 + k / 100, 9, 10.0) for k in range(4)],
        [qoc(2.0 + k / 90, 4 + k % 2, 10.0) for k in range(4)],
    )
    gate = client.get(GATE).json()
    rating = next(t for t in gate["tests"] if t["qoc"] == "rating")
    # complete separation of 4 against 4 is one of 70 rankings; given the ties it is still 1/70, times 3 QoCs
    assert rating["p_better"] == pytest.approx(3 / 70)
    assert gate["open"] is True
    assert "rating significantly better" in gate["grounds"]
    assert left_out(db) == {}


def test_designed_sessions_are_the_random_arm(upload: Upload, client: TestClient) -> None:
    learned, random = sessions(upload, [qoc(2.0, 9, 10.0)] * 4, [qoc(2.0, 4, 10.0)] * 4)
    for session, design in zip(random, ("stratified", "near", "ladder", "paper"), strict=True):
        stated = client.put(f"/api/v1/sessions/{session}/conditions", json={"design": design, "seed": 1, "reason": "as planned"})
        assert stated.status_code == 200, stated.text
    gate = client.get(GATE).json()
    assert {(t["n_learned"], t["n_random"]) for t in gate["tests"]} == {(len(learned), 4)}
    assert gate["open"] is True


def test_a_qoc_that_is_significantly_worse_keeps_the_gate_shut(upload: Upload, client: TestClient, db: Session) -> None:
    learned, _ = sessions(upload, [qoc(2.0, 9, 60.0 + k) for k in range(4)], [qoc(2.0, 4, 5.0 + k) for k in range(4)])
    gate = client.get(GATE).json()
    assert gate["open"] is False
    assert "tremor significantly worse" in gate["grounds"]
    assert set(left_out(db)) == set(learned)


def test_an_excluded_session_is_no_evidence(upload: Upload, client: TestClient) -> None:
    learned, _ = sessions(upload, [qoc(2.0, 9, 10.0)] * 4, [qoc(2.0, 4, 10.0)] * 4)
    assert client.get(GATE).json()["open"] is True
    client.patch(f"/api/v1/sessions/{learned[0]}", json={"excluded_reason": "cable came loose"})
    gate = client.get(GATE).json()
    assert next(t for t in gate["tests"] if t["qoc"] == "rating")["n_learned"] == 3
    assert gate["open"] is False


def test_a_clinician_may_open_it_with_a_reason_shut_it_again_and_go_back_to_the_tests(
    upload: Upload, client: TestClient, db: Session
) -> None:
    learned, _ = sessions(upload, [qoc(2.0, 7, 10.0)] * 2, [qoc(2.0, 7, 10.0)] * 2)
    opened = client.post(GATE, json={"choice": "open", "reason": "too few visits for a test"}).json()
    assert opened["open"] is True
    assert "too few visits for a test" in opened["grounds"]
    assert left_out(db) == {}
    client.post(GATE, json={"choice": "shut", "reason": "wrong firmware"})
    assert set(left_out(db)) == set(learned)
    back = client.post(GATE, json={"choice": "test", "reason": "firmware mended"}).json()
    assert back["open"] is back["opened_by_test"] is False


def test_a_decision_without_a_reason_is_refused_and_none_is_ever_changed(client: TestClient, participant_code: str, db: Session) -> None:
    assert client.post(GATE, json={"choice": "open", "reason": "  "}).status_code == 422
    client.post(GATE, json={"choice": "open", "reason": "agreed"})
    row = db.query(BufferGateDecision).one()
    row.reason = "another"
    with pytest.raises(DBAPIError, match="never changed"):
        db.flush()
    db.rollback()


def test_the_page_shows_the_tests_and_takes_a_decision(upload: Upload, client: TestClient) -> None:
    sessions(upload, [qoc(2.0, 9, 10.0)] * 4, [qoc(2.0, 4, 10.0)] * 4)
    page = client.get("/participants/P1/buffer-gate").text
    assert "significantly better" in page
    assert ">.043<" in page
    refused = client.post("/participants/P1/buffer-gate", data={"choice": "shut", "reason": ""})
    assert refused.status_code == 422
    assert "Reason" in refused.text
    answer = client.post("/participants/P1/buffer-gate", data={"choice": "shut", "reason": "washout too short"})
    assert "washout too short" in answer.text
    assert "shut" in answer.text
