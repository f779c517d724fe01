"""A session stopped for the participant's sake counts against its policy as a serious event does, whenever it becomes known."""

from __future__ import annotations

import html
import io
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pypdf import PdfReader
from sqlalchemy.orm import Session

from app.tables.sessions import StudySession
from tests.app.evaluations import judge as judge
from tests.app.evaluations import judged
from tests.app.evaluations import policies as policies
from tests.app.planning.visit_day.conftest import clinic_day as clinic_day
from tests.app.words import flat
from tests.conftest import PASSWORD

Upload = Callable[..., int]
RANKING, PAGE = "/api/v1/participants/P1/ranking", "/participants/P1/ranking"
WORDS = "1 session stopped for the participant's sake, not cleared by a clinician"
TABLE = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,1\n" for k in range(-9, 31))


def stop(client: TestClient, session: int, why: str | None = "she felt dizzy") -> None:
    """Write a stop down on the page of its session, or take it back."""
    assert client.patch(f"/api/v1/sessions/{session}", json={"stopped_reason": why, "reason": "the nurse's notes"}).status_code == 200


def add_visit(client: TestClient, number: int, day: str | None = None) -> int:
    answer = client.post("/api/v1/participants/P1/visits", json={"number": number, "date": day})
    assert answer.status_code == 201, answer.text
    return int(answer.json()["id"])


def verdict_of(client: TestClient, policy: int) -> dict[str, Any]:
    return next(p for p in client.get(RANKING).json()["policies"] if p["policy_id"] == policy)


def text_of(client: TestClient, path: str) -> str:
    return html.unescape(flat(client.get(path, headers={"Accept": "text/html"}).text))


@pytest.mark.hazard("H24")
def test_a_policy_whose_session_was_stopped_is_not_worth_a_test_until_a_clinician_clears_it(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload, sign_plan: Callable[..., Any]
) -> None:
    a, b, _ = policies
    session = upload("rl", level=0.6, policy=a)
    judge({a: judged(50.0), b: judged(40.0)})
    assert verdict_of(client, a)["decision"] == "test"
    visit = add_visit(client, 2, f"{datetime.now(UTC).date()}")
    assert client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [a], "min_ma": 0.5}).status_code == 201
    stop(client, session)
    assert (verdict_of(client, a)["decision"], verdict_of(client, a)["tested"]["stopped"]) == ("unsafe", 1)
    assert verdict_of(client, b)["decision"] == "test"
    for path in (PAGE, "/participants/P1", f"/participants/P1/policies/{a}", f"/visits/{visit}/plan"):
        assert WORDS in text_of(client, path), path
    assert "1 session so far; 1 stopped for the participant's sake; against cDBS of the same day: energy" in text_of(client, PAGE)
    unsigned = sign_plan(visit)
    assert (unsigned.status_code, WORDS in unsigned.json()["detail"]) == (409, True)
    refused = client.post(f"/api/v1/visits/{visit}/plan", json={"policy_ids": [a], "min_ma": 0.5, "reason": "again"})
    assert (refused.status_code, WORDS in refused.json()["detail"]) == (422, True)
    answer = [{"policy_id": a, "reason": "dizzy from standing up"}]
    again = {"policy_ids": [a], "min_ma": 0.5, "reason": "again", "overrides": answer}
    assert client.post(f"/api/v1/visits/{visit}/plan", json=again).status_code == 201
    sheet = "".join(page.extract_text() for page in PdfReader(io.BytesIO(client.get(f"/api/v1/visits/{visit}/plan.pdf").content)).pages)
    assert "stopped for the participant's" in sheet.replace("\n", " ")
    (event,) = client.get("/api/v1/participants/P1/adverse-events").json()
    assert (event["kind"], event["severity"], event["session_id"], event["policy_id"]) == ("stopped", "not_stated", session, a)
    given = {"revision": event["revision"], "reason": "she stood up too fast"}
    assert client.post(f"/api/v1/adverse-events/{event['id']}/clearance", json=given).status_code == 200
    assert verdict_of(client, a)["decision"] == "test"


def test_a_stop_that_is_corrected_stands_against_nothing(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload
) -> None:
    session = upload("rl", level=0.6, policy=policies[0])
    judge({policies[0]: judged(50.0)})
    stop(client, session)
    stop(client, session, "she felt sick")
    (event,) = client.get("/api/v1/participants/P1/adverse-events").json()
    assert (event["note"], event["revision"], event["blocks"]) == ("she felt sick", 2, True)
    stop(client, session, None)
    assert verdict_of(client, policies[0])["decision"] == "test"


