"""Blinded plans: letters and common limits while the key is sealed, opened with a reason, in an emergency at once."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pypdf import PdfReader
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.audit import AuditEvent

PAGE = {"Accept": "text/html"}


@pytest.fixture
def path(client: TestClient, study_world: Any, sign_plan: Callable[..., Any]) -> str:
    body = {"policy_ids": list(study_world.policies), "blinded": True, "no_dbs": True, "min_ma": 0.5}
    drafted = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=body).json()
    assert (drafted["key"]["sealed"], drafted["sessions"][0]["controller"] is None) == (False, False), "who signs has read it"
    assert sign_plan(study_world.visit).status_code == 200
    return f"/api/v1/visits/{study_world.visit}/plan"


def test_every_session_has_a_letter_of_its_own_and_nothing_tells_its_controller(client: TestClient, study_world: Any, path: str) -> None:
    plan = client.get(path).json()
    sessions = plan["sessions"]
    assert plan["key"]["sealed"] is True
    assert sorted(s["label"] for s in sessions) == [chr(ord("A") + i) for i in range(8)]
    telling = ("controller", "policy_id", "policy", "estimate", "predicted_energy", "verdict", "min_fraction", "override_reason", "design")
    assert {s[name] for s in sessions for name in telling} == {None}
    # those of the session without stimulation and of cDBS are within them
    assert {(s["min_ma"], s["max_ma"], s["ramp_ma_per_s"], s["repeat"]) for s in sessions} == {(0.0, 3.0, 1.5, 1)}
    day = client.get(f"/visits/{study_world.visit}/plan", headers=PAGE).text
    sheet = " ".join(p.extract_text() for p in PdfReader(BytesIO(client.get(f"{path}.pdf").content)).pages)
    for text in (day, sheet, str(plan["warnings"])):
        assert not [name for name in ("rl-01", "rl-02", "Distilled", "not supported", "95.0") if name in text]
    assert "key sealed" in day
    form = client.get(f"/visits/{study_world.visit}/plan?replace=yes", headers=PAGE).text
    assert "rl-01" in form[form.index('id="draft"') :], "policies are named to who would replace the plan, and ticked are none"
    assert " checked>" not in form


def test_the_key_is_opened_with_a_reason_and_stands_in_the_audit_trail(
    client: TestClient, client_as: Callable[..., TestClient], db: Session, path: str
) -> None:
    assert client_as("engineer").post(f"{path}/key", json={"reason": "curious"}).status_code == 403
    assert client.post(f"{path}/key", json={}).status_code == 422
    opened = client.post(f"{path}/key", json={"reason": "end of the visit"}).json()
    assert (opened["key"]["sealed"], opened["key"]["reason"], opened["signature_state"]) == (False, "end of the visit", "stands")
    assert {s["policy"] for s in opened["sessions"]} >= {"rl-01", "rl-02"}
    assert "end of the visit" in db.scalars(select(AuditEvent.reason).where(AuditEvent.entity == "plan")).all()
    assert client.post(f"{path}/key", json={"reason": "again"}).status_code == 409


def test_in_an_emergency_one_action_opens_it_and_the_reason_is_asked_for_afterwards(
    client_as: Callable[..., TestClient], study_world: Any, path: str
) -> None:
    clinician = client_as("clinician")
    page = f"/visits/{study_world.visit}/plan"
    opened = clinician.post(f"{page}/key", data={"emergency": "yes"}, headers=PAGE, follow_redirects=False)
    assert opened.status_code == 303
    plan = clinician.get(path).json()
    assert (plan["key"]["emergency"], plan["key"]["reason"], plan["key"]["opened_by"]) == (True, None, "clinician@clinic.example")
    assert any(w["code"] == "key_reason_missing" for w in plan["warnings"])
    assert "Give the reason" in clinician.get(page, headers=PAGE).text
    assert clinician.post(f"{path}/key", json={"reason": "dystonia in session C"}).status_code == 200
    assert clinician.get(path).json()["key"]["reason"] == "dystonia in session C"


def test_a_plan_that_is_not_blinded_has_no_key(client: TestClient, study_world: Any) -> None:
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[0]]})
    assert client.get(f"/api/v1/visits/{study_world.visit}/plan").json()["key"] is None
    refused = client.post(f"/api/v1/visits/{study_world.visit}/plan/key", json={"reason": "x"})
    assert (refused.status_code, "is not blinded" in refused.json()["detail"]) == (409, True)
