"""Every filter of the audit trail, on its page and in its table. Only some may take the table, and taking it is a row of the trail."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from app import cli
from app.overview import trail_rows
from app.platform.database import new_session
from tests.conftest import PASSWORD

TODAY = datetime.now(UTC).date()
PAGE = {"Accept": "text/html"}


@pytest.fixture
def used(client: TestClient, client_as: Callable[[str], TestClient], upload: Callable[..., int]) -> int:
    """A study in which two participants, a monitor and a locked user left their rows; the visit of P1."""
    session = upload("cdbs")
    visit = int(client.get(f"/api/v1/sessions/{session}").json()["visit_id"])
    assert client.post("/api/v1/participants", json={"code": "Q7", "site": "main"}).status_code == 201
    assert client.post("/api/v1/participants/Q7/visits", json={"number": 4, "note": "walked in late"}).status_code == 201
    event = {"kind": "fall", "severity": "mild", "visit_id": visit, "note": "stumbled at the door"}
    assert client.post("/api/v1/participants/P1/adverse-events", json=event).status_code == 201
    asked = {"session_id": session, "field": "rating", "text": "The form says 8."}
    assert client_as("monitor").post("/api/v1/participants/P1/data-queries", json=asked).status_code == 201
    assert client.patch(f"/api/v1/visits/{visit}", json={"note": "rained", "reason": "forgotten on the day"}).status_code == 200
    dose = {"drug": "levodopa", "mg": 100, "taken_at": "2026-03-02T07:00:00Z"}
    assert client.post(f"/api/v1/visits/{visit}/doses", json=dose).status_code == 201
    assert client.post(f"/api/v1/visits/{visit}/lock", json={"reason": "complete", "password": PASSWORD}).status_code == 200
    assert client.get("/participants/P1/analyses").status_code == 200
    assert client.get("/participants/P1/analyses.csv").status_code == 200
    client.post("/sign-in", data={"email": "admin@clinic.example", "password": "wrong"})
    return visit


def table(client: TestClient, **filters: str) -> list[dict[str, str]]:
    answer = client.get(f"/audit.csv?{urlencode(filters)}")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-disposition"] == 'attachment; filename="audit-trail.csv"'
    return list(csv.DictReader(io.StringIO(answer.text)))


def rows_of(db: Session, condition: str) -> set[int]:
    return set(db.scalars(text(f"select id from audit_event where {condition}")))


FILTERS: list[tuple[dict[str, str], str]] = [
    ({"entity": "visit"}, "entity = 'visit'"),
    ({"entity": "visit", "entity_id": "1"}, "entity = 'visit' and entity_id = '1'"),
    ({"actor": " Monitor@Clinic.example"}, "actor = 'monitor@clinic.example'"),
    ({"action": "views"}, "action = 'view'"),
    ({"action": "exports"}, "action in ('export', 'download') or entity = 'bundle_release'"),
    ({"action": "refusals"}, "action = 'refuse'"),
    ({"action": "signatures"}, "entity = 'signature'"),
    ({"action": "changes"}, "action in ('insert', 'update', 'delete')"),
    ({"action": "removals"}, "action = 'delete'"),
    ({"words": "forgotten"}, "reason = 'forgotten on the day'"),
    ({"words": "stumbled door"}, "after::text like '%stumbled at the door%'"),
    ({"words": "Q7 visit"}, "entity = 'visit' and after ->> 'note' = 'walked in late'"),
    ({"words": "looked"}, "action = 'view'"),
    ({"words": "signature complete"}, "entity = 'signature'"),
    ({"words": "nowhere-said"}, "false"),
    ({"words": "medication_h"}, "false"),
    ({"words": "100%_"}, "false"),
]


def test_a_filter_leaves_what_it_says_on_the_page_and_in_the_table(client: TestClient, db: Session, used: int) -> None:
    wrong: dict[str, Any] = {}
    for filters, condition in FILTERS:
        name, right = urlencode(filters), rows_of(db, condition)
        page = client.get(f"/audit?{name}&limit=200", headers=PAGE).text
        found = {int(row["number"]) for row in table(client, **filters)} - rows_of(db, "entity = 'audit'")
        told = f"{len(right)} row{'s' if len(right) != 1 else ''} in all" if right else "Nothing matches"
        if (
            found != right - rows_of(db, "entity = 'audit'")
            or told not in page
            or (not right and condition != "false" and filters != {"action": "removals"})
        ):
            wrong[name] = (found, right, told in page)
        db.rollback()
    assert wrong == {}


def test_a_participants_rows_are_all_of_theirs_and_of_nobody_else(client: TestClient, db: Session, used: int) -> None:
    of = {code: table(client, participant=code) for code in ("P1", "q7", "NOBODY")}
    kinds = {code: {(row["action"], row["table"]) for row in rows} for code, rows in of.items()}
    assert {("insert", "session"), ("insert", "adverse_event_revision"), ("insert", "signature"), ("view", "results"),
            ("export", "results"), ("insert", "data_query_entry"), ("insert", "dose")} <= kinds["P1"]  # fmt: skip
    assert kinds["q7"] == {("insert", table) for table in ("participant", "settings_version", "margins_version", "visit")}
    assert of["NOBODY"] == []
    assert {row["number"] for row in of["P1"]}.isdisjoint(row["number"] for row in of["q7"])


def test_days_are_those_of_utc_and_both_are_within(client: TestClient, db: Session, used: int) -> None:
    every = rows_of(db, "true")
    day = timedelta(days=1)
    assert {int(r["number"]) for r in table(client, begin=str(TODAY - day), end=str(TODAY + day))} >= every
    for filters in ({"begin": str(TODAY + day * 2)}, {"end": str(TODAY - day * 2)}):
        assert table(client, **filters) == []
        assert "Nothing matches" in client.get(f"/audit?{urlencode(filters)}", headers=PAGE).text
    moment = db.scalar(text("select max(at) from audit_event"))
    assert moment is not None
    own = f"{moment.astimezone(UTC):%Y-%m-%d}"
    assert table(client, begin=own, end=own) != []


@pytest.mark.parametrize(
    "filters",
    [{"begin": "yesterday"}, {"begin": "2026-02-02", "end": "2026-02-01"}, {"action": "jumps"}, {"words": " ".join("abcdefghi")},
     {"words": "x" * 201}],
)  # fmt: skip
def test_what_cannot_be_looked_for_is_said_at_the_form(client: TestClient, participant_code: str, filters: dict[str, str]) -> None:
    page = client.get(f"/audit?{urlencode(filters)}", headers=PAGE)
    assert page.status_code == 422
    assert 'name="words"' in page.text, "with the form, to correct it"
    assert "Nothing matches" not in page.text
    assert client.get(f"/audit.csv?{urlencode(filters)}").status_code == 422


def test_the_table_says_it_in_words_and_with_what_changed(client: TestClient, used: int) -> None:
    (row,) = table(client, words="forgotten")
    assert (row["who"], row["what"], row["reason"]) == ("admin@clinic.example", "changed visit 1 of P1", "forgotten on the day")
    assert "note: " in row["changes"]
    assert row["changes"].endswith("-> rained")
    assert datetime.fromisoformat(row["time_utc"]).tzinfo is not None


def test_cells_of_the_table_run_in_no_spreadsheet(client: TestClient, used: int) -> None:
    body = {"note": "=HYPERLINK(1)", "reason": "=1+1"}
    assert client.post(f"/api/v1/visits/{used}/unlock", json={"reason": "=1+1"}).status_code == 200
    assert client.patch(f"/api/v1/visits/{used}", json=body).status_code == 200
    assert {r["reason"] for r in table(client, words="=1+1", entity="visit")} == {"'=1+1"}


def test_taking_the_table_is_a_row_of_the_trail_that_keeps_no_words(client: TestClient, db: Session, used: int) -> None:
    table(client, participant="P1", words="Mrs-Smith")
    noted = db.execute(text("select action, actor, after from audit_event where entity = 'audit'")).all()
    assert [tuple(row) for row in noted] == [("export", "admin@clinic.example", {"filters": {"participant": "P1", "words": "stated"}})]
    assert "exported the audit trail: words stated, participant P1" in client.get("/audit?action=exports", headers=PAGE).text
    link = client.get("/audit?participant=P1&words=a%26b", headers=PAGE).text
    assert 'href="/audit.csv?words=a%26b&amp;participant=P1"' in link


def test_who_may_read_the_page_may_take_the_table_and_nobody_else(client_as: Callable[[str], TestClient], used: int, db: Session) -> None:
    before = rows_of(db, "entity = 'audit'")
    for role, status in {"viewer": 403, "blinded_assessor": 403, "coordinator": 200, "engineer": 200, "clinician": 200}.items():
        assert client_as(role).get("/audit.csv?entity=visit").status_code == status, role
    assert len(rows_of(db, "entity = 'audit'") - before) == 3, "who is refused takes nothing"


def test_a_long_trail_is_sent_in_pieces(client: TestClient, db: Session, used: int, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    real = trail_rows.batches

    def counted(*given: Any) -> Iterator[Any]:
        for rows in real(*given):
            read.append(len(rows))
            yield rows

    monkeypatch.setattr(trail_rows, "_BATCH", 7)
    monkeypatch.setattr(trail_rows, "batches", counted)
    rows = table(client)
    numbers = [int(row["number"]) for row in rows]
    assert numbers == sorted(rows_of(db, "true"), reverse=True), "each once, the newest first, the export itself among them"
    assert max(read) == 7
    assert len(read) == -(-len(rows) // 7)


def test_the_command_writes_the_same_table(client: TestClient, used: int, tmp_path: Path) -> None:
    to = tmp_path / "trail.csv"
    said = CliRunner().invoke(cli.app, ["audit", "export", str(to), "--participant", "Q7", "--begin", str(TODAY - timedelta(days=1))])
    assert (said.exit_code, f"Wrote the audit trail to {to}." in said.output) == (0, True), said.output
    rows = list(csv.DictReader(to.open()))
    assert rows == table(client, participant="Q7")
    with new_session() as db:
        assert db.scalar(text("select count(*) from audit_event where entity = 'audit' and actor = 'command line'")) == 1
    assert CliRunner().invoke(cli.app, ["audit", "export", str(tmp_path)]).exit_code == 2
    assert CliRunner().invoke(cli.app, ["audit", "export", str(to), "--begin", "soon"]).exit_code != 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a file that takes no byte is known to Linux alone")
def test_an_export_that_fails_halfway_is_a_row_of_the_trail(client: TestClient, used: int) -> None:
    said = CliRunner().invoke(cli.app, ["audit", "export", "/dev/full"])
    assert (said.exit_code, "/dev/full cannot be written" in said.output) == (1, True), said.output
    with new_session() as db:
        assert db.scalar(text("select count(*) from audit_event where entity = 'audit' and actor = 'command line'")) == 1
