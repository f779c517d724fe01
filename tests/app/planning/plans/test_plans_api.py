"""Visit plans over REST: drafted, approved, fixed, superseded."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.evaluation.estimates.service import estimate_of, store_evaluation
from app.tables.audit import AuditEvent
from app.tables.evaluations import Evaluation
from app.tables.learning import BufferSnapshot, Policy
from app.tables.plans import Plan

PASSWORD = "correct horse battery"


def _path(visit_id: int, tail: str = "") -> str:
    return f"/api/v1/visits/{visit_id}/plan{tail}"


def _draft(client: TestClient, study_world: Any, **more: Any) -> Any:
    return client.post(_path(study_world.visit), json={"policy_ids": list(study_world.policies[:3]), "seed": 7, **more})


def test_a_visit_without_a_plan_says_how_to_get_one(client: TestClient, study_world: Any) -> None:
    answer = client.get(_path(study_world.visit))
    assert answer.status_code == 404
    assert answer.json()["detail"] == "Visit 2 of participant P1 has no plan yet."
    assert "draft one" in answer.json()["hint"]
    assert client.get(_path(study_world.visit, ".pdf")).status_code == 404
    assert client.post(_path(study_world.visit, "/approve"), json={"password": PASSWORD}).status_code == 404


def test_a_draft_has_a_cdbs_session_between_any_two_policies(client: TestClient, study_world: Any) -> None:
    answer = _draft(client, study_world)
    assert answer.status_code == 201
    plan = answer.json()
    assert (plan["status"], plan["seed"], plan["visit"], plan["participant"]) == ("draft", 7, 2, "P1")
    tested = [i for i, s in enumerate(plan["sessions"]) if s["policy_id"]]
    assert sorted(plan["sessions"][i]["policy_id"] for i in tested) == sorted(study_world.policies[:3])
    assert all("cdbs" in [s["controller"] for s in plan["sessions"][i:j]] for i, j in pairwise(tested))
    assert {s["policy"]: s["controller"] for s in plan["sessions"] if s["policy"]} == {
        "rl-01": "rl", "rl-02": "rl", "rl-01-small": "distilled",
    }  # fmt: skip
    assert plan["total_minutes"] == 70
    assert client.get(_path(study_world.visit)).json() == plan


def test_the_same_seed_draws_the_same_day_and_a_drawn_one_is_recorded(client: TestClient, study_world: Any) -> None:
    first = _draft(client, study_world, seed=None).json()
    again = _draft(client, study_world, seed=first["seed"]).json()
    assert [s["policy_id"] for s in again["sessions"]] == [s["policy_id"] for s in first["sessions"]]


def test_options_shape_the_day(client: TestClient, study_world: Any) -> None:
    plan = _draft(
        client,
        study_world,
        minutes_per_session=12.5,
        washout_minutes=2,
        no_dbs=True,
        random_sessions=2,
        total_minutes=200,
        note="left hand",
    ).json()
    controllers = [s["controller"] for s in plan["sessions"]]
    assert (controllers.count("random"), controllers[-1], plan["note"]) == (2, "no_dbs", "left hand")
    assert plan["total_minutes"] == 7 * 12.5 + 5 + 7 * 2
    assert plan["sessions"][-1]["minutes"] == 5


def test_a_day_that_does_not_fit_is_refused_with_the_number_that_would(client: TestClient, study_world: Any) -> None:
    answer = _draft(client, study_world, total_minutes=60)
    assert answer.status_code == 422
    assert answer.json()["detail"] == "3 policies with the sessions around them take 70 minutes; the visit has 60."
    assert answer.json()["policies_that_fit"] == 2
    assert client.get(_path(study_world.visit)).status_code == 404


def test_a_plan_pins_its_ranking_and_shows_estimates_as_they_were(client: TestClient, study_world: Any) -> None:
    plan = _draft(client, study_world).json()
    assert plan["evaluation"]["id"] == study_world.evaluation
    assert (plan["stale"], [w["code"] for w in plan["warnings"]]) == (False, ["margins_not_locked"])
    best = next(s for s in plan["sessions"] if s["policy_id"] == study_world.policies[0])
    assert best["estimate"] == {
        "method": "dlsm", "value": 95.0, "low": 93.0, "high": 96.5, "level": 0.9, "supported": True, "flags": [],
    }  # fmt: skip
    assert best["predicted_energy"] == pytest.approx(0.4)
    assert {s["predicted_energy"] for s in plan["sessions"] if s["controller"] == "cdbs"} == {1.0}


def test_new_data_make_the_ranking_behind_a_plan_stale(client: TestClient, study_world: Any) -> None:
    _draft(client, study_world)
    session = client.get(f"/api/v1/visits/{study_world.held_visit}/sessions").json()["items"][0]["id"]
    client.put(f"/api/v1/sessions/{session}/qoc", json={"rating": 3, "reason": "misread"})
    plan = client.get(_path(study_world.visit)).json()
    assert plan["stale"] is True
    assert [w["text"] for w in plan["warnings"] if w["code"] != "margins_not_locked"] == [
        "The ranking is out of date: 1 session with corrected outcomes."
    ]
    assert next(s for s in plan["sessions"] if s["policy_id"] == study_world.policies[0])["estimate"]["value"] == 95.0


def test_warnings_name_unsupported_unranked_and_held(client: TestClient, study_world: Any, external: int) -> None:
    answer = client.post(_path(study_world.held_visit), json={"policy_ids": [study_world.unsupported, external]})
    assert answer.status_code == 201
    warnings = " ".join(w["text"] for w in answer.json()["warnings"])
    for words in (
        "The recordings say too little of what policy 'rl-02-small' does to rely on what is expected of it.",
        "Policy 'β-Regler „Łódź“' is not in the ranking.",
        "The visit already has 2 sessions.",
        "The visit's date, 2026-03-02, is past.",
    ):
        assert words in warnings
    made_elsewhere = next(s for s in answer.json()["sessions"] if s["policy_id"] == external)
    assert (made_elsewhere["controller"], made_elsewhere["estimate"], made_elsewhere["predicted_energy"]) == ("rl", None, None)


def test_policies_of_others_and_retired_ones_are_refused_by_name(client: TestClient, study_world: Any) -> None:
    retired = client.post(_path(study_world.visit), json={"policy_ids": [study_world.retired]})
    assert retired.status_code == 422
    assert "Policy 'rl-00' was retired: dyskinesia at visit 1" in retired.json()["detail"]
    client.post("/api/v1/participants", json={"code": "P2"})
    other = client.post("/api/v1/participants/P2/visits", json={"number": 1}).json()["id"]
    stranger = client.post(_path(other), json={"policy_ids": [study_world.policies[0]]})
    assert stranger.status_code == 404
    assert f"no policy {study_world.policies[0]}" in stranger.json()["detail"]
    twice = client.post(_path(study_world.visit), json={"policy_ids": [study_world.policies[0]] * 2})
    assert twice.status_code == 422
    assert "named twice" in twice.json()["detail"]


def test_a_ranking_of_somebody_else_cannot_be_pinned(client: TestClient, study_world: Any) -> None:
    answer = _draft(client, study_world, evaluation_id=study_world.evaluation + 1)
    assert answer.status_code == 404
    assert "has no evaluation" in answer.json()["detail"]


@pytest.mark.parametrize(
    "body",
    [{}, {"policy_ids": []}, {"policy_ids": ["1"]}, {"policy_ids": [1], "no_dbs": "yes"}, {"policy_ids": [1], "minutes_per_session": 4}],
)
def test_bad_drafts_are_refused(client: TestClient, study_world: Any, body: dict[str, Any]) -> None:
    answer = client.post(_path(study_world.visit), json=body)
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"


def test_a_new_draft_supersedes_the_old_one(client: TestClient, study_world: Any, db: Session) -> None:
    first, second = _draft(client, study_world).json(), _draft(client, study_world).json()
    assert first["id"] != second["id"]
    assert {p.id: p.status for p in db.scalars(select(Plan))} == {first["id"]: "superseded", second["id"]: "draft"}


def test_an_approved_plan_is_fixed_and_superseded_only_with_a_reason_in_the_audit_trail(
    client: TestClient, study_world: Any, db: Session, sign_plan: Any
) -> None:
    draft = _draft(client, study_world).json()
    approved = sign_plan(study_world.visit, plan_id=draft["id"]).json()
    assert (approved["status"], approved["approved_by"]) == ("approved", "signer@clinic.example")
    assert approved["sessions"] == draft["sessions"]
    again = sign_plan(study_world.visit)
    assert again.status_code == 409
    assert "was approved by signer@clinic.example already" in again.json()["detail"]
    unexplained = _draft(client, study_world, reason=" ")
    assert unexplained.status_code == 422
    assert "Say why the approved plan is replaced" in unexplained.json()["hint"]
    assert client.get(_path(study_world.visit)).json()["id"] == draft["id"]
    assert _draft(client, study_world, reason="participant came late").status_code == 201
    rows = db.scalars(
        select(AuditEvent).where(AuditEvent.entity == "plan", AuditEvent.entity_id == str(draft["id"])).order_by(AuditEvent.id)
    ).all()
    assert [r.action for r in rows] == ["insert", "update", "update"]
    assert rows[-1].reason == f"approved plan {draft['id']} superseded by a new draft: participant came late"
    kept = db.get_one(Plan, draft["id"])
    assert (kept.status, kept.approved_by) == ("superseded", "signer@clinic.example")
    assert len(kept.items) == len(draft["sessions"])


def test_a_draft_that_was_replaced_meanwhile_is_not_approved(client: TestClient, study_world: Any, sign_plan: Any) -> None:
    seen, _ = _draft(client, study_world).json(), _draft(client, study_world).json()
    answer = sign_plan(study_world.visit, plan_id=seen["id"])
    assert answer.status_code == 409
    assert "was replaced by plan" in answer.json()["detail"]


def test_a_policy_retired_after_the_draft_blocks_approval(client: TestClient, study_world: Any, db: Session, sign_plan: Any) -> None:
    _draft(client, study_world)
    db.get_one(Policy, study_world.policies[0]).retired_reason = "speech"
    db.commit()
    answer = sign_plan(study_world.visit)
    assert answer.status_code == 409
    assert "'rl-01' was retired after this plan was drafted: speech" in answer.json()["detail"]


def test_engineers_draft_clinicians_approve_viewers_read(client: TestClient, client_as, study_world: Any) -> None:  # type: ignore[no-untyped-def]
    viewer, engineer, clinician = client_as("viewer"), client_as("engineer"), client_as("clinician")
    assert _draft(viewer, study_world).status_code == 403
    assert _draft(engineer, study_world).status_code == 201
    assert viewer.get(_path(study_world.visit)).status_code == 200
    assert viewer.get(_path(study_world.visit, ".pdf")).status_code == 200
    signature = {"password": PASSWORD}
    assert viewer.post(_path(study_world.visit, "/approve"), json=signature).status_code == 403
    assert engineer.post(_path(study_world.visit, "/approve"), json=signature).status_code == 403
    assert clinician.post(_path(study_world.visit, "/approve"), json=signature).status_code == 200


def test_only_who_may_approve_replaces_an_approved_plan(client: TestClient, client_as, study_world: Any, sign_plan: Any) -> None:  # type: ignore[no-untyped-def]
    engineer, clinician = client_as("engineer"), client_as("clinician")
    approved = _draft(client, study_world).json()["id"]
    assert sign_plan(study_world.visit).status_code == 200
    assert _draft(engineer, study_world, reason="I prefer another").status_code == 403
    path = f"/visits/{study_world.visit}/plan?replace=yes"
    buttons = [reader.get(path, headers={"Accept": "text/html"}).text.count("Draft plan</button>") for reader in (engineer, clinician)]
    assert buttons == [0, 1]
    assert client.get(_path(study_world.visit)).json()["id"] == approved
    assert _draft(clinician, study_world, reason="speech").status_code == 201


def test_a_plan_repeats_what_its_ranking_says_of_unsupported_policies(client: TestClient, study_world: Any, db: Session) -> None:
    earlier = db.get_one(Evaluation, study_world.evaluation)
    estimates = {row.policy_id: estimate_of(row) for row in earlier.estimates}
    estimates[study_world.unsupported] = replace(estimates[study_world.unsupported], value=99.0, high=101.0)
    store_evaluation(
        db,
        job_id=None,
        created_by="test",
        snapshot=db.get_one(BufferSnapshot, earlier.snapshot_id),
        horizon_steps=60,
        candidates=list(estimates),
        results={"dlsm": {"estimates": {str(i): e.to_json() for i, e in estimates.items()}}},
        config={},
    )
    db.commit()
    drafted = _draft(client, study_world).json()["warnings"]
    assert [w["text"] for w in drafted if w["code"] != "margins_not_locked"] == [
        "Hardly any session came near what these do; value and place are guesses: rl-02-small (99.0)."
    ]


def test_a_note_with_the_zero_character_is_refused(client: TestClient, study_world: Any) -> None:
    assert _draft(client, study_world, note="a\x00b").status_code == 422
    assert _draft(client, study_world, reason="a\x00b").status_code == 422
    form = {"policy_ids": str(study_world.policies[0]), "note": "a\x00b"}
    page = client.post(f"/visits/{study_world.visit}/plan", data=form, headers={"Accept": "text/html"})
    assert page.status_code == 422
