"""Every route that shows results by controller records who looked, and every route that delivers a file records who took it."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text

from app.platform.audit import trail
from app.platform.database import new_session
from app.settings import get_settings
from tests.app.every_route import PASSWORD, World
from tests.app.every_route import routes as api_routes
from tests.app.pages.every_page import addresses
from tests.conftest import PASSWORD as PASSWORD_OF_TESTS

ROOT = Path(__file__).resolve().parents[3]
SHOWS_NO_RESULTS = {
    # accounts, studies, and what is about no participant
    "/sign-in", "/account", "/accounts", "/studies", "/glossary", "/api-reference", "/styleguide", "/audit", "/search",
    "/healthz", "/readyz",
    "/api/v1/studies", "/api/v1/studies/{study_code}/members",
    "/studies/{study_code}/column-mappings", "/api/v1/studies/{study_code}/column-mappings",
    "/api/v1/bundle-key", "/api/v1/bundle-withdrawals",
    # who takes part, and what is agreed: the home page has its energy from /energy-saved
    "/", "/api/v1/participants", "/api/v1/participants/{code}", "/participants/new", "/participants/{code}/visits/new",
    "/participants/{code}/settings", "/api/v1/participants/{code}/settings", "/participants/{code}/margins",
    "/api/v1/participants/{code}/margins", "/api/v1/participants/{code}/margins/locks",
    "/api/v1/participants/{code}/confirmations",
    "/participants/{code}/characteristics", "/api/v1/participants/{code}/characteristics",
    # days, doses, devices and questions, which name no controller
    "/api/v1/participants/{code}/visits", "/api/v1/visits/{visit_id}", "/api/v1/visits/{visit_id}/locks", "/api/v1/visits/{visit_id}/doses",
    "/participants/{code}/device-history", "/api/v1/participants/{code}/device-history",
    "/participants/{code}/data-queries", "/api/v1/participants/{code}/data-queries",
    # outcomes of a session without what ran, and what it ran under without outcomes
    "/api/v1/sessions/{session_id}/qoc", "/api/v1/sessions/{session_id}/outcomes", "/api/v1/sessions/{session_id}/conditions",
    "/sessions/{session_id}/markers", "/api/v1/sessions/{session_id}/markers",
    # files that came in, and sessions that are not confirmed
    "/participants/{code}/upload", "/participants/{code}/upload/progress", "/uploads/{upload_id}", "/api/v1/uploads/{upload_id}",
    "/participants/{code}/proposals", "/api/v1/participants/{code}/proposals", "/proposals/{session_id}", "/api/v1/proposals/{session_id}",
    "/participants/{code}/quarantine", "/api/v1/participants/{code}/quarantine",
    "/uploaded-files/{file_id}/mapping", "/api/v1/uploaded-files/{file_id}/preview",
    # what policies are and learned from, and jobs
    "/participants/{code}/policies", "/api/v1/participants/{code}/policies", "/api/v1/policies/{policy_id}",
    "/api/v1/policies/{policy_id}/release", "/api/v1/policies/{policy_id}/port-checks",
    "/api/v1/policies/{policy_id}/port-checks/{check_id}/page", "/snapshots/{snapshot_id}", "/api/v1/snapshots/{snapshot_id}",
    "/api/v1/participants/{code}/snapshots", "/participants/{code}/jobs", "/jobs", "/jobs/{job_id}", "/api/v1/participants/{code}/jobs",
    "/api/v1/jobs/{job_id}", "/api/v1/jobs/{job_id}/events",
    # what shall run
    "/participants/{code}/plans", "/visits/{visit_id}/bundles", "/api/v1/visits/{visit_id}/day",
    "/visit-day/shell", "/visit-day/worker.js", "/visit-day/key",
}  # fmt: skip
"""Whatever else a browser or a program may read shows outcomes by controller, or hands out a file, and leaves a row of the trail."""
NO_FILES = ("text/html", "application/json", "text/plain", "text/javascript", "text/event-stream")


@dataclass
class Answer:
    """Answer to a call, and the rows that it put into the trail: (action, entity)."""

    status: int
    is_file: bool
    rows: list[tuple[str, str]] = field(default_factory=list)

    @property
    def left(self) -> bool:
        """True where a file was taken; each bundle is a row of its own table."""
        return any(action in ("export", "download") or (action, entity) == ("insert", "bundle_release") for action, entity in self.rows)

    @property
    def looked(self) -> bool:
        """True where results were looked at, or a file was taken."""
        return self.left or any(action == "view" for action, _ in self.rows)


def newest() -> int:
    with new_session() as db:
        return int(db.scalar(text("select coalesce(max(id), 0) from audit_event")) or 0)


def ask(client: TestClient, method: str, path: str, **form: Any) -> Answer:
    before = newest()
    with client.stream(method, path, **form) as answer:
        if not answer.headers.get("content-type", "").startswith("text/event-stream"):
            answer.read()
        kind = answer.headers.get("content-type", "").partition(";")[0]
        is_file = "content-disposition" in answer.headers or (bool(kind) and kind not in NO_FILES)
        found = Answer(answer.status_code, is_file and answer.status_code == 200)
    with new_session() as db:
        rows = db.execute(text("select action, entity from audit_event where id > :last order by id"), {"last": before})
        found.rows = [(action, entity) for action, entity in rows]
    return found


@pytest.fixture
def every_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looks at one thing are a row each, so that no route hides behind another."""
    monkeypatch.setattr(trail, "VIEW_EVERY", timedelta(0))


