"""The signature under locked margins: over their values, asked for with the password, broken by any change."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.orm import Session

from app.platform.audit.chain import verify
from app.platform.audit.signatures import content_hash, covers, newest_of_each
from app.platform.database import new_session
from app.tables.audit import Signature
from tests.conftest import PASSWORD

LOCKS = "/api/v1/participants/P1/margins/locks"
PAGE = {"Accept": "text/html"}
BROKEN = "Signature broken: the margins of version 1 were changed"


def test_a_lock_is_signed_over_its_values(client: TestClient, participant_code: str, db: Session) -> None:
    form = {"version": "1", "lock_reason": "protocol 3.2", "password": PASSWORD}
    assert client.post("/participants/P1/margins/lock", data=form, headers=PAGE, follow_redirects=False).status_code == 303
    (locked,) = client.get(LOCKS).json()
    assert (locked["signature_state"], locked["signature"]["signer"]) == ("stands", "admin@clinic.example")
    assert locked["signature"]["meaning"] == "margins fixed before the sessions that they judge"
    content = db.scalars(select(Signature)).one().content
    assert (content["grasp_share"], content["unsafe_beyond"], content["version"]) == (0.1, 0.9, 1)
    page = client.get("/participants/P1/margins", headers=PAGE).text
    assert (locked["signature"]["sha256"] in page, BROKEN in page) == (True, False)


def test_a_wrong_password_locks_nothing(client: TestClient, participant_code: str, db: Session) -> None:
    assert client.post(LOCKS, json={"version": 1, "reason": "protocol"}).status_code == 422
    assert client.post(LOCKS, json={"version": 1, "reason": "protocol", "password": "a wrong guess"}).status_code == 403
    form = {"version": "1", "lock_reason": "protocol 3.2", "password": "a wrong guess"}
    page = client.post("/participants/P1/margins/lock", data=form, headers=PAGE)
    assert (page.status_code, "The password is wrong." in page.text, 'value="protocol 3.2"' in page.text) == (403, True, True)
    assert (client.get(LOCKS).json(), db.scalars(select(Signature)).all()) == ([], [])


@pytest.mark.parametrize(
    "change",
    [
        "update margins_version set tremor_points = 50",
        "update margins_version set unsafe_beyond = 0.8",
        "update margins_version set created_by = 'somebody else'",
        "update margins_lock set reason = 'another'",
        "update margins_lock set created_by = 'somebody else'",
    ],
)
def test_any_change_breaks_it_visibly(client: TestClient, participant_code: str, owner_db: Session, change: str) -> None:
    assert client.post(LOCKS, json={"version": 1, "reason": "protocol", "password": PASSWORD}).status_code == 201
    table = change.split()[1]
    owner_db.execute(text(f"alter table {table} disable trigger user"))  # what the owner can do, and no service
    assert owner_db.execute(text(change)).rowcount > 0  # type: ignore[attr-defined]
    owner_db.commit()
    assert [lock["signature_state"] for lock in client.get(LOCKS).json()] == ["broken"]
    assert BROKEN in client.get("/participants/P1/margins", headers=PAGE).text


def test_new_margins_break_no_earlier_lock(client: TestClient, participant_code: str) -> None:
    client.post(LOCKS, json={"version": 1, "reason": "protocol", "password": PASSWORD})
    client.put("/api/v1/participants/P1/margins", json={"margins": {"tremor_points": 5}, "reason": "she fears tremor most"})
    client.post(LOCKS, json={"version": 2, "reason": "amended", "password": PASSWORD})
    assert [lock["signature_state"] for lock in client.get(LOCKS).json()] == ["stands", "stands"]


def test_locks_of_earlier_versions_say_that_they_have_none(client: TestClient, participant_code: str, owner_db: Session) -> None:
    owner_db.execute(
        text(
            "insert into margins_lock (participant_id, margins_version_id, reason, created_by)"
            " select participant_id, id, 'protocol', 'ada@clinic.example' from margins_version"
        )
    )
    owner_db.commit()
    assert [lock["signature_state"] for lock in client.get(LOCKS).json()] == ["not_kept"]
    assert "without signature" in client.get("/participants/P1/margins", headers=PAGE).text


@pytest.mark.parametrize("side", ["signature", "trail", "both"])
def test_a_signature_that_was_rewritten_with_its_values_does_not_stand(
    client: TestClient, participant_code: str, owner_db: Session, side: str
) -> None:
    """The owner of the tables changes the margins and what was signed; the entry of the audit trail has another signature."""
    assert client.post(LOCKS, json={"version": 1, "reason": "protocol", "password": PASSWORD}).status_code == 201
    content = owner_db.scalars(select(Signature)).one().content | {"tremor_points": 50}
    for table in ("margins_version", "signature", "audit_event"):
        owner_db.execute(text(f"alter table {table} disable trigger user"))
    if side != "trail":
        owner_db.execute(text("update margins_version set tremor_points = 50"))
        signed = text("update signature set sha256 = :new, content = jsonb_set(content, '{tremor_points}', '50')")
        owner_db.execute(signed, {"new": content_hash(content)})
    if side != "signature":
        told = text("update audit_event set after = jsonb_set(after, '{sha256}', to_jsonb(cast(:new as text))) where entity = 'signature'")
        owner_db.execute(told, {"new": content_hash(content)})
    for table in ("margins_version", "signature", "audit_event"):
        owner_db.execute(text(f"alter table {table} enable trigger user"))
    owner_db.commit()
    assert [lock["signature_state"] for lock in client.get(LOCKS).json()] == ["broken"]
    assert BROKEN in client.get("/participants/P1/margins", headers=PAGE).text
    with new_session() as db:
        assert not verify(db).whole


def test_signatures_and_their_entries_are_read_in_one_query(
    client: TestClient, participant_code: str, db: Session, statements: list[str]
) -> None:
    for number in (1, 2, 3):
        client.post(LOCKS, json={"version": number, "reason": "protocol", "password": PASSWORD})
        client.put("/api/v1/participants/P1/margins", json={"margins": {"tremor_points": number}, "reason": "amended"})
    statements.clear()
    found = newest_of_each(db, "margins_lock", [1, 2, 3])
    assert [covers(s, s.content) for s in found.values()] == [True] * 3
    assert len([s for s in statements if "signature" in s]) == len([s for s in statements if "audit_event" in s]) == 1
