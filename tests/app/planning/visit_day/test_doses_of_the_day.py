"""Doses that are entered on the clinic day are among the visit's doses as soon as they arrive, each once."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from tests.clinic_day import ClinicDay

NOW = datetime.now(UTC).replace(microsecond=0)


@pytest.fixture
def today(clinic_day: ClinicDay) -> ClinicDay:
    """The clinic day of today."""
    moved = clinic_day.client.patch(f"/api/v1/visits/{clinic_day.visit}", json={"date": NOW.date().isoformat(), "reason": "moved"})
    assert moved.status_code == 200, moved.text
    return clinic_day


def dose(day: ClinicDay, minutes_ago: float = 60, mg: float = 100, drug: str = "levodopa", **more: Any) -> dict[str, Any]:
    taken_at = (NOW - timedelta(minutes=minutes_ago)).isoformat()
    return day.entry("dose", {"drug": drug, "mg": mg}, None, **{"device_time": taken_at} | more)


def doses_of(day: ClinicDay) -> list[tuple[str, float]]:
    return [(d["drug"], d["mg"]) for d in day.client.get(f"/api/v1/visits/{day.visit}/doses").json()]


def test_a_dose_arrives_once_to_the_minute_and_stands_on_the_day_and_at_the_visit(today: ClinicDay) -> None:
    entry = dose(today, mg=150)
    assert today.outcomes(entry, today.entry("start")) == ["stored", "stored"]
    assert today.outcomes(entry) == ["known"]
    assert doses_of(today) == [("levodopa", 150)]
    (shown,) = today.client.get(f"/api/v1/visits/{today.visit}/day").json()["doses"]
    assert datetime.fromisoformat(shown["taken_at"]) == (NOW - timedelta(minutes=60)).replace(second=0)


def test_two_doses_of_one_minute_are_one_that_was_entered_twice_and_nothing_else_is_lost(today: ClinicDay) -> None:
    results = today.send(dose(today), dose(today, mg=50), today.entry("rating", {"value": 7}), dose(today, 10, 50)).json()["results"]
    assert [r["outcome"] for r in results] == ["stored", "refused", "stored", "stored"]
    assert "is written down at this visit already" in results[1]["detail"]
    assert doses_of(today) == [("levodopa", 100), ("levodopa", 50)]
    kinds = [e["kind"] for e in today.client.get(f"/api/v1/visits/{today.visit}/day/entries").json()["items"]]
    assert kinds == ["dose", "rating", "dose"]


def test_a_dose_by_a_tablet_that_lost_its_clock_or_of_another_week_is_refused_with_the_reason(today: ClinicDay) -> None:
    lost = dose(today, device_time="1970-01-01T00:05:00Z", clock_offset_ms=None)
    results = today.send(lost, dose(today, 60 * 24 * 8), today.entry("start")).json()["results"]
    assert [r["outcome"] for r in results] == ["refused", "refused", "stored"]
    assert "The tablet's clock showed 1970-01-01 00:05 UTC." in results[0]["detail"]
    assert "is not near visit 2" in results[1]["detail"]
    offset = round((NOW - timedelta(hours=1) - datetime(1970, 1, 1, 0, 5, tzinfo=UTC)).total_seconds() * 1000)
    assert today.outcomes(lost | {"clock_offset_ms": offset}) == ["stored"], "measured since: the time is known"


def test_blinded_assessors_rate_and_write_down_no_dose(today: ClinicDay, client_as: Callable[[str], TestClient]) -> None:
    assessor = client_as("blinded_assessor")
    assert assessor.get(f"/api/v1/visits/{today.visit}/day").json()["may_dose"] is False
    results = today.send(dose(today), today.entry("rating", {"value": 7}), client=assessor).json()["results"]
    assert [r["outcome"] for r in results] == ["refused", "stored"]
    assert doses_of(today) == []
    coordinator = client_as("coordinator")
    assert coordinator.get(f"/api/v1/visits/{today.visit}/day").json()["may_dose"] is True
    assert today.send(dose(today), client=coordinator).json()["results"][0]["outcome"] == "stored"


def test_the_participants_schedule_is_what_the_tablet_offers(today: ClinicDay) -> None:
    fields = {"medication": [{"drug": "levodopa_cr", "mg": 200, "at": "08:00"}]}
    body = {"version": 0, "characteristics": fields, "reason": "asked"}
    assert today.client.put("/api/v1/participants/P1/characteristics", json=body).status_code == 200
    offered = today.client.get(f"/api/v1/visits/{today.visit}/day").json()["planned_doses"]
    assert offered == [{"drug": "levodopa_cr", "mg": 200.0, "at": "08:00"}]


def test_the_plain_form_takes_doses_too_and_keeps_every_note(today: ClinicDay, db: Session) -> None:
    page = {"Accept": "text/html"}
    path = f"/visit-day/{today.visit}"
    shown = today.client.get(path, headers=page).text
    assert 'name="drug"' in shown
    taken_at = (NOW - timedelta(minutes=30)).strftime("%Y-%m-%dT%H:%M")
    for number, more in enumerate(({"mg": "100", "taken_at": taken_at}, {"mg": "50", "taken_at": ""})):
        uuid = f"00000000-0000-4000-8000-00000000000{number}"
        form = {"kind": "dose", "plan_id": str(today.plan), "uuid": uuid, "drug": "levodopa"} | more
        assert today.client.post(path, data=form, headers=page, follow_redirects=False).status_code == 303
    assert doses_of(today) == [("levodopa", 100), ("levodopa", 50)]
    wrong = {"kind": "dose", "plan_id": str(today.plan), "uuid": "00000000-0000-4000-8000-000000000009", "drug": "levodopa", "mg": "much"}
    assert today.client.post(path, data=wrong, headers=page).status_code == 422
    for number, note in enumerate(("calm", "tired")):
        seen = today.client.get(f"{path}?session={today.slots[0]}", headers=page).text
        form_of_note = seen.split('value="note"')[1].split("</form>")[0]
        assert 'name="replaces"' not in form_of_note, "one more note replaces none"
        uuid = f"00000000-0000-4000-8000-0000000000a{number}"
        of = {"kind": "note", "plan_id": str(today.plan), "plan_item_id": str(today.slots[0]), "attempt": "1", "uuid": uuid, "text": note}
        assert today.client.post(path, data=of, headers=page, follow_redirects=False).status_code == 303
