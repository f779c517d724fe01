"""What was entered on the clinic day becomes the outcome of the confirmed session, once, and overwrites nothing."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.planning.visit_day.session_outcomes import take_outcomes
from app.tables.sessions import StudySession

TABLE = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,1\n" for k in range(-9, 31))


@pytest.fixture
def filled(clinic_day: Any, db: Session) -> StudySession:
    """A confirmed session in the first place of the plan; the place is set here as confirming into it does."""
    client: TestClient = clinic_day.client
    fields = {"participant": "P1", "visit": "2", "controller": "cdbs"}
    sent = client.post("/api/v1/uploads", data=fields, files={"file": ("a.csv", TABLE)})
    session = db.get_one(StudySession, sent.json()["sessions"][0]["id"])
    session.plan_item_id = clinic_day.slots[0]
    db.commit()
    return session


def test_the_outcomes_of_its_place_become_those_of_the_session_once(clinic_day: Any, filled: StudySession, db: Session) -> None:
    clinic_day.outcomes(
        clinic_day.entry("start"),
        clinic_day.entry("rating", {"value": 7}),
        clinic_day.entry("grasp", {"method": "typed", "hz": 2.5}),
        clinic_day.entry("gait", {"grade": "mild"}),
        clinic_day.entry("stop"),
        clinic_day.entry("stop_cause", {"cause": "participant", "text": "asked for it"}),
        clinic_day.entry("rating", {"value": 1}, slot=1),
    )
    for _ in range(2):
        assert take_outcomes(db, filled, SYSTEM) == []
        db.commit()
        db.refresh(filled)
    assert filled.qoc is not None
    assert (filled.qoc.rating, filled.qoc.grasp_hz, filled.qoc.tremor_percent, filled.qoc.revision) == (7, 2.5, None, 1)
    assert filled.qoc.reason == "entered on the clinic day by admin@clinic.example"
    assert filled.stopped_reason == "asked for it"
    (event,) = clinic_day.client.get("/api/v1/participants/P1/adverse-events").json()
    assert (event["kind"], event["severity"], event["session_id"]) == ("gait", "mild", filled.id)


def test_what_the_session_has_already_stays_and_the_difference_is_told(clinic_day: Any, filled: StudySession, db: Session) -> None:
    clinic_day.client.put(f"/api/v1/sessions/{filled.id}/qoc", json={"rating": 5})
    clinic_day.outcomes(clinic_day.entry("rating", {"value": 7}), clinic_day.entry("grasp", {"method": "typed", "hz": 2.5}))
    db.expire_all()
    told = take_outcomes(db, filled, SYSTEM)
    db.commit()
    db.refresh(filled)
    assert told == ["The clinic day has a rating of 7, the session 5; the session keeps its own."]
    assert filled.qoc is not None
    assert (filled.qoc.rating, filled.qoc.grasp_hz) == (5, 2.5)


def test_contradicting_entries_are_not_taken(clinic_day: Any, filled: StudySession, db: Session) -> None:
    clinic_day.outcomes(clinic_day.entry("rating", {"value": 7}), clinic_day.entry("rating", {"value": 2}))
    assert take_outcomes(db, filled, SYSTEM) == ["The clinic day has different ratings; none was taken. Choose one on the page of the day."]
    assert filled.qoc is None
