"""Conditions of a session: recorded when it is confirmed, corrected by a person, and pinned by what rests on it."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.study.sessions.designs import Program, differences
from app.tables.participants import Hemisphere
from tests.app.ingest.conftest import device_zip, table

ROWS = [(2 * k, 1.0, 0.4 if k == 0 else 0.7) for k in range(-9, 21)]


@pytest.fixture
def confirmed(client: TestClient, participant_code: str) -> Callable[..., dict[str, Any]]:
    """Function that uploads a file of P1 as a session that counts; it returns its conditions with the session's number."""

    def send(content: bytes, **fields: Any) -> dict[str, Any]:
        data = {"participant": participant_code, "visit": "1", "controller": "random"} | fields
        answer = client.post("/api/v1/uploads", data=data, files={"file": ("a.csv", content)})
        assert answer.status_code == 201, answer.text
        session = answer.json()["sessions"][0]["id"]
        return {"session": session} | client.get(f"/api/v1/sessions/{session}/conditions").json()

    return send


def settle(client: TestClient, **settings: Any) -> None:
    assert client.put("/api/v1/participants/P1/settings", json={"settings": settings}).status_code == 200


def test_a_session_keeps_what_was_in_force_whatever_is_set_afterwards(client: TestClient, confirmed: Callable[..., dict[str, Any]]) -> None:
    settle(client, lower_bound=0.4, cdbs_amplitude_ma=3.0)
    first = confirmed(table(ROWS))
    settle(client, lower_bound=0.1, xi_beta=2.5, window=5)
    again = client.get(f"/api/v1/sessions/{first['session']}/conditions").json()
    assert (again["lower_bound"], again["window"], again["period_s"], again["xi_beta"]) == (0.4, 10, 2.0, first["xi_beta"])
    assert again["xi_beta"] != 2.5
    assert (again["revision"], again["origin"], again["entered_by"]) == (1, "assumed", "admin@clinic.example")
    assert again["lead_amplitude_ma"] == pytest.approx(0.4 * 3.0)
    assert again["cdbs_amplitude_ma"] == 3.0
    assert (again["seed"], again["design"], again["design_parameters"]) == (None, None, {"level": None, "holds": []})


def test_settings_count_from_when_they_were_made(client: TestClient, confirmed: Callable[..., dict[str, Any]], owner_db: Session) -> None:
    began = datetime.now(UTC) - timedelta(hours=2)
    owner_db.execute(text("alter table settings_version disable trigger never_changed"))
    owner_db.execute(text("update settings_version set created_at = :early"), {"early": began - timedelta(days=1)})
    owner_db.commit()
    settle(client, lower_bound=0.1)
    found = confirmed(table(ROWS), started_at=began.isoformat())
    assert (found["lower_bound"], found["origin"]) == (0.3, "settings")
    late = confirmed(table([(t, 2.0, a) for t, _, a in ROWS]), started_at=datetime.now(UTC).isoformat())
    assert (late["lower_bound"], late["origin"]) == (0.1, "settings")


def test_a_person_corrects_conditions_with_a_reason_and_every_revision_stays(
    client: TestClient, confirmed: Callable[..., dict[str, Any]], db: Session
) -> None:
    session = confirmed(table(ROWS))["session"]
    holds = [{"start": 0, "steps": 20, "amplitude": 0.7, "log_density": -0.1}]
    stated = {"lower_bound": 0.5, "seed": 7, "design": "stratified", "design_parameters": {"level": 0.7, "holds": holds}}
    row = client.put(f"/api/v1/sessions/{session}/conditions", json=stated | {"reason": "as the protocol sheet says"}).json()
    assert {name: row[name] for name in stated} == stated
    assert (row["revision"], row["origin"], row["reason"]) == (2, "stated", "as the protocol sheet says")
    same = client.put(f"/api/v1/sessions/{session}/conditions", json={"lower_bound": 0.5, "reason": "again"}).json()
    assert same["revision"] == 2
    for wrong, word in (
        ({"lower_bound": None}, "always ran under some lower_bound"),
        ({"min_ma": 3.0, "max_ma": 1.0}, "is above the upper one"),
        ({"lower_bound": 1.0}, "less than 1"),
        ({"design": "ours"}, "paper"),
    ):
        refused = client.put(f"/api/v1/sessions/{session}/conditions", json=wrong | {"reason": "x"})
        assert refused.status_code == 422, wrong
        assert word in refused.text, refused.text
    assert client.put(f"/api/v1/sessions/{session}/conditions", json={"lower_bound": 0.2}).status_code == 422
    with pytest.raises(DBAPIError, match="never changed"):
        db.execute(text("update session_conditions set lower_bound = 0.9"))


