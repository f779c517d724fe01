"""Pages ask the database as often for many sessions as for few: what grows with a study is rows, not queries."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import event

from app.accounts import deps
from app.platform.database import get_engine
from app.platform.kept import forget
from tests.app.evaluations import judge as judge
from tests.app.evaluations import judged
from tests.app.evaluations import policies as policies

PAGES = (
    "/",
    "/participants/P1",
    "/participants/P1/visits",
    "/participants/P1/settings",
    "/participants/P1/upload",
    "/participants/P1/jobs",
    "/participants/P1/ranking",
    "/participants/P1/buffer-gate",
    "/participants/P1/analyses",
    "/participants/P1/analyses/energy",
    "/participants/P1/calibration",
    "/analyses",
    "/trial-time",
)


@pytest.fixture
def queries(client: TestClient) -> Iterator[Callable[[str], int]]:
    """Function that counts the queries of a page once it has been seen."""
    asked: list[str] = []

    def note(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        asked.append(statement)

    def count(path: str) -> int:
        client.get(path, headers={"Accept": "text/html"})
        asked.clear()
        assert client.get(path, headers={"Accept": "text/html"}).status_code == 200, path
        return len(asked)

    event.listen(get_engine(), "before_cursor_execute", note)
    yield count
    event.remove(get_engine(), "before_cursor_execute", note)


def test_more_visits_and_sessions_ask_no_more_queries(
    client: TestClient, upload: Callable[..., int], queries: Callable[[str], int]
) -> None:
    upload("random", steps=20)
    upload("cdbs", steps=20)
    few = {path: queries(path) for path in PAGES}
    client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2026-03-30"})
    for visit in (1, 2):
        for controller in ("random", "cdbs"):
            upload(controller, steps=20, visit=visit)
    assert {path: queries(path) for path in PAGES} == few


def test_a_page_of_a_ranking_reads_the_sessions_once_and_once_for_the_standings(
    client: TestClient, policies: list[int], judge: Callable[..., int], statements: list[str]
) -> None:
    judge({policies[0]: judged(50.0)})
    forget()
    statements.clear()
    assert client.get("/participants/P1/ranking").status_code == 200
    assert sum("session.excluded_reason" in s and "session.ordinal" in s.split("ORDER BY")[-1] for s in statements) == 2
    assert sum("session_conditions.xmin" in s for s in statements) == 2, "nor is what they are made of looked at once more"


def test_jobs_read_no_trace_twice_and_say_at_once_that_nothing_can_be_learned(
    client: TestClient, upload: Callable[..., int], statements: list[str]
) -> None:
    session, page = upload("random", steps=20), "/participants/P1/jobs"
    forget()
    assert "has no session that policies can learn from" not in client.get(page).text
    assert any("trace.values_f32" in s for s in statements)
    statements.clear()
    assert "has no session that policies can learn from" not in client.get(page).text
    assert not any("trace.values_f32" in s for s in statements)
    assert client.patch(f"/api/v1/sessions/{session}", json={"excluded_reason": "tablet froze"}).status_code == 200
    assert "has no session that policies can learn from" in client.get(page).text
    assert client.patch(f"/api/v1/sessions/{session}", json={"excluded_reason": None}).status_code == 200
    assert "has no session that policies can learn from" not in client.get(page).text


def test_a_participants_page_asks_for_no_recording_once_it_has_been_seen(
    client: TestClient, upload: Callable[..., int], statements: list[str]
) -> None:
    upload("random", steps=20)
    upload("cdbs", steps=20)
    seen = client.get("/participants/P1").text
    statements.clear()
    assert client.get("/participants/P1").text == seen
    assert not any("FROM recording" in s or "JOIN recording" in s for s in statements if "xmin" not in s)


def test_a_request_with_a_body_looks_its_caller_up_once_unless_the_body_is_slow(
    client: TestClient, participant_code: str, statements: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def looked_up(number: int) -> int:
        statements.clear()
        assert client.post("/api/v1/participants/P1/visits", json={"number": number}).status_code == 201
        return sum("FROM api_token" in s for s in statements)

    assert looked_up(7) == 1
    monkeypatch.setattr(deps, "CALLER_AGE_S", 0.0)
    assert looked_up(8) == 2


def test_an_upload_reads_its_traces_once(upload: Callable[..., int], statements: list[str]) -> None:
    upload("random", steps=20, qoc={})
    statements.clear()
    upload("random", steps=20, qoc={})
    assert sum("FROM trace" in s for s in statements) == 1
    assert len(statements) <= 55