def every_read(world: World) -> Iterator[tuple[str, str, Any]]:
    """Route, address and query of everything that can be read; in each form in which a route gives it."""
    described = world.app.openapi()["paths"]
    for method, route in api_routes(world.app):
        if method != "get":
            continue
        form = dict(world.forms.get((method, route.removeprefix("/api/v1")), {}))
        path, query = route.format(**world.ids_of(method, route)), dict(form.get("params", {}))
        yield route, path, query  # as JSON, where it has several forms
        stated = {p["name"]: p["schema"] for p in described[route]["get"].get("parameters", ())}
        for value in stated.get("format", {}).get("enum", ()):
            if value == "json":
                continue
            yield route, path, query | {"format": value}
    for route, path in addresses(world).items():
        yield route, path, None


def test_who_looked_at_results_and_who_took_a_file_is_in_the_trail(world: World, every_look: None) -> None:
    browser = TestClient(world.app, headers={"Accept": "text/html"}, follow_redirects=False)
    assert browser.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 303
    get_settings().development = True
    refused, untold, told, unmarked, read, files = {}, set(), set(), set(), set(), set()
    for route, path, query in every_read(world):
        found = (
            ask(world.admin, "get", path, params=query) if route.startswith(("/api/", "/healthz", "/readyz")) else ask(browser, "get", path)
        )
        if found.status not in (200, 303):
            refused[path, str(query)] = found.status
        read.add(route)
        if route in SHOWS_NO_RESULTS:
            told |= {route} if found.looked else set()
        elif found.status == 200 and not found.looked:
            untold.add(route)
        if found.is_file:
            files.add((route, (query or {}).get("format")))
            unmarked |= set() if found.left else {(route, str(query))}
    assert refused == {}, "what cannot be read shows nothing"
    assert untold == set(), "these show results, or say in SHOWS_NO_RESULTS that they do not, and why"
    assert told == set(), "listed as showing no results, and yet it tells the trail that somebody looked"
    assert set(read) >= SHOWS_NO_RESULTS, "no such route"
    assert unmarked == set(), "a file left and the trail does not say so"
    ways = {route.rpartition(".")[2] if "." in route else form for route, form in files}
    assert ways >= {"csv", "svg", "pdf", "zip"}
    assert len(files) >= 18
    assert ("/api/v1/sessions/{session_id}/samples", None) in files


