"""Rows that the tables' owner wrote past the trail, and what keeps later writes from it: `betaloop audit verify` names each."""

from __future__ import annotations

import time

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app import cli
from app.platform.audit.breaks import BreakKind
from app.platform.audit.chain import verify
from app.platform.audit.signatures import content_hash
from app.platform.database import new_session
from app.tables.audit import AuditEvent
from tests.app.every_route import World
from tests.conftest import PASSWORD

LOCK = "/api/v1/participants/P1/margins/locks"


def found() -> set[tuple[str, str | None, str | None, tuple[str, ...], str | None]]:
    with new_session() as db:
        return {(b.kind.value, b.table, b.row, b.columns, b.name) for b in verify(db).breaks}


def past_the_triggers(owner_db: Session, table: str, statement: str) -> None:
    """Run a statement as the owner and sweep its traces away: the triggers are as before."""
    owner_db.execute(text(f"alter table {table} disable trigger user"))
    owner_db.execute(text(statement))
    owner_db.execute(text(f"alter table {table} enable trigger user"))
    owner_db.commit()


@pytest.fixture
def visit(client: TestClient, participant_code: str) -> int:
    body = {"number": 7, "note": "seen", "cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": 2.5}]}
    made = int(client.post(f"/api/v1/participants/{participant_code}/visits", json=body).json()["id"])
    assert found() == set()
    return made


@pytest.mark.parametrize(
    ("table", "statement", "kind", "columns"),
    [
        ("cdbs_amplitude", "update cdbs_amplitude set amplitude_ma = 3.5", "row_altered", ("amplitude_ma",)),
        ("visit", "update visit set note = 'not seen', date = '2020-01-01' where number = 7", "row_altered", ("date", "note")),
        ("cdbs_amplitude", "update cdbs_amplitude set removed_at = now()", "row_altered", ("removed_at",)),
        ("cdbs_amplitude", "delete from cdbs_amplitude", "row_removed", ()),
        ("cdbs_amplitude", "truncate cdbs_amplitude", "row_removed", ()),
    ],
)
def test_what_was_written_past_the_trail_is_named(
    visit: int, owner_db: Session, table: str, statement: str, kind: str, columns: tuple[str, ...]
) -> None:
    past_the_triggers(owner_db, table, statement)
    ((said, of, _, differing, _),) = found()
    assert (said, of, tuple(sorted(differing))) == (kind, table, columns)


def test_a_row_that_was_put_in_is_named_and_told_in_words(visit: int, owner_db: Session) -> None:
    past_the_triggers(owner_db, "qoc", "select 1")
    past_the_triggers(
        owner_db, "visit", "insert into visit (id, participant_id, number) select 999, participant_id, 99 from visit where number = 7"
    )
    assert found() == {("row_added", "visit", "999", (), None)}
    said = CliRunner().invoke(cli.app, ["audit", "verify"])
    assert said.exit_code == 1
    assert "table visit, row 999 was put in past the trail" in said.output


def test_a_column_that_an_entry_from_before_it_lacks_must_be_as_that_version_left_it(visit: int, owner_db: Session) -> None:
    owner_db.execute(text("alter table visit add column place varchar(9) not null default 'clinic', add column remark text"))
    owner_db.commit()
    assert found() == set()
    past_the_triggers(owner_db, "visit", "update visit set place = 'home' where number = 7")
    assert {columns for _, _, _, columns, _ in found()} == {("place",)}
    past_the_triggers(owner_db, "visit", "update visit set place = 'clinic', remark = 'x' where number = 7")
    assert {columns for _, _, _, columns, _ in found()} == {("remark",)}


def test_a_zone_of_the_database_changes_no_moment(visit: int, owner_db: Session) -> None:
    owner_db.execute(text("do $$ begin execute format('alter database %I set timezone = ''Asia/Tokyo''', current_database()); end $$"))
    owner_db.commit()
    owner_db.connection().invalidate()
    with new_session() as db:
        db.connection().invalidate()
    with new_session() as db:
        assert db.scalar(text("show timezone")) == "Asia/Tokyo"
        assert verify(db).whole


