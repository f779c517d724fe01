"""Entries of the clinic day: sent twice they are one, contradictions count for nothing, and nothing is changed afterwards."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.planning.visit_day.record import SlotOutcome, outcomes_of
from app.planning.visit_day.repository import entries, slot_times
from app.platform.web.templates import STATIC
from tests.app.words import flat
from tests.conftest import PASSWORD

TAPS = {
    "method": "taps",
    "hz": None,
    "taps_s": [0.0, 0.5, 1.0, 2.0],
    "began_at": "2026-11-22T10:10:00Z",
    "ended_at": "2026-11-22T10:10:10Z",
}


def slot_outcomes(db: Session, plan_id: int) -> dict[int, SlotOutcome]:
    """Return what was entered about the last attempt of each session of a plan, by its id in the plan."""
    return outcomes_of(entries(db, plan_id))


def at(second: float) -> str:
    return (datetime(2026, 11, 22, 10, tzinfo=UTC) + timedelta(seconds=second)).isoformat()


def test_a_batch_sent_twice_is_stored_once(clinic_day: Any, db: Session) -> None:
    batch = [clinic_day.entry("start"), clinic_day.entry("rating", {"value": 7})]
    assert clinic_day.outcomes(*batch) == ["stored", "stored"]
    assert clinic_day.outcomes(*batch, clinic_day.entry("stop")) == ["known", "known", "stored"]
    assert db.scalar(text("select count(*) from day_entry")) == 3
    listed = clinic_day.client.get(f"/api/v1/visits/{clinic_day.visit}/day/entries").json()
    assert [e["kind"] for e in listed["items"]] == ["start", "rating", "stop"]


def test_one_entry_named_twice_in_a_batch_is_one(clinic_day: Any, db: Session) -> None:
    entry = clinic_day.entry("rating", {"value": 7})
    assert clinic_day.outcomes(entry, entry) == ["stored", "known"]


def test_a_known_identifier_with_other_content_is_refused_and_the_rest_is_taken(clinic_day: Any) -> None:
    entry = clinic_day.entry("rating", {"value": 7})
    assert clinic_day.outcomes(entry) == ["stored"]
    results = clinic_day.send(entry | {"payload": {"value": 3}}, clinic_day.entry("stop")).json()["results"]
    assert [r["outcome"] for r in results] == ["refused", "stored"]
    assert "says something else" in results[0]["detail"]


def test_entries_are_never_changed_or_deleted(clinic_day: Any, db: Session) -> None:
    clinic_day.outcomes(clinic_day.entry("rating", {"value": 7}))
    for statement in ("update day_entry set kind = 'stop'", "delete from day_entry"):
        with pytest.raises(DBAPIError):
            db.execute(text(statement))
        db.rollback()
    assert db.scalar(text("select count(*) from audit_event where entity = 'day_entry' and actor = 'admin@clinic.example'")) == 1


def test_times_are_the_services_by_the_tablets_clock_and_its_offset(clinic_day: Any, db: Session) -> None:
    # the tablet woke in 1970 after its battery was empty; the offset was measured later that day
    offset = round((datetime(2026, 11, 22, 10, tzinfo=UTC) - datetime(1970, 1, 1, 0, 5, tzinfo=UTC)).total_seconds() * 1000)
    start = clinic_day.entry("start", device_time="1970-01-01T00:05:00Z", clock_offset_ms=offset)
    stop = clinic_day.entry("stop", device_time="1970-01-01T00:15:30Z", clock_offset_ms=offset)
    assert clinic_day.outcomes(start, stop) == ["stored", "stored"]
    times = slot_times(db, clinic_day.plan)[clinic_day.slots[0]]
    assert (times.started_at, times.stopped_at) == (datetime(2026, 11, 22, 10, tzinfo=UTC), datetime(2026, 11, 22, 10, 10, 30, tzinfo=UTC))


def test_an_hour_that_the_clock_has_twice_makes_no_session_longer(clinic_day: Any, db: Session) -> None:
    start = clinic_day.entry("start", device_time="2026-10-25T02:58:00+02:00")
    stop = clinic_day.entry("stop", device_time="2026-10-25T02:08:00+01:00")
    assert clinic_day.outcomes(start, stop) == ["stored", "stored"]
    times = slot_times(db, clinic_day.plan)[clinic_day.slots[0]]
    assert times.started_at == datetime(2026, 10, 25, 0, 58, tzinfo=UTC)
    assert times.stopped_at is not None
    assert (times.stopped_at - times.started_at).total_seconds() == 600


def test_outcomes_of_a_session_are_those_of_its_last_attempt(clinic_day: Any, db: Session) -> None:
    clinic_day.outcomes(
        clinic_day.entry("start", device_time=at(0)),
        clinic_day.entry("rating", {"value": 2}, device_time=at(60)),
        clinic_day.entry("stop", device_time=at(90)),
        clinic_day.entry("stop_cause", {"cause": "technical", "text": "cable"}, device_time=at(95)),
        clinic_day.entry("repeat", {"reason": "the cable was loose"}, device_time=at(100)),
        clinic_day.entry("start", attempt=2, device_time=at(200)),
        clinic_day.entry("rating", {"value": 8}, attempt=2, device_time=at(800)),
        clinic_day.entry("grasp", TAPS, attempt=2, device_time=at(810)),
        clinic_day.entry("gait", {"grade": "mild"}, attempt=2, device_time=at(820)),
        clinic_day.entry("stop", attempt=2, device_time=at(830)),
        clinic_day.entry("skip", {"reason": "no time left"}, slot=1),
    )
    first, second = clinic_day.slots[:2]
    found, times = slot_outcomes(db, clinic_day.plan), slot_times(db, clinic_day.plan)
    assert (found[first].qocs, found[first].gait) == ({"rating": 8, "grasp_hz": 1.5}, "mild")
    assert [(a.number, a.repeated_because) for a in times[first].attempts] == [(1, "the cable was loose"), (2, None)]
    assert times[first].stop_cause is None
    assert times[second].skipped_because == "no time left"
    assert times[second].started_at is None


def test_two_ratings_count_for_nothing_until_one_is_chosen(clinic_day: Any, db: Session) -> None:
    one, other = clinic_day.entry("rating", {"value": 7}), clinic_day.entry("rating", {"value": 4})
    clinic_day.outcomes(one, other)
    slot = clinic_day.slots[0]
    found = slot_outcomes(db, clinic_day.plan)[slot]
    assert (found.qocs.get("rating"), found.contradictions) == (None, ("rating",))
    page = clinic_day.client.get(f"/visit-day/{clinic_day.visit}", headers={"Accept": "text/html"}).text
    assert "2 different ratings: 7 by admin@clinic.example" in page
    clinic_day.outcomes(clinic_day.entry("rating", {"value": 4}, replaces=[one["uuid"], other["uuid"]]))
    db.expire_all()
    found = slot_outcomes(db, clinic_day.plan)[slot]
    assert (found.qocs["rating"], found.contradictions) == (4, ())


def test_a_correction_takes_the_place_of_what_it_names(clinic_day: Any, db: Session) -> None:
    first = clinic_day.entry("rating", {"value": 7})
    clinic_day.outcomes(first, clinic_day.entry("rating", {"value": 6}, replaces=[first["uuid"]]))
    assert slot_outcomes(db, clinic_day.plan)[clinic_day.slots[0]].qocs["rating"] == 6


@pytest.mark.parametrize(
    ("note", "word"),
    [
        ("felt better than on 3/4/2026", "a date ('3/4/2026')"),
        ("since the 3rd of May", "a date ('3rd of May')"),
        ("call 555 01 99", "a number of four or more digits ('555 01 99')"),
        ("write to a.b@example.org", "an address"),
        ("Smith was dizzy", "looks like a name ('Smith')"),
    ],
)
def test_a_note_that_may_say_who_somebody_is_is_refused(clinic_day: Any, note: str, word: str) -> None:
    (result,) = clinic_day.send(clinic_day.entry("note", {"text": note})).json()["results"]
    assert result["outcome"] == "refused"
    assert word in result["detail"]


def test_a_word_that_is_said_to_be_no_name_is_kept(clinic_day: Any, db: Session) -> None:
    payload = {"text": "Sinemet 100 mg at 10:15, rating 7/10, 2.5 mA. Participant fine.", "no_names": ["sinemet"]}
    assert clinic_day.outcomes(clinic_day.entry("note", payload)) == ["stored"]
    assert slot_outcomes(db, clinic_day.plan)[clinic_day.slots[0]].notes == (payload["text"],)


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "rating", "payload": {"value": 11}},
        {"kind": "rating", "payload": {"value": 7}, "plan_item_id": None},
        {"kind": "grasp", "payload": TAPS | {"taps_s": [1.0, 0.5]}},
        {"kind": "grasp", "payload": TAPS | {"hz": 3.0}},
        {"kind": "gait", "payload": {"grade": "awful"}},
        {"kind": "reboot", "payload": {}},
    ],
)
def test_an_entry_that_makes_no_sense_is_refused_and_the_others_are_stored(clinic_day: Any, wrong: dict[str, Any]) -> None:
    bad = clinic_day.entry("start") | wrong
    answer = clinic_day.send(clinic_day.entry("start"), bad, clinic_day.entry("stop"))
    assert answer.status_code == 200, answer.text
    results = answer.json()["results"]
    assert [r["outcome"] for r in results] == ["stored", "refused", "stored"]
    assert results[1]["uuid"] == bad["uuid"]
    assert results[1]["detail"].startswith("The entry makes no sense: ")


def test_an_entry_without_an_identifier_is_refused_in_its_place(clinic_day: Any) -> None:
    results = clinic_day.send(clinic_day.entry("start") | {"uuid": "none"}, clinic_day.entry("stop")).json()["results"]
    assert [(r["outcome"], r["uuid"] is None) for r in results] == [("refused", True), ("stored", False)]


def test_entries_about_a_replaced_plan_stay_true(clinic_day: Any, db: Session) -> None:
    old, old_slots = clinic_day.plan, list(clinic_day.slots)
    client = clinic_day.client
    draft = {"policy_ids": [], "random_sessions": 1, "seed": 1, "reason": "shorter"}
    assert client.post(f"/api/v1/visits/{clinic_day.visit}/plan", json=draft).status_code == 201
    assert client.get(f"/api/v1/visits/{clinic_day.visit}/day").status_code == 409
    assert clinic_day.outcomes(clinic_day.entry("rating", {"value": 7})) == ["stored"]
    assert slot_outcomes(db, old)[old_slots[0]].qocs["rating"] == 7


def test_a_locked_visit_refuses_entries_and_the_tablet_may_send_them_again_later(clinic_day: Any, db: Session) -> None:
    base, entry = f"/api/v1/visits/{clinic_day.visit}", clinic_day.entry("rating", {"value": 7})
    assert clinic_day.client.post(f"{base}/lock", json={"reason": "complete", "password": PASSWORD}).status_code in (200, 201)
    (result,) = clinic_day.send(entry).json()["results"]
    assert (result["outcome"], "was locked by" in result["detail"]) == ("refused", True)
    assert clinic_day.client.post(f"{base}/unlock", json={"reason": "a rating came late"}).status_code in (200, 201)
    assert clinic_day.outcomes(entry) == ["stored"]


def test_entries_of_another_visit_or_plan_are_refused(clinic_day: Any) -> None:
    (result,) = clinic_day.send(clinic_day.entry("start") | {"plan_item_id": 10**6}).json()["results"]
    assert "no session 1000000" in result["detail"]
    body = {"plan_id": clinic_day.plan, "entries": [clinic_day.entry("start")]}
    assert clinic_day.client.post("/api/v1/visits/1/day/entries", json=body).status_code == 404


def test_a_blinded_assessor_enters_and_sees_labels_alone(clinic_day: Any, client_as: Any) -> None:
    assessor: TestClient = client_as("blinded_assessor")
    day = assessor.get(f"/api/v1/visits/{clinic_day.visit}/day").json()
    assert day["blinded"] is True
    assert {s["label"] for s in day["slots"]} == {"Session 1", "Session 2", "Session 3"}
    assert {(s["controller"], s["detail"], s["note"]) for s in day["slots"]} == {(None, "", "")}
    page = assessor.get(f"/visit-day/{clinic_day.visit}", headers={"Accept": "text/html"})
    assert page.status_code == 200
    assert "cDBS" not in page.text.split('<div id="plain"')[1].split("Stop rules")[0]
    answer = clinic_day.send(clinic_day.entry("rating", {"value": 7}), client=assessor)
    assert answer.json()["results"][0]["outcome"] == "stored"
    viewer: TestClient = client_as("viewer")
    assert clinic_day.send(clinic_day.entry("rating", {"value": 7}), client=viewer).status_code == 403
    assert viewer.get(f"/api/v1/visits/{clinic_day.visit}/day").json()["slots"][0]["label"] == "cDBS"


def test_a_plan_that_may_not_run_any_more_says_so_and_still_takes_what_was_done(clinic_day: Any) -> None:
    day = clinic_day.client.get(f"/api/v1/visits/{clinic_day.visit}/day").json()
    assert day["not_runnable"] == ""
    assert day["slots"][0]["limits"] == {"min_ma": 3.0, "max_ma": 3.0, "ramp_ma_per_s": 1.5}
    changed = {"settings": {"cdbs_amplitude_ma": 2.5}, "reason": "reprogrammed"}
    assert clinic_day.client.put("/api/v1/participants/P1/settings", json=changed).status_code == 200
    day = clinic_day.client.get(f"/api/v1/visits/{clinic_day.visit}/day").json()
    assert "cDBS amplitude of 3 mA; it is 2.5 mA now" in day["not_runnable"]
    assert clinic_day.outcomes(clinic_day.entry("stop")) == ["stored"]


def test_adverse_events_stand_among_the_adverse_events_at_once(clinic_day: Any) -> None:
    fall = {"kind": "fall", "severity": "mild", "serious": True, "note": "", "no_names": []}
    batch = [
        clinic_day.entry("adverse_event", fall),
        clinic_day.entry("gait", {"grade": "severe"}, slot=1),
        clinic_day.entry("speech", {"grade": "mild"}),
    ]
    assert clinic_day.outcomes(*batch) == ["stored"] * 3
    assert clinic_day.outcomes(*batch) == ["known"] * 3
    events = clinic_day.client.get("/api/v1/participants/P1/adverse-events").json()
    found = {(e["kind"], e["severity"], e["serious"], e["visit_id"]) for e in events}
    assert found == {("fall", "mild", True, clinic_day.visit), ("gait", "severe", False, clinic_day.visit)}


@pytest.mark.hazard("H24")
def test_the_form_of_an_adverse_event_says_to_stop_the_controller_first(clinic_day: Any) -> None:
    clinic_day.outcomes(clinic_day.entry("start"))
    page = clinic_day.client.get(f"/visit-day/{clinic_day.visit}", headers={"Accept": "text/html"}).text
    (form,) = [part for part in flat(page).split("<form ") if 'name="kind_of_event"' in part]
    first = "First stop the controller on its tablet (Ctrl-C): it returns to clinical settings at once."
    then = "Nothing that is entered on this page, Stop included, reaches the controller."
    assert form.index(first) < form.index(then) < form.index("Adverse event</label>")
    twin = (STATIC / "visit-day" / "dialogs.js").read_text("utf-8").split("export function adverseEvent")[1].split("export function")[0]
    assert first in twin, "the dialog of the page's own program says the same"
    assert then in twin


def test_a_locked_visit_still_takes_adverse_events(clinic_day: Any) -> None:
    clinic_day.client.post(f"/api/v1/visits/{clinic_day.visit}/lock", json={"reason": "complete", "password": PASSWORD})
    fall = {"kind": "fall", "severity": "severe", "serious": False, "note": "", "no_names": []}
    assert clinic_day.outcomes(clinic_day.entry("adverse_event", fall)) == ["stored"]


def test_a_sealed_plan_shows_its_letters_and_common_limits_to_everybody(client: TestClient, participant_code: str, sign_plan: Any) -> None:
    visit = client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 2, "date": "2099-11-22"}).json()["id"]
    draft = {"policy_ids": [], "random_sessions": 2, "seed": 1, "blinded": True}
    assert client.post(f"/api/v1/visits/{visit}/plan", json=draft).status_code == 201
    assert sign_plan(visit).status_code == 200
    day = client.get(f"/api/v1/visits/{visit}/day").json()
    assert day["blinded"] is True
    assert sorted(s["label"] for s in day["slots"]) == ["Session A", "Session B", "Session C"]
    assert {(s["controller"], s["detail"], str(s["limits"])) for s in day["slots"]} == {(None, "", str(day["slots"][0]["limits"]))}
    assert day["slots"][0]["limits"]["min_ma"] < day["slots"][0]["limits"]["max_ma"]
    page = client.get(f"/visit-day/{visit}", headers={"Accept": "text/html"}).text
    assert "Random" not in page.split('<div id="plain"')[1]
    assert "cDBS" not in page.split('<div id="plain"')[1].split("Stop rules")[0]