def test_files_that_are_sent_for_leave_a_row_too(world: World) -> None:
    """Those of forms: an original under review, and a bundle within stated limits."""
    review = world.unreadable(b"taken")
    assert ask(world.admin, "post", f"/api/v1/uploaded-files/{review}/review").left
    browser = TestClient(world.app, headers={"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}, follow_redirects=False)
    browser.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD})
    again = ask(browser, "post", f"/uploaded-files/{review}/decision", data={"do": "review"})
    assert (again.status, again.is_file, again.left) == (200, True, True)
    bundle = f"/participants/P1/policies/{world.ids['policy_id']}/bundle"
    taken = ask(browser, "post", bundle, data={"min_ma": "0", "max_ma": "3", "ramp_ma_per_s": "1.5"})
    assert (taken.status, taken.is_file, taken.left) == (200, True, True)


def test_no_other_module_hands_out_a_file() -> None:
    """Files get their names in few places: a module that begins to deliver some must be called by a test of this file."""
    naming = set()
    for path in (ROOT / "app").rglob("*.py"):
        tree = ast.parse(path.read_text())
        if any(isinstance(node, ast.Constant) and node.value == "Content-Disposition" for node in ast.walk(tree)):
            naming.add(str(path.relative_to(ROOT)))
    assert naming == {
        "app/analysis/metrics_charts.py", "app/ingest/quarantine/serializers.py", "app/overview/overview_web.py",
        "app/overview/signals_web.py",
        "app/planning/bundles/api.py", "app/planning/bundles/pages.py", "app/planning/bundles/threshold_rule.py",
        "app/platform/web/csv_files.py",
        "app/platform/web/middleware.py",
    }  # fmt: skip


def test_a_blinded_assessor_is_recorded_once_something_was_unblinded_for_them(
    client: TestClient, client_as: Callable[[str], TestClient], upload: Callable[..., int]
) -> None:
    session = upload("cdbs")
    visit = client.get(f"/api/v1/sessions/{session}").json()["visit_id"]
    blinded = client_as("blinded_assessor")
    own = ("/participants/P1", "/participants/P1/visits", "/participants/P1/analyses", "/analyses", "/energy-saved", f"/visits/{visit}",
           f"/api/v1/sessions/{session}", f"/api/v1/visits/{visit}/sessions")  # fmt: skip
    for path in own:
        assert ask(blinded, "get", path).rows == [], f"{path}: nothing is told yet"
    assert client.post(f"/api/v1/visits/{visit}/lock", json={"reason": "complete", "password": PASSWORD_OF_TESTS}).status_code == 200
    seen = {path: ask(blinded, "get", path).rows for path in own}
    assert seen[f"/visits/{visit}"] == [("view", "visit")]
    assert seen[f"/api/v1/visits/{visit}/sessions"] == [], "the visit was looked at just now: one row in a quarter of an hour"
    assert seen[f"/api/v1/sessions/{session}"] == [("view", "session")]
    for path in own[:5]:
        assert seen[path] == [("view", "results")], path
    with new_session() as db:
        who = db.scalars(text("select distinct actor from audit_event where action = 'view' and entity = 'visit'")).all()
    assert "blinded_assessor@clinic.example" in who


def test_each_table_that_is_taken_is_a_row_and_is_called_an_export(client: TestClient, upload: Callable[..., int]) -> None:
    upload("cdbs")
    for _ in range(2):
        assert ask(client, "get", "/analyses/results.csv").rows == [("export", "results")]
    assert ask(client, "get", "/api/v1/participants/P1/analyses/energy?format=csv").rows == [("export", "results")]
    assert ask(client, "get", "/api/v1/participants/P1/analyses/energy").rows == [("view", "results")]
    said = client.get("/audit").text
    assert "exported the results of all participants: results as CSV" in said
    assert "exported the results of P1: analyses, energy as CSV" in said


def test_a_reload_costs_one_query_and_no_row(client: TestClient, upload: Callable[..., int], statements: list[str]) -> None:
    upload("cdbs")
    client.get("/energy-saved")
    statements.clear()
    assert ask(client, "get", "/energy-saved").rows == []
    assert sum("FROM audit_event" in s for s in statements) == 1
    assert not any("audit_note" in s for s in statements)