NOTHING = (
    "create or replace function audit_row() returns trigger language plpgsql security definer"
    " set search_path = pg_catalog, public, pg_temp as $$ begin return null; end $$"
)
HOLDS_BACK = "create function hold_back() returns trigger language plpgsql as $$ begin return null; end $$"


@pytest.mark.parametrize(
    ("statements", "named"),
    [
        ([NOTHING], ("function_changed", None, "audit_row()")),
        (["alter function audit_row() security invoker"], ("function_changed", None, "audit_row()")),
        (["alter function audit_chain() set search_path = pg_temp, public"], ("function_changed", None, "audit_chain()")),
        (["alter table qoc disable trigger audit"], ("trigger_off", "qoc", "audit")),
        (["alter table session disable trigger never_deleted"], ("trigger_off", "session", "never_deleted")),
        (["drop trigger audit on qoc", HOLDS_BACK,
          "create trigger audit after insert or update or delete on qoc for each row execute function hold_back()"],
         ("trigger_unknown", "qoc", "audit")),
        (["drop trigger audit on qoc",
          "create trigger audit after insert or update or delete on qoc for each row execute function audit_row('rating', 'id')"],
         ("trigger_off", "qoc", "audit")),
        (["drop trigger audit on qoc",
          "create trigger audit after insert on qoc for each row execute function audit_row('', 'id')"],
         ("trigger_unknown", "qoc", "audit")),
        (["drop trigger audit on qoc", "create trigger audit after insert or update or delete on qoc for each row"
          " when (pg_trigger_depth() > 5) execute function audit_row('', 'id')"], ("trigger_off", "qoc", "audit")),
        ([HOLDS_BACK, "create trigger first before insert on audit_event for each row execute function hold_back()"],
         ("trigger_unknown", "audit_event", "first")),
        (["create rule lost as on insert to audit_event do instead nothing"], ("trigger_unknown", "audit_event", "lost")),
    ],
)  # fmt: skip
def test_what_would_keep_later_writes_from_the_trail_is_named(
    fresh_database: str, owner_db: Session, statements: list[str], named: tuple[str, str | None, str]
) -> None:
    for statement in statements:
        owner_db.execute(text(statement))
    owner_db.commit()
    assert named in {(kind, table, name) for kind, table, _, _, name in found()}


@pytest.mark.parametrize(
    ("default", "column"),
    [("audit_event alter column at set default '2020-01-01'", "at"), ("audit_event alter column reason set default 'as agreed'", "reason"),
     ("audit_event alter column at set default public.clock_timestamp()", "at"),
     ("signature alter column signed_at drop default", "signed_at")],
)  # fmt: skip
def test_a_default_that_would_write_other_times_or_words_is_named(
    fresh_database: str, owner_db: Session, default: str, column: str
) -> None:
    owner_db.execute(text("create function clock_timestamp() returns timestamptz language sql as $$ select '2020-01-01'::timestamptz $$"))
    owner_db.execute(text("set local search_path = public, pg_catalog"))
    owner_db.execute(text(f"alter table {default}"))
    owner_db.commit()
    table = default.partition(" ")[0]
    assert found() == {("default_changed", table, None, (column,), None)}
    owner_db.execute(text("drop function public.clock_timestamp() cascade"))
    owner_db.commit()


def written_at_a_false_time(client: TestClient, participant_code: str, owner_db: Session, clock: str) -> None:
    """Write one visit while the trail's clock says `clock`, the next when it is right again."""
    for number, default in ((7, clock), (8, "clock_timestamp()")):
        owner_db.execute(text(f"alter table audit_event alter column at set default {default}"))
        owner_db.commit()
        assert client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": number}).status_code == 201


