"""A sealed key of a blinded plan hides what ran in its sessions: on every page, by every route, in every sentence."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from itertools import chain
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from pypdf import PdfReader
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.ranking.results import driven_sessions
from app.learning.coverage import describe
from app.learning.snapshots import not_ready, take_snapshot
from app.study.repository import participant_by_code, sessions_of_participant
from app.tables.plans import Plan
from tests.app.planning.slots.test_logs import DAY, log_of, send
from tests.app.planning.slots.test_slots import recording
from tests.app.study.recordings.test_device_history import BEGIN, report

PAGE = {"Accept": "text/html"}
Clients = Callable[[str], TestClient]
TELLING = re.compile(r"rl-0\d|\brl\b|cdbs\b(?!_)|\brandom\b|distilled|No DBS|mean amplitude", re.IGNORECASE)


@pytest.fixture
def plan(client: TestClient, db: Session, study_world: Any, sign_plan: Callable[..., Any]) -> Plan:
    """A signed, blinded plan: two policies, cDBS between, a random session."""
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "design": "stratified"}})
    assert client.patch(f"/api/v1/visits/{study_world.visit}", json={"date": str(DAY), "reason": "agreed"}).status_code == 200
    wanted = {"policy_ids": list(study_world.policies[:2]), "random_sessions": 1, "seed": 1, "minutes_per_session": 5, "blinded": True}
    drafted = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=wanted)
    assert drafted.status_code == 201, drafted.text
    assert sign_plan(study_world.visit).status_code == 200
    return db.get_one(Plan, drafted.json()["id"])


@pytest.fixture
def coordinator(client_as: Clients) -> TestClient:
    return client_as("coordinator")


@pytest.fixture
def uploads(coordinator: TestClient, db: Session, plan: Plan) -> list[dict[str, Any]]:
    """The logs of all its sessions, uploaded by a coordinator; some name a policy and its network."""
    networks = dict(db.execute(text("select id, onnx_sha256 from policy")).all())
    return [
        send(coordinator, log_of(plan, i.position, 10 * i.position, number=i.position, network_sha256=networks.get(i.policy_id)))
        for i in plan.items
    ]


@pytest.fixture
def sessions(coordinator: TestClient, study_world: Any, uploads: list[dict[str, Any]]) -> dict[int, int]:
    """Confirmed by the coordinator in one step: session by position."""
    done = coordinator.post(f"/api/v1/visits/{study_world.visit}/slots/confirm", json={})
    assert done.status_code == 200, done.text
    assert not TELLING.search(str(done.json())), done.json()
    return {row["position"]: row["session_id"] for row in done.json()["comparison"]["rows"]}


def words(page: str) -> str:
    """Return the page's own words: without its forms' choices, scripts and navigation."""
    body = page[page.index("<main") :] if "<main" in page else page
    return re.sub(r"<(select|datalist|script|nav)\b.*?</\1>|<[^>]*>", " ", body, flags=re.DOTALL)


def open_key(client: TestClient, visit: int) -> None:
    assert client.post(f"/api/v1/visits/{visit}/plan/key", json={"reason": "the visit is over"}).status_code == 200


def test_the_key_opens_in_an_emergency_after_the_participant_has_withdrawn(client: TestClient, study_world: Any, plan: Plan) -> None:
    left = client.patch("/api/v1/participants/P1", json={"status": "withdrawn", "reason": "asked to stop"})
    assert left.status_code == 200, left.text
    opened = client.post(f"/api/v1/visits/{study_world.visit}/plan/key", json={"emergency": True})
    assert opened.status_code == 200, opened.text
    drafted = client.post(
        f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": list(study_world.policies[:1]), "minutes_per_session": 5}
    )
    assert drafted.status_code == 409, "and nothing new is planned"


def test_a_coordinator_uploads_and_confirms_by_letters(
    client: TestClient, coordinator: TestClient, db: Session, study_world: Any, plan: Plan, uploads: list[dict[str, Any]]
) -> None:
    for body in uploads:
        (proposal,) = body["proposals"]
        assert (proposal["session"]["controller"], proposal["session"]["policy_id"]) == (None, None)
        assert "key of the blinded plan is sealed" in proposal["evidence"]["controller"]
        assert not TELLING.search(str(body["report"])), body["report"]
    first = uploads[0]["proposals"][0]["session"]["id"]
    for path in ("/participants/P1/proposals", f"/proposals/{first}", f"/uploads/{uploads[0]['id']}", f"/visits/{study_world.visit}"):
        said = words(coordinator.get(path, headers=PAGE).text).replace("cDBS amplitude", "").replace("% of cDBS", "")
        assert not TELLING.search(said), (path, TELLING.search(said))
    form = coordinator.get("/participants/P1/proposals", headers=PAGE).text
    assert form.count('<option value="hidden" selected>') == len(uploads)
    asked = {"version": uploads[0]["proposals"][0]["version"], "policy": "rl-01"}
    assert coordinator.patch(f"/api/v1/proposals/{first}", json=asked).status_code == 403, "what is refused would tell"
    # the form of all proposals, sent back as it is, keeps what it could not show
    fields = dict(re.findall(r'name="((?:version|seen)-\d+)" value="([^"]*)"', form))
    sent = fields | {f"controller-{b['proposals'][0]['session']['id']}": "hidden" for b in uploads} | {"do": "save:all"}
    assert coordinator.post("/participants/P1/proposals", data=sent, headers=PAGE, follow_redirects=False).status_code == 303
    done = coordinator.post(f"/visits/{study_world.visit}/slots/confirm", headers=PAGE)
    assert done.status_code == 200, done.text
    ran = db.execute(
        text("select s.controller, s.policy_id, i.controller, i.policy_id from session s join plan_item i on i.id = s.plan_item_id")
    )
    pairs = [(tuple(row[:2]), tuple(row[2:])) for row in ran]
    assert len(pairs) == len(plan.items)
    assert all(session == item for session, item in pairs)
    letters = {s["letter"] for s in coordinator.get(f"/api/v1/visits/{study_world.visit}/sessions").json()["items"]}
    assert letters == {i.label for i in plan.items}
    open_key(client, study_world.visit)
    shown = coordinator.get(f"/visits/{study_world.visit}", headers=PAGE).text
    assert {m.lower() for m in TELLING.findall(words(shown))} >= {"cdbs", "rl", "random"}
    assert {s["controller"] for s in coordinator.get(f"/api/v1/visits/{study_world.visit}/sessions").json()["items"]} == {
        "cdbs",
        "rl",
        "random",
    }


HELD = ("session", "controller, policy_id", "plan_item_id")
PLANNED = ("plan_item", "controller, policy_id, min_ma, max_ma, design, repeat, verdict, min_fraction", "id")


def swap(db: Session, what: tuple[str, str, str], one: int, other: int) -> None:
    """Let the arms of two sessions change places, as done or as planned."""
    table, names, key = what
    twin = f"(select {names} from {table} t where t.{key} = case x.{key} when :one then :other else :one end)"
    db.execute(text(f"update {table} x set ({names}) = {twin} where x.{key} in (:one, :other)"), {"one": one, "other": other})
    db.commit()


def test_no_page_and_no_route_depends_on_what_ran_until_the_key_is_opened(
    client: TestClient,
    client_as: Clients,
    coordinator: TestClient,
    service_app: FastAPI,
    db: Session,
    study_world: Any,
    plan: Plan,
    sessions: dict[int, int],
) -> None:
    """Every page and route answers the same where two sessions change places, and differently once the key is open."""
    policy = next(i for i in plan.items if i.policy_id == study_world.policies[0])
    other = next(i for i in plan.items if i.controller == "cdbs")
    named = {"code": "P1", "visit_id": study_world.visit, "policy_id": study_world.policies[0]}
    skipped = ("/audit", "/bundle", "/events", "/metrics", ".pdf", "/key", "/account", "openapi", "/jobs")
    paths = sorted(
        {
            c.path.format(**named, session_id=session)
            for c in iter_route_contexts(service_app.routes)
            for session in (sessions[policy.position], sessions[other.position])
            if c.path
            and "GET" in (getattr(c, "methods", None) or ())
            and set(re.findall(r"{(\w+)", c.path)) <= {*named, "session_id"}
            and not any(part in c.path for part in skipped)
        }
    )
    assert len(paths) > 60

    def answers(caller: TestClient) -> dict[str, str]:
        changing = r'[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f-]{22}|"request_id":"\w+"|name="csrf[^>]*>|nonce-?="?[\w-]+|\d\d:\d\d:\d\d[\d.]*'
        found = {p: caller.get(p) for p in paths}
        assert [p for p, answer in found.items() if answer.status_code >= 500] == []
        return {p: re.sub(changing, "", answer.text) for p, answer in found.items()}

    people = {"coordinator": coordinator, "clinician": client_as("clinician")}
    sealed = {role: answers(person) for role, person in people.items()}
    swap(db, HELD, policy.id, other.id)
    for role, person in people.items():
        now = answers(person)
        assert [p for p in paths if sealed[role][p] != now[p]] == [], role
    swap(db, PLANNED, policy.id, other.id)
    now, visit = answers(coordinator), study_world.visit
    of_signature = {f"/visits/{visit}/plan", f"/api/v1/visits/{visit}/plan", f"/api/v1/visits/{visit}/day", f"/visit-day/{visit}"}
    assert {p for p in paths if sealed["coordinator"][p] != now[p]} == of_signature, "it is broken by any change"
    open_key(client, study_world.visit)
    known = answers(coordinator)
    swap(db, HELD, policy.id, other.id)
    again = answers(coordinator)
    assert sum(known[p] != again[p] for p in paths) >= 10, "the swap shows once the key is open"
    assert all(again[p] != sealed["coordinator"][p] for p in (f"/visits/{study_world.visit}", f"/sessions/{sessions[policy.position]}"))


def test_traces_conditions_and_samples_are_refused_to_everybody_with_the_way_out(client: TestClient, sessions: dict[int, int]) -> None:
    for session in list(sessions.values())[:1]:
        for part in ("trace", "traces", "conditions", "samples", "signal"):
            refused = client.get(f"/api/v1/sessions/{session}/{part}")
            assert refused.status_code == 403, part
            assert "A clinician opens the key" in refused.json()["hint"]
        assert client.put(f"/api/v1/sessions/{session}/conditions", json={"lower_bound": 0.1, "reason": "x"}).status_code == 403
        for bound in ("0.1", "0.99"):  # a bound above what was delivered would be refused in words that name it
            typed = {"lower_bound": bound, "conditions_reason": "x"}
            answer = client.post(f"/sessions/{session}/conditions", data=typed, headers=PAGE, follow_redirects=False)
            assert answer.status_code == 403, answer.text
            assert "hidden from everybody" in answer.text
        # what reveals nothing goes on
        assert client.put(f"/api/v1/sessions/{session}/qoc", json={"rating": 6}).status_code == 200
        assert client.patch(f"/api/v1/sessions/{session}", json={"excluded_reason": "cable", "reason": "x"}).status_code == 200
        page = client.get(f"/sessions/{session}", headers=PAGE).text
        assert "key of this visit" in page
        assert "cable" in page
        assert client.post(f"/sessions/{session}/exclusion", data={"include": "yes"}, follow_redirects=False).status_code == 303


def test_the_audit_trail_tells_no_arm_of_a_sealed_plan(
    client: TestClient, db: Session, study_world: Any, plan: Plan, sessions: dict[int, int]
) -> None:
    def trail() -> str:
        entities = ("plan_item", "session", "session_proposal", "session_conditions")
        return " ".join(words(client.get(f"/audit?entity={e}&limit=100", headers=PAGE).text) for e in entities)

    assert db.scalar(text("select count(*) from audit_event where entity = 'plan_item' and after ->> 'controller' = 'random'"))
    sealed = trail()
    assert "hidden from you" in sealed
    assert not re.findall(r".{0,60}\b(?:random|rl|rl-0\d|stratified)\b", sealed)
    open_key(client, study_world.visit)
    assert re.search(r"\brandom\b", trail())


def test_no_search_and_no_table_of_the_trail_tells_an_arm_of_a_sealed_plan(
    client: TestClient, study_world: Any, plan: Plan, sessions: dict[int, int]
) -> None:
    """A search that finds a row by a hidden value reveals the value."""

    def found(entity: str, word: str) -> tuple[int, str]:
        address = f"entity={entity}&words={word}"
        table = client.get(f"/audit.csv?{address}").text
        assert ("Nothing matches" in client.get(f"/audit?{address}", headers=PAGE).text) == (table.count("\n") == 1)
        return table.count("\n") - 1, table

    assert found("plan_item", "random")[0] == 0
    assert not re.search(r"random|rl-0\d", found("plan_item", "P1")[1])
    open_key(client, study_world.visit)
    assert found("plan_item", "random")[0] > 0
    assert re.search(r"random", found("plan_item", "P1")[1])


def test_what_learns_and_compares_leaves_the_visit_out_until_the_key_is_opened(
    client: TestClient, db: Session, study_world: Any, plan: Plan, sessions: dict[int, int]
) -> None:
    participant = participant_by_code(db, "P1", SYSTEM)
    before = take_snapshot(db, participant, SYSTEM)
    db.commit()
    members = {m.session_id: m.left_out_reason or "" for m in before.members}
    assert all("blinded plan is sealed" in members[s] for s in sessions.values())
    slots = f"/api/v1/visits/{study_world.visit}/slots"
    assert not [r for r in client.get(slots).json()["rows"] if r["predicted"] or "energy" in r["done"]], "100 % of cDBS would name cDBS"
    found = client.get("/api/v1/participants/P1/analyses").json()
    assert {e["reason"] for e in found["excluded"] if e["session_id"] in sessions.values()} == {
        "the key of its visit's blinded plan is sealed"
    }
    assert "visit 2: the key of its blinded plan is sealed" in client.get("/api/v1/participants/P1/calibration").json()["left_out"]
    package = zipfile.ZipFile(io.BytesIO(client.get("/participants/P1/export.zip").content))
    assert "the sessions of visit 2, whose blinded plan's key is sealed" in package.read("P1/README.txt").decode()
    assert not set(map(str, sessions.values())) & {line.split(",")[0] for line in package.read("P1/sessions.csv").decode().splitlines()}
    # of machines too: what a job computes for people would reveal them
    assert not set(sessions.values()) & {s.session_id for s in driven_sessions(db, before, SYSTEM)}
    assert describe(db, before, SYSTEM).sessions_by_visit.keys() == {1}
    open_key(client, study_world.visit)
    assert all("energy" in r["done"] for r in client.get(slots).json()["rows"])
    db.expire_all()
    ran = {s for s, i in zip(sessions.values(), plan.items, strict=True) if i.policy_id is not None or i.controller == "cdbs"}
    assert ran <= {s.session_id for s in driven_sessions(db, before, SYSTEM)}
    after = take_snapshot(db, participant, SYSTEM)
    kept = {m.session_id for m in after.members if m.left_out_reason is None}
    assert set(sessions.values()) & kept, "at least the sessions of cDBS and random draws enter"
    assert after.id != before.id


def test_what_can_be_learned_from_is_asked_anew_once_the_key_is_opened(
    client: TestClient, db: Session, study_world: Any, sessions: dict[int, int]
) -> None:
    participant = participant_by_code(db, "P1", SYSTEM)
    for session in sessions_of_participant(db, participant.id):
        if session.id not in sessions.values():
            body = {"excluded_reason": "another day", "reason": "another day"}
            assert client.patch(f"/api/v1/sessions/{session.id}", json=body).status_code == 200
    db.expire_all()
    blocked = not_ready(db, participant)
    assert blocked is not None
    assert "blinded plan is sealed" in blocked.detail
    open_key(client, study_world.visit)
    db.expire_all()
    assert not_ready(db, participant) is None


def test_a_sealed_plan_that_was_run_is_not_replaced_before_its_key_is_opened(
    client: TestClient, study_world: Any, sessions: dict[int, int]
) -> None:
    draft = {"policy_ids": [study_world.policies[0]], "reason": "another order"}
    refused = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=draft)
    assert (refused.status_code, "Open the key first" in refused.json()["hint"]) == (409, True)
    open_key(client, study_world.visit)
    assert client.post(f"/api/v1/visits/{study_world.visit}/plan", json=draft).status_code == 201


def test_a_log_of_a_sealed_plan_that_is_uploaded_to_another_visit_tells_nothing_there(
    client: TestClient, db: Session, plan: Plan, study_world: Any
) -> None:
    bodies = [send(client, log_of(plan, i.position, 10 * i.position, number=i.position), visit="1") for i in plan.items[:2]]
    assert [p["session"]["controller"] for p in chain(*(b["proposals"] for b in bodies))] == [None, None]
    assert {p["session"]["visit_id"] for p in chain(*(b["proposals"] for b in bodies))} == {study_world.visit}, "whatever the sender says"
    assert "visit 1, which the upload says, is not taken" in str(bodies[0]["report"])
    proposal = bodies[0]["proposals"][0]
    path, asked = f"/api/v1/proposals/{proposal['session']['id']}", {"version": proposal["version"], "reason": "x"}
    refused = client.patch(path, json=asked | {"visit": 1})
    assert (refused.status_code, "stays at its visit" in refused.json()["detail"]) == (409, True), refused.text
    assert client.patch(path, json=asked | {"visit": 2}).status_code == 200
    stated = send(client, log_of(plan, 3, 30, number=3), visit="2", controller="random")
    assert stated["proposals"], "whether the statement is right is not told: somebody confirms it into its slot"


def test_where_a_session_is_put_does_not_depend_on_the_controller_that_somebody_states(
    client: TestClient, coordinator: TestClient, plan: Plan, study_world: Any
) -> None:
    """A recording without a slot's number goes by order and clock, so that no answer says which letter is cDBS."""
    other = next(i for i in plan.items if i.controller != plan.items[0].controller)
    data = {"participant": "P1", "visit": "2", "started_at": f"{DAY}T09:00:00Z", "controller": other.controller}
    sent = coordinator.post("/api/v1/uploads", data=data, files={"file": ("1.csv", recording(1, controlled=False))})
    assert sent.status_code == 201, sent.text
    rows = coordinator.get(f"/api/v1/visits/{study_world.visit}/slots").json()["rows"]
    assert [r["position"] for r in rows if r["session_id"]] == [plan.items[0].position]


