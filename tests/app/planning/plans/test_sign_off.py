"""The signature under a plan: by a person who did not draft it, over all that shall run, broken by any change."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pypdf import PdfReader
from sqlalchemy import select, text
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.planning.plans.view import PlanView, read_plan, refuse_running
from app.platform.errors import Conflict
from app.study import repository as study
from app.tables.audit import Signature
from app.tables.learning import Policy
from app.tables.plans import Plan

PASSWORD = "correct horse battery"
PAGE = {"Accept": "text/html"}


def path(study_world: Any, tail: str = "") -> str:
    return f"/api/v1/visits/{study_world.visit}/plan{tail}"


@pytest.fixture
def drafted(client: TestClient, study_world: Any) -> dict[str, Any]:
    answer = client.post(
        path(study_world),
        json={"policy_ids": list(study_world.policies[:2]), "seed": 7, "min_ma": 0.5, "max_ma": 3.5, "random_sessions": 1},
    )
    assert answer.status_code == 201, answer.text
    plan: dict[str, Any] = answer.json()
    return plan


def seen(db: Session, study_world: Any) -> PlanView:
    db.expire_all()
    return read_plan(db, study.visit(db, study_world.visit, SYSTEM), SYSTEM)


def test_limits_are_set_with_the_draft_and_signed(
    client: TestClient, db: Session, study_world: Any, drafted: dict[str, Any], sign_plan: Callable[..., Any]
) -> None:
    limits = {(s["controller"], s["min_ma"], s["max_ma"], s["ramp_ma_per_s"], s["cdbs_ma"]) for s in drafted["sessions"]}
    assert limits == {("rl", 0.5, 3.5, 1.5, 3.0), ("random", 0.9, 3.5, 1.5, 3.0), ("cdbs", 3.0, 3.0, 1.5, 3.0)}
    assert (drafted["signature"], drafted["signature_state"]) == (None, "none")
    signed = sign_plan(study_world.visit, plan_id=drafted["id"]).json()
    assert (signed["signature_state"], signed["signature"]["signer"]) == ("stands", "signer@clinic.example")
    assert signed["signature"]["meaning"] == "approved for use in this participant"
    (row,) = db.scalars(select(Signature))
    sessions = row.content["sessions"]
    assert [s["policy"] for s in sessions] == [s["policy_id"] for s in signed["sessions"]]
    files = {p.id: p.onnx_sha256 for p in db.scalars(select(Policy))}
    assert all(s["policy_sha256"] == files[s["policy"]] for s in sessions if s["policy"])
    assert all(s["max_ma"] == (3.0 if s["controller"] == "cdbs" else 3.5) for s in sessions)
    refuse_running(seen(db, study_world))


def test_nobody_signs_what_they_drafted(client: TestClient, study_world: Any, drafted: dict[str, Any]) -> None:
    refused = client.post(path(study_world, "/approve"), json={"password": PASSWORD})
    assert (refused.status_code, "You drafted plan" in refused.json()["detail"]) == (403, True)
    page = client.get(f"/visits/{study_world.visit}/plan", headers=PAGE).text
    assert "Another clinician reads and signs it." in page
    assert 'type="password"' not in page
    assert client.get(path(study_world)).json()["status"] == "draft"


def test_a_wrong_password_signs_nothing(client_as: Callable[..., TestClient], study_world: Any, drafted: dict[str, Any]) -> None:
    clinician = client_as("clinician")
    for body, status in (({"password": "no"}, 403), ({}, 422)):
        assert clinician.post(path(study_world, "/approve"), json=body).status_code == status
    page = clinician.post(f"/visits/{study_world.visit}/plan/approve", data={"password": "no"}, headers=PAGE)
    assert (page.status_code, "The password is wrong." in page.text) == (403, True)
    assert clinician.get(path(study_world)).json()["status"] == "draft"
    form = {"password": PASSWORD, "plan_id": str(drafted["id"])}
    assert clinician.post(f"/visits/{study_world.visit}/plan/approve", data=form, headers=PAGE, follow_redirects=False).status_code == 303
    assert "signature broken" not in clinician.get(f"/visits/{study_world.visit}/plan", headers=PAGE).text


@pytest.mark.parametrize(
    "change",
    [
        "update plan_item set max_ma = 4 where policy_id is not null",
        "update plan_item set ramp_ma_per_s = 9 where position = 2",
        "update plan_item set position = 10 - position",
        "update plan_item set controller = 'distilled' where policy_id is not null",
        "update plan_item set minutes = 20",
        "update plan_item set min_fraction = 0.9 where policy_id is not null",
        "update plan_item set override_reason = 'watched' where policy_id is not null",
        "update plan_item set design = jsonb_set(design, '{lower_bound}', '0.1') where design is not null",
        "update policy set onnx_sha256 = (select min(onnx_sha256) from policy)",
        "update plan set note = 'something else'",
    ],
)
def test_any_change_breaks_the_signature_visibly(
    client: TestClient, db: Session, study_world: Any, drafted: dict[str, Any], sign_plan: Callable[..., Any], change: str
) -> None:
    assert sign_plan(study_world.visit).status_code == 200
    db.execute(text(change))
    db.commit()
    assert client.get(path(study_world)).json()["signature_state"] == "broken"
    assert "signature is broken" in client.get(f"/visits/{study_world.visit}/plan", headers=PAGE).text
    sheet = PdfReader(BytesIO(client.get(path(study_world, ".pdf")).content)).pages[0].extract_text()
    assert "SIGNATURE BROKEN" in sheet
    with pytest.raises(Conflict, match="was changed after it was signed"):
        refuse_running(seen(db, study_world))


def test_what_is_signed_runs_only_while_its_policies_and_its_amplitude_are_those_of_today(
    client: TestClient, db: Session, study_world: Any, drafted: dict[str, Any], sign_plan: Callable[..., Any]
) -> None:
    with pytest.raises(Conflict, match="is not signed yet"):
        refuse_running(seen(db, study_world))
    assert sign_plan(study_world.visit).status_code == 200
    db.get_one(Policy, study_world.policies[0]).retired_reason = "speech"
    db.flush()
    with pytest.raises(Conflict, match="was retired after this plan was drafted: speech"):
        refuse_running(seen(db, study_world))
    db.rollback()
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 2.5}})
    with pytest.raises(Conflict, match=r"set for a cDBS amplitude of 3 mA; it is 2\.5 mA now"):
        refuse_running(seen(db, study_world))


def test_limits_of_another_amplitude_are_not_signed(
    client: TestClient, study_world: Any, drafted: dict[str, Any], sign_plan: Callable[..., Any]
) -> None:
    client.patch(
        f"/api/v1/visits/{study_world.visit}", json={"cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": 2.0}], "reason": "new"}
    )
    assert "The plan cannot be signed" in " ".join(w["text"] for w in client.get(path(study_world)).json()["warnings"])
    refused = sign_plan(study_world.visit)
    assert (refused.status_code, "it is 2 mA now" in refused.json()["detail"]) == (409, True)


def test_plans_approved_before_signatures_say_so(client: TestClient, db: Session, study_world: Any, drafted: dict[str, Any]) -> None:
    plan = db.get_one(Plan, drafted["id"])
    plan.status, plan.approved_by, plan.approved_at = "approved", "ada@clinic.example", plan.created_at
    db.commit()
    assert client.get(path(study_world)).json()["signature_state"] == "not_kept"
    with pytest.raises(Conflict, match="kept no signature"):
        refuse_running(seen(db, study_world))