def test_what_was_written_at_a_false_time_stays_named_once_the_clock_is_right_again(
    client: TestClient, participant_code: str, owner_db: Session
) -> None:
    last = owner_db.scalar(text("select max(id) from audit_event"))
    written_at_a_false_time(client, participant_code, owner_db, "'2020-01-01'")
    with new_session() as db:
        (named,) = verify(db).breaks
    assert (named.kind.value, (named.event_id or 0) > (last or 0)) == ("backdated", True)


def test_a_clock_that_was_fast_is_accepted_with_a_reason_and_stays_listed(
    client: TestClient, participant_code: str, owner_db: Session
) -> None:
    written_at_a_false_time(client, participant_code, owner_db, "clock_timestamp() + interval '8 days'")
    with new_session() as db:
        (named,) = verify(db).breaks
    why, row = "the clock was 8 days ahead until it was set by NTP", str(named.event_id)
    for other in (str((named.event_id or 0) - 1), "0"):
        assert "names no false time" in CliRunner().invoke(cli.app, ["audit", "accept", other, "--reason", why]).stderr
    assert CliRunner().invoke(cli.app, ["audit", "accept", row]).exit_code == 2, "a reason is asked for"
    assert CliRunner().invoke(cli.app, ["audit", "verify"]).exit_code == 1
    assert CliRunner().invoke(cli.app, ["audit", "accept", row, "--reason", why]).exit_code == 0
    said = CliRunner().invoke(cli.app, ["audit", "verify"])
    assert (said.exit_code, f"by command line: {why}" in said.stdout, f"row {row} lies more than" in said.stdout) == (0, True, True)
    with new_session() as db:
        found = verify(db)
        assert (found.breaks, [a.found for a in found.accepted]) == ((), [named])
        event = db.scalars(select(AuditEvent).where(AuditEvent.action == "accept")).one()
    assert (event.entity, event.entity_id, event.reason) == ("audit_event", row, why)
    # what else is wrong with that row is a break all the same
    owner_db.execute(text("alter table audit_event disable trigger user"))
    owner_db.execute(text(f"update audit_event set reason = 'another' where id = {row}"))
    owner_db.commit()
    with new_session() as db:
        assert "edited" in {b.kind.value for b in verify(db).breaks}


def test_what_a_function_that_writes_nothing_let_through_stays_named_when_it_is_put_back(
    client: TestClient, participant_code: str, owner_db: Session
) -> None:
    ours = owner_db.scalar(text("select pg_get_functiondef('audit_row()'::regprocedure)"))
    owner_db.execute(text(NOTHING))
    owner_db.commit()
    number = client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 7}).json()["id"]
    owner_db.connection().exec_driver_sql(str(ours))
    owner_db.commit()
    assert found() == {("row_added", "visit", str(number), (), None)}


@pytest.mark.parametrize(
    ("statement", "kinds"),
    [
        ("update signature set content = jsonb_set(content, '{tremor_points}', '50'), sha256 = '{new}'", {"row_altered"}),
        ("update signature set content = jsonb_set(content, '{tremor_points}', '50')", {"signature_changed"}),
        ("update signature set signer = 'somebody.else@clinic.example'", {"row_altered"}),
    ],
)
def test_a_signature_that_was_rewritten_is_named(
    client: TestClient, participant_code: str, owner_db: Session, statement: str, kinds: set[str]
) -> None:
    assert client.post(LOCK, json={"version": 1, "reason": "protocol", "password": PASSWORD}).status_code == 201
    content = owner_db.scalar(text("select content from signature"))
    new = content_hash(dict(content or {}) | {"tremor_points": 50})
    past_the_triggers(owner_db, "signature", statement.replace("{new}", new))
    assert {kind for kind, *_ in found()} == kinds


def test_the_filled_study_is_whole_and_looked_at_within_seconds(world: World) -> None:
    begun = time.process_time()
    with new_session() as db:
        checked = verify(db)
    assert checked.breaks == ()
    assert checked.links > 700
    assert time.process_time() - begun < 10
    assert {kind.value for kind in BreakKind} >= {"row_altered", "row_removed", "row_added"}
