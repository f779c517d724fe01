"""The signature under a lock of a visit: over the data as they were, broken by any change, asked for with the password."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.orm import Session

from app.tables.audit import AuditEvent, Signature
from tests.conftest import PASSWORD

Upload = Callable[..., int]
PAGE = {"Accept": "text/html"}
BROKEN = "Signature broken: the data of this visit were changed"


@pytest.fixture
def visit(client: TestClient, upload: Upload) -> int:
    """A visit with a session, its QoCs and a dose."""
    session = upload("cdbs")
    assert client.put(f"/api/v1/sessions/{session}/qoc", json={"grasp_hz": 2.4, "rating": 8, "tremor_percent": 10}).status_code == 200
    number = int(client.get(f"/api/v1/sessions/{session}").json()["visit_id"])
    dose = {"drug": "levodopa", "mg": 100, "taken_at": "2026-03-02T07:00:00Z"}
    assert client.post(f"/api/v1/visits/{number}/doses", json=dose).status_code == 201
    return number


def lock(client: TestClient, visit: int, password: str = PASSWORD) -> Any:
    return client.post(f"/api/v1/visits/{visit}/lock", json={"reason": "all sources seen", "password": password})


def state(client: TestClient, visit: int) -> str:
    return str(client.get(f"/api/v1/visits/{visit}/locks").json()[-1]["signature_state"])


def test_a_lock_is_signed_with_its_meaning_and_stands_in_the_trail(client: TestClient, db: Session, visit: int) -> None:
    locked = lock(client, visit).json()
    assert (locked["signature_state"], locked["signature"]["signer"]) == ("stands", "admin@clinic.example")
    assert locked["signature"]["meaning"] == "data of this visit are complete and reviewed"
    row = db.scalars(select(Signature)).one()
    (session,) = row.content["sessions"]
    assert (session["controller"], session["qoc"]["rating"], session["excluded_reason"]) == ("cdbs", 8, None)
    assert all(len(r["samples"]) == 64 for r in session["recordings"])
    assert session["recordings"], "a session without samples would sign nothing of what was measured"
    event = db.scalars(select(AuditEvent).where(AuditEvent.entity == "signature")).one()
    assert event.after is not None
    assert event.after["sha256"] == locked["signature"]["sha256"] == row.sha256
    page = client.get(f"/visits/{visit}", headers=PAGE).text
    assert (locked["signature"]["sha256"] in page, BROKEN in page) == (True, False)


def test_a_wrong_password_locks_nothing(client: TestClient, db: Session, visit: int) -> None:
    assert client.post(f"/api/v1/visits/{visit}/lock", json={"reason": "complete"}).status_code == 422
    assert lock(client, visit, "a wrong guess").status_code == 403
    form = {"lock_reason": "all sources seen", "password": "a wrong guess"}
    page = client.post(f"/visits/{visit}/lock", data=form, headers=PAGE)
    assert (page.status_code, "The password is wrong." in page.text) == (403, True)
    assert 'value="all sources seen"' in page.text, "what was typed stays"
    assert client.get(f"/api/v1/visits/{visit}/locks").json() == []
    assert db.scalars(select(Signature)).all() == []


@pytest.mark.parametrize(
    "change",
    [
        "update qoc set rating = 3",
        "insert into qoc (session_id, revision, rating, entered_by) select session_id, max(revision) + 1, 8, 'x' from qoc group by 1",
        "update session set excluded_reason = 'cable'",
        "update session set controller = 'random'",
        "update session set hemisphere = 'left'",
        "update visit set note = 'something else'",
        "update dose set mg = 250",
        "update session_conditions set lower_bound = 0.9",
        "update trace set values_f32 = overlay(values_f32 placing '\\x00000000'::bytea from 1)",
        "update trace set valid_bits = overlay(valid_bits placing '\\x00'::bytea from 1)",
        "update session_segment set stop_s = stop_s - 2",
        "update visit_lock set reason = 'another'",
        "insert into cdbs_amplitude (visit_id, hemisphere, program, amplitude_ma) select id, 'left', 0, 2.75 from visit",
    ],
)
def test_any_change_breaks_it_visibly(client: TestClient, owner_db: Session, visit: int, change: str) -> None:
    assert lock(client, visit).status_code == 200
    table = change.split()[2 if change.startswith("insert") else 1]
    owner_db.execute(text(f"alter table {table} disable trigger user"))  # what the owner can do, and no service
    assert owner_db.execute(text(change)).rowcount > 0  # type: ignore[attr-defined]
    owner_db.commit()
    assert state(client, visit) == "broken"
    assert BROKEN in client.get(f"/visits/{visit}", headers=PAGE).text


def cdbs_ma(client: TestClient, visit: int) -> float | None:
    (session,) = client.get(f"/api/v1/visits/{visit}/sessions").json()["items"]
    return client.get(f"/api/v1/sessions/{session['id']}/trace").json()["cdbs_amplitude_ma"]


def test_a_locked_visit_goes_by_the_settings_at_its_lock(client: TestClient, visit: int) -> None:
    """A locked visit without a cDBS amplitude uses the settings at its lock: a new one says nothing of a day that is closed."""
    before = cdbs_ma(client, visit)
    assert before is not None
    assert lock(client, visit).status_code == 200
    other = {"settings": {"cdbs_amplitude_ma": before + 0.5}, "reason": "programmed anew"}
    assert client.put("/api/v1/participants/P1/settings", json=other).status_code == 200
    assert (state(client, visit), cdbs_ma(client, visit)) == ("stands", before)
    assert "(from the settings at the lock)" in client.get(f"/visits/{visit}", headers=PAGE).text
    assert client.post(f"/api/v1/visits/{visit}/unlock", json={"reason": "rating misread"}).status_code == 200
    assert cdbs_ma(client, visit) == before + 0.5, "an open visit goes by the present settings"
    assert lock(client, visit).status_code == 200
    assert (state(client, visit), cdbs_ma(client, visit)) == ("stands", before + 0.5)


def test_another_amplitude_in_the_version_at_the_lock_breaks_the_signature(client: TestClient, owner_db: Session, visit: int) -> None:
    assert lock(client, visit).status_code == 200
    owner_db.execute(text("alter table settings_version disable trigger user"))
    owner_db.execute(text("update settings_version set cdbs_amplitude_ma = cdbs_amplitude_ma + 0.5"))
    owner_db.commit()
    assert state(client, visit) == "broken"


def test_a_file_read_again_with_the_same_values_breaks_nothing_and_other_values_do(
    client: TestClient, owner_db: Session, visit: int
) -> None:
    columns = "recording_id, stream, channel, unit, source, dt_s, first_end_s, n, valid_bits, details"
    again = "insert into trace (decode_version, values_f32, {c}) select 99 + {more}, {values}, {c} from trace where decode_version < 99"
    assert lock(client, visit).status_code == 200
    owner_db.execute(text(again.format(c=columns, more=0, values="values_f32")))
    owner_db.commit()
    assert state(client, visit) == "stands"
    other = "overlay(values_f32 placing '\\x00000000'::bytea from 1)"
    owner_db.execute(text(again.format(c=columns, more=1, values=other)))
    owner_db.commit()
    assert state(client, visit) == "broken"


def test_after_an_unlock_the_signature_is_history_and_a_new_lock_asks_for_a_new_one(client: TestClient, visit: int, db: Session) -> None:
    lock(client, visit)
    assert client.post(f"/api/v1/visits/{visit}/unlock", json={"reason": "rating misread"}).json()["signature_state"] == "none"
    assert client.patch(f"/api/v1/visits/{visit}", json={"note": "new", "reason": "forgotten"}).status_code == 200
    lock(client, visit)
    assert [row["signature_state"] for row in client.get(f"/api/v1/visits/{visit}/locks").json()] == ["ended", "none", "stands"]
    assert "signed then" in client.get(f"/visits/{visit}", headers=PAGE).text


def test_locks_of_earlier_versions_say_that_they_have_none(client: TestClient, owner_db: Session, visit: int) -> None:
    owner_db.execute(
        text("insert into visit_lock (visit_id, locked, reason, created_by) values (:v, true, 'complete', 'ada@clinic.example')"),
        {"v": visit},
    )
    owner_db.commit()
    assert state(client, visit) == "not_kept"
    assert "without signature" in client.get(f"/visits/{visit}", headers=PAGE).text
