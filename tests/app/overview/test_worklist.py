"""Today is a worklist: what waits for each role in the whole study, visits as a status board, and no link that its page refuses."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.commands import say_how_to_begin
from app.accounts.permissions import SYSTEM, Caller, Grant
from app.accounts.service import add_user
from app.overview.repository import VisitCounts
from app.overview.worklist import COLUMNS, Worklist, board, marks, worklist
from app.platform.database import transaction
from app.study import repository as study
from app.tables.accounts import Role
from app.tables.visits import Visit
from tests.app.every_route import World
from tests.app.pages import page_roles
from tests.app.pages.page_calls import browser
from tests.conftest import PASSWORD

TODAY = datetime.now(UTC).date()


def texts(work: Worklist) -> list[str]:
    return [line.text for line in work.own]


@pytest.mark.parametrize("role", list(Role))
def test_today_links_to_no_page_that_refuses_its_reader(world: World, role: Role) -> None:
    client = browser(world.app, role)
    page = client.get("/", headers={"Accept": "text/html"})
    assert page.status_code == 200
    links = sorted(set(re.findall(r'href="(/(?!static)[^"]*)"', page.text.split("<main")[1])))
    assert len(links) > 4, "a page with participants, visits and work"
    refused = {link: status for link in links if (status := client.get(link, headers={"Accept": "text/html"}).status_code) >= 400}
    assert not refused


def test_every_page_asks_for_what_links_to_it_suppose() -> None:
    for role in Role:
        caller = Caller("somebody", 1, (Grant(1, None, role),))
        for path, permission in page_roles.PAGES.items():
            filled = re.sub(r"{code}|{study_code}|{key}", "P1", re.sub(r"{\w+_id}", "1", path))
            if caller.is_blinded and re.search("{session_id}|{key}|analyses", path):
                continue  # which open with the visit's lock
            expected = path in page_roles.BLINDED_PAGES if caller.is_blinded else caller.may(permission)
            assert caller.may_open(filled) == expected, (role, path)


def test_each_thing_that_waits_is_a_line_until_it_is_done(
    client: TestClient, upload: Callable[..., int], participant_code: str, db: Session
) -> None:
    assert texts(worklist(db, SYSTEM, TODAY)) == []
    session = upload("random", steps=20)
    event = {"kind": "speech", "severity": "severe", "serious": True, "session_id": session}
    assert client.post("/api/v1/participants/P1/adverse-events", json=event).status_code == 201
    stop = {"kind": "stopped", "severity": "mild", "session_id": session}
    number = client.post("/api/v1/participants/P1/adverse-events", json=stop).json()["id"]
    query = {"session_id": session, "field": "controller", "text": "random?"}
    asked = client.post("/api/v1/participants/P1/data-queries", json=query).json()["id"]
    db.expire_all()
    assert texts(worklist(db, SYSTEM, TODAY)) == [
        "Clear 1 serious adverse event",
        "Clear 1 early stop for the participant's sake",
        "Answer 1 data query",
    ]
    assert client.post(f"/api/v1/adverse-events/{number}/clearance", json={"revision": 1, "reason": "a fly"}).status_code == 200
    answer = {"state": "answered", "text": "yes", "entries": 1}
    assert client.post(f"/api/v1/data-queries/{asked}/entries", json=answer).status_code in (200, 201)
    found = worklist(db, SYSTEM, TODAY)
    assert texts(found) == ["Clear 1 serious adverse event", "Close 1 answered data query"]
    assert [(p.code, p.count, p.url) for p in found.own[0].places] == [("P1", 1, "/participants/P1/adverse-events")]
    assert found.own[0].since is not None


def test_a_monitor_sees_what_waits_for_others_apart(client: TestClient, upload: Callable[..., int], db: Session) -> None:
    event = {"kind": "speech", "severity": "severe", "serious": True, "session_id": upload("random", steps=20)}
    assert client.post("/api/v1/participants/P1/adverse-events", json=event).status_code == 201
    (site,) = study.sites(db, SYSTEM)
    monitor = Caller("monitor", 1, (Grant(site.study_id, None, Role.MONITOR),))
    found = worklist(db, monitor, TODAY)
    assert (texts(found), [line.text for line in found.others]) == ([], ["Clear 1 serious adverse event"])
    assert not monitor.may(can.CLEAR_EVENT)
    elsewhere = Caller("clinician", 1, (Grant(site.study_id + 1, None, Role.CLINICIAN),))
    assert worklist(db, elsewhere, TODAY) == Worklist((), ())


def marks_on(day: date, *, locked: bool = False, **counts: Any) -> list[str]:
    usual: dict[str, Any] = {"plan": "approved", "slots": 5, "filled": 5, "sessions": 5, "without_outcomes": 0, "proposed": 0, "doses": 1}
    shown = marks(VisitCounts(**usual | counts), Visit(id=7, number=2, date=day), "P1", TODAY, locked=locked)
    assert len(shown) in (1, len(COLUMNS))
    return [f"{m.tone} {m.text}".strip() for m in shown]


def test_the_marks_say_how_far_a_visit_is() -> None:
    past, ahead = TODAY - timedelta(days=3), TODAY + timedelta(days=3)
    assert marks_on(past, locked=True) == ["good signed", "good 5 sessions", "good complete", "good 1 dose", "good locked"]
    assert marks_on(past, filled=3, sessions=3, without_outcomes=2, doses=0) == [
        "good signed", "bad 3 of 5", "warn 2 missing", "warn none", "warn open",
    ]  # fmt: skip
    assert marks_on(past, proposed=2)[1] == "warn 2 to confirm"
    assert marks_on(past, plan=None, slots=0, filled=0, sessions=0)[:3] == ["none", "bad no session", "—"]
    assert marks_on(ahead, plan="draft", sessions=0) == ["warn to sign"]
    assert marks_on(TODAY, sessions=0, filled=0, doses=0) == ["good signed"], "the day has not begun"


def test_the_board_has_recent_visits_and_the_next_one_of_each_participant(
    client: TestClient, participant_code: str, upload: Callable[..., int], db: Session
) -> None:
    for number, days in ((2, -90), (3, -5), (4, 9), (5, 40)):
        day = (TODAY + timedelta(days=days)).isoformat()
        assert client.post("/api/v1/participants/P1/visits", json={"number": number, "date": day}).status_code == 201
    rows = board(db, SYSTEM, study.next_visits(db, SYSTEM, TODAY), TODAY)
    assert [row.visit.number for row in rows] == [3, 4]


def test_an_empty_today_lists_five_first_steps(client: TestClient) -> None:
    page = client.get("/", headers={"Accept": "text/html"}).text
    steps = page.split('id="first-steps"')[1].split("</ol>")[0]
    assert steps.count("<li>") == 5
    assert 'href="/participants/new"' in steps


def test_an_installation_without_an_account_says_how_the_first_is_made(service_app: Any, capsys: pytest.CaptureFixture[str]) -> None:
    anonymous = TestClient(service_app)
    page = anonymous.get("/sign-in", headers={"Accept": "text/html"}).text
    assert "betaloop user add" in page
    say_how_to_begin()
    assert "betaloop user add" in capsys.readouterr().out
    with transaction("test") as db:
        add_user(db, "ada@clinic.example", Role.ADMIN, PASSWORD)
    assert "betaloop user add" not in anonymous.get("/sign-in", headers={"Accept": "text/html"}).text
    say_how_to_begin()
    assert not capsys.readouterr().out
