"""Recordings whose clock was wrong: read again, or stated by a person, they move with their sessions, and what rests on them says so."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, update
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app.cli import app
from app.ingest.uploads.redecode import redecode
from app.tables.audit import AuditEvent
from app.tables.recordings import Recording, Trace
from app.tables.sessions import StudySession
from ml.formats.recording import DECODE_VERSION
from tests.app.ingest.conftest import DAY
from tests.app.ingest.uploads.test_outcomes_intake import qoc, tremor
from tests.conftest import PASSWORD as PASSWORD_OF_TESTS
from tests.ml.formats.conftest import Percept

AHEAD_S = 2254
SIDES = {"right": "ONE_THREE_RIGHT", "left": "ONE_THREE_LEFT"}


def report(ahead_s: float | None = AHEAD_S, side: str = "right", serial: str = "NPX799999H", seconds: int = 240) -> bytes:
    """Make a report of one run from ten o'clock on, by an implant whose clock is ahead; None: nothing compares it with UTC."""
    percept = Percept()
    shown = (DAY + timedelta(seconds=ahead_s or 0.0)).isoformat()
    domain = percept.time_domain(SIDES[side], percept.sine(seconds)) | {"FirstPacketDateTime": shown}
    power = percept.power(SIDES[side], 2 * seconds - 1, when=shown, left_ma=2.0 * (side == "left"), right_ma=2.0 * (side == "right"))
    made = percept.report(BrainSenseTimeDomain=[domain], BrainSenseLfp=[power])
    made["DeviceInformation"]["Final"]["NeurostimulatorSerialNumber"] = serial
    made["LeadConfiguration"]["Final"][0]["Hemisphere"] = f"HemisphereLocationDef.{side.capitalize()}"
    end = DAY + timedelta(minutes=20)
    made |= {"SessionDate": DAY.isoformat(), "SessionEndDate": end.isoformat()}
    for part, when in (("Initial", DAY), ("Final", end)):
        made["DeviceInformation"][part].pop("DeviceDateTime", None)
        if ahead_s is not None:
            made["DeviceInformation"][part]["DeviceDateTime"] = (when + timedelta(seconds=ahead_s)).isoformat()
    return json.dumps(made).encode()


def start(client: TestClient, session_id: int) -> datetime:
    """Read when a session began."""
    return datetime.fromisoformat(client.get(f"/api/v1/sessions/{session_id}").json()["started_at"])


def decode_as_before(db: Session, session_id: int) -> None:
    """Leave the rows as a decoder left them that took the implant's clock for UTC."""
    late = timedelta(seconds=AHEAD_S)
    db.execute(update(Trace).values(decode_version=DECODE_VERSION - 1))
    session = db.get_one(StudySession, session_id)
    assert session.started_at is not None
    session.started_at += late
    for recording in db.scalars(select(Recording)):
        if recording.started_at is not None:
            recording.started_at += late
        recording.details = recording.details | {"settings": {k: v for k, v in recording.details["settings"].items() if k != "clock"}}
    db.commit()


@pytest.fixture
def old_session(send: Any, client: TestClient, db: Session) -> Callable[[], int]:
    """Stores a session of an earlier decoder, whose tremor the clock's fault kept from it."""

    def store() -> int:
        number = int(send(("r.json", report()), visit=1, controller="cdbs").json()["sessions"][0]["id"])
        decode_as_before(db, number)
        send(("m.csv", tremor()))
        assert qoc(client, number).get("tremor_percent") is None
        return number

    return store


def test_a_recording_on_the_implants_clock_is_read_again_with_its_session(old_session: Any, client: TestClient, db: Session) -> None:
    number = old_session()
    (dry,) = (c for c in redecode(None, None, True, "test") if c.kind == "percept")
    assert start(client, number) == DAY + timedelta(seconds=AHEAD_S)
    done = CliRunner().invoke(app, ["ingest", "redecode"])
    assert done.exit_code == 0, done.output
    assert dry.sessions
    assert "Sessions whose time or dose changed: 1" in done.output
    assert "37 min 34 s earlier than before" in done.output, done.output
    assert abs((start(client, number) - DAY).total_seconds()) <= 1
    assert qoc(client, number)["tremor_percent"] == pytest.approx(25)
    assert {c.state for c in redecode(None, None, False, "test")} == {"up to date"}


def test_a_ranking_says_that_the_start_of_its_sessions_was_corrected(old_session: Any, client: TestClient, db: Session) -> None:
    from app.evaluation.ranking.staleness import _edited

    number = old_session()
    session = db.get_one(StudySession, number)
    before = db.scalars(select(AuditEvent.at).order_by(AuditEvent.id.desc())).first()
    assert before is not None
    list(redecode(None, None, False, "test"))
    db.expire_all()
    assert _edited(db, [session], before)[3] == {number}


