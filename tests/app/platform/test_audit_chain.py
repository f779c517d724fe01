"""The chain of the audit trail: the owner of the tables has no way to change it that `betaloop audit verify` does not see."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app import cli
from app.platform.audit.chain import Break, BreakKind, seal, verify
from app.platform.audit.trail import record
from app.platform.database import new_session, set_actor, transaction

Sql = Callable[[str], None]


@pytest.fixture
def trail(client: TestClient, participant_code: str) -> None:
    """Some rows, and a seal over them."""
    for number in (1, 2):
        assert client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": number + 10}).status_code == 201
    with transaction("test") as db:
        seal(db)


@pytest.fixture
def owner(owner_db: Session) -> Sql:
    """SQL of the tables' owner, past every trigger."""

    def run(statement: str) -> None:
        for table in ("audit_event", "audit_link", "audit_seal"):
            owner_db.execute(text(f"alter table {table} disable trigger user"))
        owner_db.execute(text(statement))
        for table in ("audit_event", "audit_link", "audit_seal"):
            owner_db.execute(text(f"alter table {table} enable trigger user"))
        owner_db.commit()

    return run


def breaks() -> list[Break]:
    with new_session() as db:
        return list(verify(db).breaks)


def last() -> int:
    with new_session() as db:
        return int(db.scalar(text("select max(position) from audit_link")) or 0)


# the trail as its owner would recompute it after an edit
RECOMPUTE = """
do $$
declare e audit_event; l audit_link; last bytea := sha256('betaloop audit trail');
begin
    for l in select * from audit_link order by position loop
        select * into e from audit_event where id = l.event_id;
        last := audit_digest(last, e);
        update audit_link set digest = last where position = l.position;
    end loop;
end $$
"""


def test_every_write_has_its_link_and_the_chain_is_whole(trail: None, db: Session) -> None:
    found = verify(db)
    assert found.whole
    assert found.links == db.scalar(text("select count(*) from audit_event")) > 0
    assert found.sealed_to == found.links


def test_links_have_the_order_of_commits_and_no_gaps(trail: None) -> None:
    """Many writers at once, some of whom give up."""

    def write(n: int) -> None:
        for i in range(10):
            with new_session() as db:
                set_actor(db, f"writer {n}")
                record(db, "export", "participant", f"{n}/{i}")
                if i % 3:
                    db.commit()

    threads = [threading.Thread(target=write, args=(n,)) for n in range(6)]
    before = last()
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert breaks() == []
    assert last() == before + 6 * 6


@pytest.mark.parametrize(
    ("statement", "kind"),
    [
        ("update audit_event set actor = 'somebody.else' where id = (select min(id) from audit_event)", BreakKind.EDITED),
        ("update audit_event set after = after || '{\"number\": 99}' where entity = 'visit'", BreakKind.EDITED),
        ("update audit_event set at = at + interval '1 microsecond' where entity = 'visit'", BreakKind.EDITED),
        ("delete from audit_event where id = (select max(id) from audit_event)", BreakKind.REMOVED),
        ("delete from audit_link where position = 2", BreakKind.GAP),
        ("delete from audit_link where position = 1", BreakKind.GAP),
        (
            "insert into audit_event (actor, action, entity, entity_id) values ('x', 'insert', 'visit', '9')",
            BreakKind.ADDED,
        ),
        (
            "update audit_event a set actor = b.actor, entity_id = b.entity_id, after = b.after from audit_event b"
            " where a.entity = 'visit' and b.entity = 'visit' and a.id <> b.id",
            BreakKind.EDITED,
        ),
        (
            "delete from audit_event where id = (select event_id from audit_link order by position desc limit 1);"
            " delete from audit_link where position = (select max(position) from audit_link)",
            BreakKind.CUT_OFF,
        ),
        ("update audit_event set actor = 'x' where entity = 'visit';" + RECOMPUTE, BreakKind.REWRITTEN),
        ("update audit_seal set mac = sha256('guess')", BreakKind.FORGED_SEAL),
    ],
)
def test_what_the_owner_changes_is_found(trail: None, owner: Sql, statement: str, kind: BreakKind) -> None:
    assert breaks() == []
    owner(statement)
    assert kind in {b.kind for b in breaks()}