def test_a_proposal_has_no_conditions_until_it_is_confirmed(client: TestClient, participant_code: str) -> None:
    answer = client.post("/api/v1/uploads", data={"participant": participant_code, "visit": "1"}, files={"file": ("a.csv", table(ROWS))})
    (session,) = answer.json()["sessions"]
    assert client.get(f"/api/v1/sessions/{session['id']}/conditions").json() is None
    early = client.put(f"/api/v1/sessions/{session['id']}/conditions", json={"lower_bound": 0.2, "reason": "x"})
    assert (early.status_code, "is not confirmed" in early.text) == (409, True)
    body = {"version": 1, "controller": "random"}
    assert client.post(f"/api/v1/proposals/{session['id']}/confirm", json=body).status_code == 200
    assert client.get(f"/api/v1/sessions/{session['id']}/conditions").json()["lower_bound"] == 0.3


def test_a_recording_of_a_device_tells_contacts_pulse_width_rate_and_limits(confirmed: Callable[..., dict[str, Any]]) -> None:
    found = confirmed(device_zip())
    (program,) = found["programming"]
    assert (program["hemisphere"], program["group"], program["program"]) == ("right", "A", 0)
    assert program["pulse_width_us"] > 0
    assert program["rate_hz"] > 100
    assert program["contacts"].startswith("-")
    assert program["contacts"].endswith("+C")
    assert 0 <= found["min_ma"] < found["max_ma"]
    assert found["lead_amplitude_ma"] is None or found["lead_amplitude_ma"] >= 0


def test_the_page_shows_the_conditions_and_corrects_them(client: TestClient, confirmed: Callable[..., dict[str, Any]]) -> None:
    session = confirmed(device_zip())["session"]
    page = client.get(f"/sessions/{session}", headers={"Accept": "text/html"}).text
    card = page[page.index('id="conditions"') :]
    assert "60 \u00b5s, 130 Hz" in card
    assert "assumed" in card
    form = {"revision": "1", "lower_bound": "0.45", "conditions_reason": "protocol sheet"}
    assert client.post(f"/sessions/{session}/conditions", data=form, follow_redirects=False).status_code == 303
    assert client.get(f"/api/v1/sessions/{session}/conditions").json()["lower_bound"] == 0.45
    stale = client.post(f"/sessions/{session}/conditions", data=form | {"lower_bound": "0.2"}, headers={"Accept": "text/html"})
    assert (stale.status_code, "by admin@clinic.example; you typed: 0.2" in stale.text) == (409, True)
    empty = client.post(
        f"/sessions/{session}/conditions", data=form | {"revision": "2", "lower_bound": ""}, headers={"Accept": "text/html"}
    )
    assert (empty.status_code, "always ran under some lower_bound" in empty.text) == (422, True)


def test_what_is_not_known_differs_in_nothing_and_the_other_side_neither() -> None:
    own = [Program("left", "A", 0, "-1 +C", 60.0, 130.2)]
    assert differences(own, [Program("left", "B", 0, "+C -1", 60.0, 130.0)], Hemisphere.LEFT) == []
    assert differences(own, [Program("right", "A", 0, "-9 +C", 90.0, 180.0)], Hemisphere.LEFT) == []
    assert differences(own, [Program("left", "A", 0)], Hemisphere.LEFT) == []
    assert differences(own, [Program("left", "A", 1, "-3 +C", 90.0, 130.0)], Hemisphere.LEFT) == []
    (one,) = differences(own, [Program("left", "A", 0, "-1 +C", 90.0, 130.0)], Hemisphere.LEFT)
    assert (one.of, one.other, one.program) == ("60 us", "90 us", 0)
    (contacts,) = differences(own, [Program(None, None, 0, "-2 +C")], None)
    assert (contacts.of, contacts.other) == ("-1 +C", "-2 +C")