def test_the_seed_from_which_the_order_was_drawn_is_hidden_until_the_key_is_opened(
    client: TestClient, plan: Plan, study_world: Any
) -> None:
    def told() -> list[bool]:
        pdf = PdfReader(io.BytesIO(client.get(f"/api/v1/visits/{study_world.visit}/plan.pdf").content))
        trail = client.get(f"/audit?entity=plan&entity_id={plan.id}", headers=PAGE).text
        return [
            client.get(f"/api/v1/visits/{study_world.visit}/plan").json()["seed"] is not None,
            "seed 1" in client.get(f"/visits/{study_world.visit}/plan", headers=PAGE).text,
            "seed 1" in pdf.pages[0].extract_text(),
            bool(re.search(r"seed</span>\s*<ins>1</ins>", trail)),
        ]

    assert told() == [False] * 4
    open_key(client, study_world.visit)
    assert told() == [True] * 4


def test_the_devices_own_averages_of_a_sealed_visits_day_are_left_out(
    client: TestClient, db: Session, plan: Plan, study_world: Any
) -> None:
    sent = client.post("/api/v1/uploads", data={"participant": "P1"}, files={"file": ("report.json", report())})
    assert sent.status_code == 201, sent.text
    db.execute(text("update visit set date = '2026-02-02' where id = :id"), {"id": study_world.visit})
    db.commit()

    def hours() -> list[float]:
        (told,) = client.get("/api/v1/participants/P1/device-history").json()
        (trend,) = told["trends"]
        assert len(trend["amplitude_ma"]) == len(trend["power"]) == len(trend["unix_s"])
        page = client.get("/participants/P1/device-history", headers=PAGE).text
        assert f"left: {len(trend['unix_s'])} averages" in page
        return [(t - BEGIN.timestamp()) / 3600 for t in trend["unix_s"]]

    assert 0 < max(hours()) < 10, "from 14 hours before the day begins in UTC"
    open_key(client, study_world.visit)
    assert max(hours()) > 49
