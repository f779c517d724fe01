"""Plan pages as a browser without JavaScript uses them."""

from __future__ import annotations

from datetime import date, timedelta
from typing import Any

from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.plans import Plan
from app.tables.visits import Visit
from tests.app.words import above_fold

PAGE = {"Accept": "text/html"}


def _post(client: TestClient, path: str, **fields: Any) -> Any:
    return client.post(path, data=fields, headers=PAGE, follow_redirects=False)


def test_the_page_of_a_visit_without_a_plan_offers_the_ranked_policies(client: TestClient, study_world: Any) -> None:
    page = client.get(f"/visits/{study_world.visit}/plan", headers=PAGE)
    assert page.status_code == 200
    assert "has no plan yet.</b> Draft one below." in page.text
    assert page.text.index("rl-01<") < page.text.index("rl-02<") < page.text.index("rl-01-small<")
    assert "rl-00<" not in page.text  # retired
    assert page.text.count('name="policy_ids"') == 4


def test_draft_then_sign_with_forms_alone(client: TestClient, client_as: Any, study_world: Any, db: Session) -> None:
    path = f"/visits/{study_world.visit}/plan"
    drafted = _post(
        client, path, policy_ids=[str(i) for i in study_world.policies[:2]], minutes_per_session="12,5", no_dbs="yes", seed="", note=""
    )
    assert (drafted.status_code, drafted.headers["location"]) == (303, f"{path}?done=drafted")
    plan = db.scalars(select(Plan)).one()
    assert [i.minutes for i in plan.items] == [12.5, 12.5, 12.5, 5]
    clinician = client_as("clinician")
    page = clinician.get(f"{path}?done=drafted", headers=PAGE).text
    for words in (
        "Plan drafted.",
        f"Sign plan {plan.id}",
        "plan.pdf",
        "not signed yet",
        "0 to 3",
        "<svg",
        "95.00",
        "93.00 to 96.50",
        "DLSM",
    ):
        assert words in page, words
    first = above_fold(page)
    assert [words for words in ("95.00", "93.00", "DLSM") if words in first] == [], "estimates stand in the fold for engineers"
    approved = _post(clinician, f"{path}/approve", plan_id=str(plan.id), password="correct horse battery")
    assert (approved.status_code, approved.headers["location"]) == (303, f"{path}?done=approved")
    page = client.get(path, headers=PAGE).text
    assert "by clinician@clinic.example" in page
    assert "Your password, again" not in page
    assert 'id="draft"' not in page, "a signed plan is there to be run"
    assert "Why the approved plan is replaced" in client.get(f"{path}?replace=yes", headers=PAGE).text


def test_a_refused_form_comes_back_as_it_was_filled_in(client: TestClient, study_world: Any, db: Session) -> None:
    path = f"/visits/{study_world.visit}/plan"
    chosen = [str(i) for i in study_world.policies]
    page = _post(client, path, policy_ids=chosen, total_minutes="61", washout_minutes="3", note="keep me")
    assert page.status_code == 422
    assert "4 policies with the sessions around them take 88 minutes; the visit has 61." in page.text
    assert "Choose at most 2 policies" in page.text
    assert 'value="61"' in page.text
    assert "keep me" in page.text
    assert page.text.count(" checked>") == 4
    assert db.scalars(select(Plan)).all() == []
    nothing = _post(client, path, note="x")
    assert nothing.status_code == 422
    assert "at least one policy, or one random or held session" in nothing.text
    wrong = _post(client, path, policy_ids=["x"])
    assert wrong.status_code == 422
    spelled = _post(client, path, policy_ids=chosen[:1], washout_minutes="five")
    assert "Washout" in spelled.text
    assert "no number" in spelled.text


def test_ticked_policies_of_the_ranking_go_to_the_visit_that_is_chosen(client: TestClient, study_world: Any, db: Session) -> None:
    ticked = {"policy_ids": [str(study_world.policies[0])], "evaluation_id": str(study_world.evaluation)}
    asked = _post(client, "/participants/P1/plan/draft", **ticked)
    assert (asked.status_code, "Which visit is planned?" in asked.text) == (200, True)
    assert f'name="policy_ids" value="{study_world.policies[0]}"' in asked.text
    assert db.scalars(select(Plan)).all() == []
    answer = _post(client, "/participants/P1/plan/draft", **ticked, visit_id=str(study_world.visit))
    assert (answer.status_code, answer.headers["location"]) == (303, f"/visits/{study_world.visit}/plan?done=drafted")
    assert client.get(f"/api/v1/visits/{study_world.visit}/plan").json()["evaluation"]["id"] == study_world.evaluation