def test_tested_before_is_shown_as_differences_to_the_same_days_cdbs(
    client: TestClient, policies: list[int], judge: Callable[..., int], upload: Upload
) -> None:
    for visit, grasp in ((2, 2.0), (3, 3.0)):  # the second day is a better one, with more of the policy
        add_visit(client, visit)
        upload("cdbs", visit=visit, qoc={"grasp_hz": grasp})
        for _ in range(visit - 1):
            upload("rl", visit=visit, level=0.5, policy=policies[0], qoc={"grasp_hz": grasp + 0.2})
    judge({policies[0]: judged(50.0)})
    found = verdict_of(client, policies[0])["tested"]
    # without the days the mean of 2.2, 3.2 and 3.2 less that of all cDBS sessions, 2.0, 2.0 and 3.0, would be 0.53
    assert found["grasp_hz_difference"] == pytest.approx(0.2)
    assert found["energy_difference"] == pytest.approx(0.25 - 1)
    assert "against cDBS of the same day: energy \N{MINUS SIGN}75 %, grasp +0.2 Hz" in text_of(client, PAGE)


@pytest.fixture
def locked_session(clinic_day: Any, db: Session) -> StudySession:
    """A confirmed session in the first place of the plan, of a visit that was locked since."""
    client: TestClient = clinic_day.client
    fields = {"participant": "P1", "visit": "2", "controller": "cdbs"}
    sent = client.post("/api/v1/uploads", data=fields, files={"file": ("a.csv", TABLE)})
    session = db.get_one(StudySession, sent.json()["sessions"][0]["id"])
    session.plan_item_id = clinic_day.slots[0]
    db.commit()
    lock = client.post(f"/api/v1/visits/{clinic_day.visit}/lock", json={"reason": "complete", "password": PASSWORD})
    assert lock.status_code == 200, lock.text
    return session


@pytest.mark.hazard("H24")
def test_a_stop_that_arrives_after_the_lock_is_stored_and_shown_and_changes_no_signed_value(
    clinic_day: Any, locked_session: StudySession, db: Session
) -> None:
    client: TestClient = clinic_day.client
    assert clinic_day.outcomes(
        clinic_day.entry("rating", {"value": 7}),
        clinic_day.entry("stop_cause", {"cause": "technical"}),
        clinic_day.entry("stop_cause", {"cause": "participant", "text": "asked for it"}),
    ) == ["refused", "refused", "stored"]
    db.expire_all()
    assert locked_session.stopped_reason is None, "what was signed with the lock stays"
    (event,) = client.get("/api/v1/participants/P1/adverse-events").json()
    assert (event["kind"], event["session_id"], event["note"]) == ("stopped", locked_session.id, "asked for it")
    page = text_of(client, f"/sessions/{locked_session.id}")
    assert "asked for it. It became known after the visit was locked: the session still counts as measured." in page


def test_a_verdict_names_the_stops_that_became_known_after_the_lock(client: TestClient, upload: Upload, policies: list[int]) -> None:
    for visit in (2, 3, 4):
        add_visit(client, visit)
        upload("cdbs", visit=visit)
        session = upload("rl", visit=visit, level=0.6, policy=policies[0])
    visit_id = client.get(f"/api/v1/sessions/{session}").json()["visit_id"]
    before = client.get("/api/v1/participants/P1/analyses/primary").json()["verdicts"][0]
    assert before["late_stop_session_ids"] == []
    assert client.post(f"/api/v1/visits/{visit_id}/lock", json={"reason": "complete", "password": PASSWORD}).status_code == 200
    found = {"kind": "stopped", "severity": "not_stated", "note": "told at home", "session_id": session}
    assert client.post("/api/v1/participants/P1/adverse-events", json=found).status_code == 201
    after = client.get("/api/v1/participants/P1/analyses/primary").json()["verdicts"][0]
    words = f"Session {session} was stopped for the participant's sake, which became known after the visit was locked"
    assert (after["late_stop_session_ids"], after["stopped_session_ids"]) == ([session], [])
    assert words in after["sentence"]
    assert words in text_of(client, "/participants/P1/analyses")


def test_an_entry_that_was_no_stop_after_all_takes_the_stop_back(clinic_day: Any) -> None:
    stopped = clinic_day.entry("stop_cause", {"cause": "participant", "text": "asked for it"})
    clinic_day.outcomes(stopped)
    (event,) = clinic_day.client.get("/api/v1/participants/P1/adverse-events").json()
    assert event["blocks"], "with or without a recording of the session"
    clinic_day.outcomes(clinic_day.entry("stop_cause", {"cause": "technical"}, replaces=[stopped["uuid"]]))
    (event,) = clinic_day.client.get("/api/v1/participants/P1/adverse-events").json()
    assert (event["severity"], event["blocks"]) == ("none", False)