def test_the_session_of_a_locked_visit_is_not_moved(old_session: Any, client: TestClient, db: Session) -> None:
    number = old_session()
    visit = client.get(f"/api/v1/sessions/{number}").json()["visit_id"]
    assert client.post(f"/api/v1/visits/{visit}/lock", json={"reason": "done", "password": PASSWORD_OF_TESTS}).status_code == 200
    (change,) = (c for c in redecode(None, None, False, "test") if c.kind == "percept")
    assert (change.state, change.sessions) == ("failed", [])
    assert "was locked by" in change.said[0]
    assert start(client, number) == DAY + timedelta(seconds=AHEAD_S)


def test_a_person_corrects_a_clock_and_the_trail_says_who_and_why(send: Any, client: TestClient, db: Session) -> None:
    number = send(("r.json", report(None)), ("m.csv", tremor(6)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    assert qoc(client, number).get("tremor_percent") is None  # nothing of the watch is joined to an unknown clock
    stated = {"ahead_s": -60, "uncertainty_s": 5, "reason": "the tablet's clock on the film"}
    answer = client.put(f"/api/v1/sessions/{number}/clock", json=stated)
    assert answer.status_code == 200, answer.text
    assert abs((start(client, number) - DAY).total_seconds() - 60) <= 1
    found = qoc(client, number)
    assert found["tremor_percent"] == pytest.approx(25)
    event = db.scalars(select(AuditEvent).where(AuditEvent.entity == "recording", AuditEvent.action == "update")).all()[-1]
    assert event.reason is not None
    assert "the tablet's clock on the film" in event.reason
    assert "1 min behind UTC within 5 s" in event.reason
    assert event.before["started_at"] != event.after["started_at"]
    page = client.get(f"/sessions/{number}").text
    assert "1 min behind UTC within 5 s" in page
    # a newer decoder keeps what the person stated
    db.execute(update(Trace).values(decode_version=DECODE_VERSION - 1))
    db.commit()
    assert [c.sessions for c in redecode(None, None, False, "test") if c.kind == "percept"] == [[]]
    assert abs((start(client, number) - DAY).total_seconds() - 60) <= 1
    again = client.put(f"/api/v1/sessions/{number}/clock", json=stated | {"ahead_s": 0})
    assert again.status_code == 200
    assert abs((start(client, number) - DAY).total_seconds()) <= 1


def test_recordings_of_two_devices_are_not_joined_under_an_unknown_clock(send: Any, proposals: Any) -> None:
    send(("l.json", report(None, "left", "NPX711111H")), ("r.json", report(None, "right", "NPX722222H")))
    assert len(proposals()) == 2


def test_recordings_of_two_devices_whose_clocks_are_known_are_joined(send: Any, proposals: Any) -> None:
    send(("l.json", report(300, "left", "NPX711111H")), ("r.json", report(900, "right", "NPX722222H")))
    assert len(proposals()) == 1


def test_a_table_has_no_clock_to_correct(send: Any, client: TestClient) -> None:
    from tests.app.ingest.conftest import steady

    number = send(("t.csv", steady(1)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    refused = client.put(f"/api/v1/sessions/{number}/clock", json={"ahead_s": 5, "uncertainty_s": 1, "reason": "said"})
    assert refused.status_code == 422
    assert "no clock to correct" in refused.text


def test_the_pages_mark_an_unknown_clock_and_correct_it(send: Any, client: TestClient) -> None:
    number = send(("r.json", report(None)), visit=1, controller="cdbs").json()["sessions"][0]["id"]
    page = client.get(f"/sessions/{number}").text
    assert "clock unknown: the start may be hours off" in page
    assert "Correct the clock" in page
    typed = {"ahead_s": "2254", "uncertainty_s": "30"}
    refused = client.post(f"/sessions/{number}/clock", data=typed)
    assert refused.status_code == 422
    assert 'value="2254"' in refused.text  # what was typed stays
    done = client.post(f"/sessions/{number}/clock", data=typed | {"clock_reason": "notes of the visit"}, follow_redirects=False)
    assert done.status_code == 303
    page = client.get(f"/sessions/{number}").text
    assert "clock unknown" not in page
    assert "37 min 34 s ahead of UTC within 30 s" in page
    assert start(client, number) == DAY - timedelta(seconds=AHEAD_S)


def test_a_proposals_clock_is_corrected_by_its_form(send: Any, client: TestClient) -> None:
    answer = send(("r.json", report(None))).json()
    number, version = answer["sessions"][0]["id"], answer["proposals"][0]["version"]
    assert answer["proposals"][0]["clock_unknown"] is True
    assert "clock unknown: the start may be hours off" in client.get(f"/proposals/{number}").text
    form = {f"version-{number}": str(version), f"ahead_s-{number}": "-60", f"uncertainty_s-{number}": "5", "do": f"clock:{number}"}
    assert client.post("/participants/P1/proposals", data=form).status_code == 422
    done = client.post("/participants/P1/proposals", data=form | {f"clock_reason-{number}": "notes"}, follow_redirects=False)
    assert done.status_code == 303
    assert client.get(f"/api/v1/proposals/{number}").json()["clock_unknown"] is False
    assert start(client, number) == DAY + timedelta(seconds=60)