def test_links_in_another_order_are_found(trail: None, owner: Sql) -> None:
    owner(
        "create temp table swapped as select position, event_id from audit_link where position in (2, 3);"
        "delete from audit_link where position in (2, 3);"
        "insert into audit_link select 5 - position, event_id, sha256('') from swapped"
    )
    assert {(b.kind, b.position) for b in breaks()} >= {(BreakKind.EDITED, 2), (BreakKind.EDITED, 3)}


def test_a_seal_that_was_deleted_from_the_database_still_stands_in_its_file(trail: None, owner: Sql) -> None:
    owner("delete from audit_seal; update audit_event set actor = 'x' where entity = 'visit';" + RECOMPUTE)
    assert [(b.kind, b.position) for b in breaks()] == [(BreakKind.REWRITTEN, last())]


def test_a_trigger_that_is_off_is_named(trail: None, owner_db: Session) -> None:
    owner_db.execute(text("alter table qoc disable trigger audit"))
    owner_db.execute(text("alter table audit_event disable trigger chained"))
    owner_db.commit()
    assert {b.table for b in breaks() if b.kind is BreakKind.TRIGGER_OFF} == {"audit_event", "qoc"}


def test_the_command_says_where_it_is_broken(trail: None, owner: Sql) -> None:
    runner = CliRunner()
    fine = runner.invoke(cli.app, ["audit", "verify"])
    assert fine.exit_code == 0
    assert f"whole: {last()} links, sealed up to link {last()}" in fine.output
    owner("update audit_event set reason = 'x' where id = (select event_id from audit_link where position = 1)")
    broken = runner.invoke(cli.app, ["audit", "verify"])
    assert broken.exit_code == 1
    assert "link 1: row" in broken.output
    assert "is not what was written" in broken.output


def test_links_and_seals_take_no_change_from_the_owner_by_accident(trail: None, owner_db: Session) -> None:
    for table in ("audit_link", "audit_seal"):
        for statement in (f"delete from {table}", f"update {table} set position = position + 1000", f"truncate {table}"):
            with pytest.raises(Exception, match="never changed or deleted"):
                owner_db.execute(text(statement))
            owner_db.rollback()


def actions(entity: str) -> list[tuple[str, str, str]]:
    with new_session() as db:
        rows = db.execute(text("select actor, action, entity_id from audit_event where entity = :e order by id"), {"e": entity})
        return [tuple(r) for r in rows]  # type: ignore[misc]


def test_what_leaves_and_who_looked_is_in_the_trail(client: TestClient, participant_code: str) -> None:
    for _ in range(2):
        assert client.get(f"/participants/{participant_code}/analyses").status_code == 200
    for nothing in ("NOBODY/analyses", f"{participant_code}/analyses/models/nothing"):
        assert client.get(f"/participants/{nothing}").status_code == 404
    assert client.get(f"/participants/{participant_code}/export.zip").status_code == 200
    me = "admin@clinic.example"
    assert actions("results") == [(me, "view", f"/participants/{participant_code}/analyses")], "a reload is one view"
    said = client.get("/audit").text
    assert f"looked at the results of {participant_code}: analyses" in said
    assert f"exported the record of {participant_code}" in said
    assert [(a, what) for a, what, _ in actions("participant") if what == "export"] == [(me, "export")]


def test_refused_sign_ins_are_in_the_trail_and_no_password_that_was_typed_as_an_address(client: TestClient) -> None:
    for address in ("admin@clinic.example", "correct horse battery staple"):
        client.post("/sign-in", data={"email": address, "password": "wrong"})
    refused = [(action, what) for _, action, what in actions("sign_in") if action == "refuse"]
    assert refused == [("refuse", "admin@clinic.example"), ("refuse", "unknown address")]