def test_ticked_policies_never_replace_an_approved_plan_unasked(client: TestClient, study_world: Any, db: Session, sign_plan: Any) -> None:
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[0]]})
    assert sign_plan(study_world.visit).status_code == 200
    asked = _post(client, "/participants/P1/plan/draft", policy_ids=[str(study_world.policies[1])])
    assert "its plan is signed" in asked.text
    answer = _post(client, "/participants/P1/plan/draft", policy_ids=[str(study_world.policies[1])], visit_id=str(study_world.visit))
    assert (answer.status_code, "no reason is given why it is replaced" in answer.text) == (422, True)
    assert db.scalars(select(Visit.number).order_by(Visit.number)).all() == [1, 2], "no visit is made unasked"
    assert client.get(f"/api/v1/visits/{study_world.visit}/plan").json()["status"] == "approved"


def test_a_draft_can_make_its_visit(client: TestClient, study_world: Any, db: Session) -> None:
    day = (date.today() + timedelta(days=30)).isoformat()
    policy = str(study_world.policies[0])
    answer = _post(client, "/participants/P1/plan/draft", policy_ids=[policy], visit_id="new", visit_number="7", visit_date=day)
    visit = db.scalars(select(Visit).where(Visit.number == 7)).one()
    assert answer.headers["location"] == f"/visits/{visit.id}/plan?done=drafted"
    assert visit.date is not None
    assert visit.date.isoformat() == day
    undated = _post(client, "/participants/P1/plan/draft", policy_ids=[policy], visit_id="new", visit_number="8", visit_date="")
    assert (undated.status_code, "The new visit 8 has no date." in undated.text) == (422, True)
    assert db.scalars(select(Visit.number).order_by(Visit.number)).all() == [1, 2, 7]


def test_a_draft_that_fails_makes_no_visit(client: TestClient, study_world: Any, db: Session) -> None:
    answer = _post(client, "/participants/P1/plan/draft", policy_ids=[str(study_world.retired)], visit_number="9", visit_date="2199-01-01")
    assert answer.status_code == 422
    assert "was retired" in answer.text
    assert db.scalars(select(Visit).where(Visit.number == 9)).all() == []


def test_a_visit_with_sessions_is_not_open_for_planning(client: TestClient, study_world: Any) -> None:
    answer = _post(client, "/participants/P1/plan/draft", policy_ids=[str(study_world.policies[0])], visit_id=str(study_world.held_visit))
    assert answer.status_code == 422
    assert "it has sessions, is in the past" in answer.text


def test_the_list_shows_every_plan_and_the_open_visits(client: TestClient, study_world: Any) -> None:
    empty = client.get("/participants/P1/plans", headers=PAGE).text
    assert "No visit is planned for this participant.</b> The next visit would be number 3." in empty
    for _ in range(2):
        client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[0]]})
    page = client.get("/participants/P1/plans", headers=PAGE).text
    assert page.count("superseded") == 1
    assert f'href="/visits/{study_world.visit}/plan"' in page
    assert f'href="/visits/{study_world.held_visit}/plan"' not in page


def test_a_viewer_sees_the_plan_and_no_buttons(client: TestClient, client_as, study_world: Any) -> None:  # type: ignore[no-untyped-def]
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[0]]})
    viewer = client_as("viewer")
    page = viewer.get(f"/visits/{study_world.visit}/plan", headers=PAGE).text
    assert "Download PDF" in page
    assert "Approve plan" not in page
    assert "Draft plan" not in page
    assert _post(viewer, f"/visits/{study_world.visit}/plan", policy_ids=[str(study_world.policies[0])]).status_code == 403
    assert _post(viewer, f"/visits/{study_world.visit}/plan/approve").status_code == 403


def test_a_participant_without_policies_gets_a_visit_of_random_sessions(client: TestClient, participant_code: str) -> None:
    visit = client.get(f"/api/v1/participants/{participant_code}/visits").json()["items"][0]["id"]
    page = client.get(f"/visits/{visit}/plan").text
    assert "Policies learn from a visit of random sessions first" in page
    drafted = _post(client, f"/visits/{visit}/plan", random_sessions="3")
    assert drafted.status_code == 303
    plan = client.get(f"/api/v1/visits/{visit}/plan").json()
    assert [s["controller"] for s in plan["sessions"]] == ["cdbs", "random", "random", "random"]
    assert not any("ranking" in warning for warning in plan["warnings"])


def test_a_plan_with_a_time_of_day_shows_its_sessions_by_the_clinics_clock(client: TestClient, study_world: Any) -> None:
    path, page = f"/api/v1/visits/{study_world.visit}/plan", f"/visits/{study_world.visit}/plan"
    body = {"policy_ids": list(study_world.policies[:2]), "order": "stated", "minutes_per_session": 5}
    client.post(path, json=body)
    assert ">0:10</td>" in client.get(page, headers=PAGE).text
    client.post(path, json=body | {"starts_at": "23:55"})
    shown = client.get(page, headers=PAGE).text
    assert [f">{at}</td>" in shown for at in ("23:55", "0:05", "0:15", "0:10")] == [True, True, True, False]
