"""Entries of the clinic day become the outcome of the confirmed session, once, and overwrite nothing."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.planning.visit_day.repository import entries_beside
from app.planning.visit_day.session_outcomes import differences, take_outcomes
from app.planning.visit_day.wording import STOPPED_FOR_PARTICIPANT
from app.tables.sessions import StudySession

TABLE = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,1\n" for k in range(-9, 31))


@pytest.fixture
def in_place(clinic_day: Any, db: Session) -> StudySession:
    """A confirmed session in the first place of the plan; the place is set here as confirming into it does."""
    client: TestClient = clinic_day.client
    fields = {"participant": "P1", "visit": "2", "controller": "cdbs"}
    sent = client.post("/api/v1/uploads", data=fields, files={"file": ("a.csv", TABLE)})
    session = db.get_one(StudySession, sent.json()["sessions"][0]["id"])
    session.plan_item_id = clinic_day.slots[0]
    db.commit()
    return session


def test_the_outcomes_of_its_place_become_those_of_the_session_once(clinic_day: Any, in_place: StudySession, db: Session) -> None:
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
        assert take_outcomes(db, in_place, SYSTEM) == []
        db.commit()
        db.refresh(in_place)
    assert in_place.qoc is not None
    assert (in_place.qoc.rating, in_place.qoc.grasp_hz, in_place.qoc.tremor_percent, in_place.qoc.revision) == (7, 2.5, None, 1)
    assert in_place.qoc.reason == "entered on the clinic day by admin@clinic.example"
    assert in_place.stopped_reason == "asked for it"
    stopped, gait = clinic_day.client.get("/api/v1/participants/P1/adverse-events").json()
    assert (gait["kind"], gait["severity"], gait["session_id"]) == ("gait", "mild", in_place.id)
    assert (stopped["kind"], stopped["note"]) == ("stopped", "asked for it")


def test_what_the_session_has_already_stays_and_the_difference_is_told(clinic_day: Any, in_place: StudySession, db: Session) -> None:
    clinic_day.client.put(f"/api/v1/sessions/{in_place.id}/qoc", json={"rating": 5})
    clinic_day.outcomes(clinic_day.entry("rating", {"value": 7}), clinic_day.entry("grasp", {"method": "typed", "hz": 2.5}))
    db.expire_all()
    told = take_outcomes(db, in_place, SYSTEM)
    db.commit()
    db.refresh(in_place)
    assert told == ["The clinic day has a rating of 7, the session 5; the session keeps its own."]
    assert in_place.qoc is not None
    assert (in_place.qoc.rating, in_place.qoc.grasp_hz) == (5, 2.5)


def test_contradicting_entries_are_not_taken(clinic_day: Any, in_place: StudySession, db: Session) -> None:
    clinic_day.outcomes(clinic_day.entry("rating", {"value": 7}), clinic_day.entry("rating", {"value": 2}))
    assert take_outcomes(db, in_place, SYSTEM) == [
        "The clinic day has different ratings; none was taken. Choose one on the page of the day."
    ]
    assert in_place.qoc is None


def in_all_orders() -> list[tuple[str, ...]]:
    """Return every order of three entries' messages and the log's way to a confirmed session, which is of two steps."""
    steps = ("log", "confirmation", "outcomes", "stop", "correction")
    return [order for order in itertools.permutations(steps) if order.index("log") < order.index("confirmation")]


def record_of(db: Session, client: TestClient, session_id: int) -> dict[str, Any]:
    """Return the record of a session, without when and by which way it came."""
    db.expire_all()
    session = db.get_one(StudySession, session_id)
    assert session.qoc is not None
    events = client.get("/api/v1/participants/P1/adverse-events").json()
    return {
        "rating": session.qoc.rating,
        "grasp_hz": session.qoc.grasp_hz,
        "stopped": session.stopped_reason,
        "events": sorted((e["kind"], e["severity"]) for e in events if e["session_id"] == session_id and e["severity"] != "none"),
    }


@pytest.mark.parametrize("order", in_all_orders(), ids="-".join)
def test_any_order_of_log_confirmation_and_entries_gives_the_same_record(clinic_day: Any, db: Session, order: tuple[str, ...]) -> None:
    client: TestClient = clinic_day.client
    rating, speech = clinic_day.entry("rating", {"value": 7}), clinic_day.entry("speech", {"grade": "mild"})
    messages = {
        "outcomes": [
            rating,
            speech,
            clinic_day.entry("grasp", {"method": "typed", "hz": 2.5}),
            clinic_day.entry("gait", {"grade": "mild"}),
        ],
        "stop": [clinic_day.entry("stop_cause", {"cause": "participant", "text": "asked for it"})],
        "correction": [
            clinic_day.entry("rating", {"value": 5}, replaces=[rating["uuid"]]),
            clinic_day.entry("speech", {"grade": "none"}, replaces=[speech["uuid"]]),
        ],
    }
    session_id = 0
    for step in order:
        if step == "log":
            fields = {"participant": "P1", "visit": "2", "controller": "cdbs", "started_at": "2099-11-22T10:00:00Z"}
            sent = client.post("/api/v1/uploads", data=fields, files={"file": ("a.csv", TABLE)})
            session_id = sent.json()["sessions"][0]["id"]
        elif step == "confirmation":
            done = client.post(f"/api/v1/visits/{clinic_day.visit}/slots/confirm", json={})
            assert done.status_code == 200, done.text
        else:
            assert set(clinic_day.outcomes(*messages[step])) == {"stored"}
    assert record_of(db, client, session_id) == {
        "rating": 5,
        "grasp_hz": 2.5,
        "stopped": "asked for it",
        "events": [("gait", "mild")],
    }


def test_entries_that_contradict_each_other_after_confirmation_take_the_value_back(
    clinic_day: Any, in_place: StudySession, db: Session
) -> None:
    clinic_day.outcomes(clinic_day.entry("rating", {"value": 7}))
    assert in_place.qoc is not None
    assert in_place.qoc.rating == 7
    clinic_day.outcomes(clinic_day.entry("rating", {"value": 2}))
    db.expire_all()
    assert (in_place.qoc.rating, in_place.qoc.reason) == (None, "entered on the clinic day")


def test_what_a_person_took_back_is_not_taken_again_with_the_next_entry(clinic_day: Any, in_place: StudySession, db: Session) -> None:
    clinic_day.outcomes(clinic_day.entry("rating", {"value": 7}))
    assert clinic_day.client.put(f"/api/v1/sessions/{in_place.id}/qoc", json={"rating": None, "reason": "wrong scale"}).status_code == 200
    clinic_day.outcomes(clinic_day.entry("gait", {"grade": "none"}))
    db.expire_all()
    assert in_place.qoc is not None
    assert in_place.qoc.rating is None


def test_a_stop_for_the_participant_counts_although_another_tablet_says_otherwise(
    clinic_day: Any, in_place: StudySession, db: Session
) -> None:
    clinic_day.outcomes(clinic_day.entry("stop_cause", {"cause": "technical", "text": "cable"}))
    clinic_day.outcomes(clinic_day.entry("stop_cause", {"cause": "participant", "text": ""}))
    db.refresh(in_place)
    assert in_place.stopped_reason == STOPPED_FOR_PARTICIPANT
    assert "different causes of the early stop" in " ".join(differences(in_place, entries_beside(db, clinic_day.slots[0])))


def test_a_stop_that_a_person_wrote_beside_the_session_stays(clinic_day: Any, in_place: StudySession, db: Session) -> None:
    said = {"stopped_reason": "dizzy", "reason": "the nurse's note"}
    assert clinic_day.client.patch(f"/api/v1/sessions/{in_place.id}", json=said).status_code == 200
    clinic_day.outcomes(clinic_day.entry("stop_cause", {"cause": "participant", "text": "asked for it"}))
    db.refresh(in_place)
    assert in_place.stopped_reason == "dizzy"


def test_a_stop_long_before_the_end_of_its_recording_is_told(clinic_day: Any, in_place: StudySession, db: Session) -> None:
    in_place.duration_s = 600.0
    db.commit()
    clinic_day.outcomes(clinic_day.entry("start"), clinic_day.entry("stop", device_time="2026-11-22T10:03:05Z"))
    rows = clinic_day.client.get(f"/api/v1/visits/{clinic_day.visit}/slots").json()["rows"]
    said = "The clinic day has it stopped after 3:05, and its recording is 10:00 long: one of the two is wrong."
    assert next(r["differences"] for r in rows if r["session_id"] == in_place.id) == [said]
    page = clinic_day.client.get(f"/visits/{clinic_day.visit}/slots", headers={"Accept": "text/html"}).text
    assert said in page


def test_a_recording_has_the_outcomes_of_the_attempt_that_it_began_with(clinic_day: Any, in_place: StudySession, db: Session) -> None:
    in_place.started_at = datetime(2026, 11, 22, 10, 0, 20, tzinfo=UTC)
    db.commit()
    clinic_day.outcomes(
        clinic_day.entry("start"),
        clinic_day.entry("rating", {"value": 2}),
        clinic_day.entry("stop_cause", {"cause": "participant", "text": "dizzy"}),
        clinic_day.entry("repeat", {"reason": "wanted to try again"}),
        clinic_day.entry("start", attempt=2, device_time="2026-11-22T10:20:00Z"),
        clinic_day.entry("rating", {"value": 8}, attempt=2),
    )
    db.expire_all()
    assert in_place.qoc is not None
    assert (in_place.qoc.rating, in_place.stopped_reason) == (2, "dizzy")


def test_a_blinded_assessors_late_entries_join_the_session(clinic_day: Any, in_place: StudySession, db: Session, client_as: Any) -> None:
    sent = clinic_day.send(
        clinic_day.entry("rating", {"value": 6}),
        clinic_day.entry("stop_cause", {"cause": "participant", "text": "asked for it"}),
        clinic_day.entry("gait", {"grade": "mild"}),
        client=client_as("blinded_assessor"),
    )
    assert [r["outcome"] for r in sent.json()["results"]] == ["stored"] * 3
    db.expire_all()
    assert in_place.qoc is not None
    assert (in_place.qoc.rating, in_place.stopped_reason) == (6, "asked for it")
