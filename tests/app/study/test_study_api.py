"""Participants, visits, settings and QoCs over REST."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.tables.audit import AuditEvent


def test_a_new_participant_gets_the_papers_constants(client: TestClient) -> None:
    answer = client.post("/api/v1/participants", json={"code": "P1"})
    assert answer.status_code == 201
    settings = answer.json()["settings"]
    assert (settings["window"], settings["period_s"], settings["r_a"], settings["r_b"], settings["c1"]) == (10, 2, 0, -1, 0.3)
    assert (settings["c2"], settings["c3"], settings["c4"], settings["xi_beta"], settings["version"]) == (10, 10, 10, None, 1)


def test_a_change_of_settings_makes_a_version_and_keeps_the_rest(client: TestClient, participant_code: str) -> None:
    changed = client.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": {"gamma": 0.9}, "reason": "shorter sight"})
    assert changed.status_code == 200
    assert (changed.json()["version"], changed.json()["gamma"], changed.json()["xi_beta"]) == (2, 0.9, 1.0)
    versions = client.get(f"/api/v1/participants/{participant_code}/settings").json()
    assert [v["gamma"] for v in versions] == [0.99, 0.9]


def test_the_same_settings_again_make_no_version(client: TestClient, participant_code: str) -> None:
    again = client.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": {"gamma": 0.99}})
    assert again.json()["version"] == 1


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"c2": -1}, "c2"),
        ({"gamma": 1}, "gamma"),
        ({"window": "10"}, "window"),
        ({"tremor_as_fraction": "yes"}, "tremor_as_fraction"),
        ({"beta_low_hz": 40}, "beta_low_hz"),
        ({"r_a": -2}, "r_a"),
        ({"surprise": 1}, "surprise"),
    ],
)
def test_bad_settings_are_refused_by_name(client: TestClient, settings: dict[str, object], named: str) -> None:
    answer = client.post("/api/v1/participants", json={"code": "P9", "settings": settings})
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert named in answer.text
    assert client.get("/api/v1/participants/P9").status_code == 404


def test_codes_and_visit_numbers_are_unique(client: TestClient, participant_code: str) -> None:
    assert client.post("/api/v1/participants", json={"code": participant_code}).status_code == 409
    assert client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 1}).status_code == 409


def test_lists_are_paged(client: TestClient, participant_code: str) -> None:
    for number in range(2, 6):
        client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": number})
    page = client.get(f"/api/v1/participants/{participant_code}/visits", params={"limit": 2, "offset": 3}).json()
    assert [v["number"] for v in page["items"]] == [4, 5]
    assert (page["total"], page["limit"], page["offset"]) == (5, 2, 3)


def test_a_viewer_reads_and_does_not_write(client: TestClient, client_as, participant_code: str) -> None:  # type: ignore[no-untyped-def]
    viewer = client_as("viewer")
    assert viewer.get(f"/api/v1/participants/{participant_code}").status_code == 200
    assert viewer.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 7}).status_code == 403


def test_nothing_is_told_without_a_token(service_app) -> None:  # type: ignore[no-untyped-def]
    bare = TestClient(service_app)
    assert bare.get("/api/v1/participants").status_code == 401
    assert bare.get("/healthz").json()["status"] == "ok"


def test_every_write_leaves_an_audit_row_that_cannot_be_changed(client: TestClient, participant_code: str, db: Session) -> None:
    rows = db.scalars(select(AuditEvent).where(AuditEvent.entity == "visit")).all()
    assert [(r.action, r.actor) for r in rows] == [("insert", "admin@clinic.example")]
    assert rows[0].after is not None
    assert rows[0].after["number"] == 1
    for statement in ("update audit_event set actor = 'nobody'", "delete from audit_event", "truncate audit_event"):
        with pytest.raises(DBAPIError, match=r"never changed|permission denied"):
            db.execute(text(statement))
        db.rollback()


@pytest.mark.parametrize(
    ("column", "value"),
    [("rating", 0), ("rating", 11), ("tremor_percent", 100.5), ("tremor_percent", -1), ("grasp_hz", -0.1)],
)
def test_the_database_itself_refuses_impossible_qocs(db: Session, column: str, value: float) -> None:
    db.execute(text("insert into participant (site_id, code) select id, 'X' from site"))
    db.execute(text("insert into visit (participant_id, number) select id, 1 from participant"))
    db.execute(text("insert into session (visit_id, ordinal, controller, duration_s) select id, 1, 'cdbs', 600 from visit"))
    with pytest.raises(DBAPIError, match="ck_qoc"):
        db.execute(text(f"insert into qoc (session_id, revision, entered_by, {column}) select id, 1, 'x', {value} from session"))


def test_codes_that_differ_by_case_only_are_the_same(client: TestClient, participant_code: str) -> None:
    assert client.post("/api/v1/participants", json={"code": participant_code.lower()}).status_code == 409


def test_a_session_takes_only_its_own_participants_policy_and_its_own_traces(client: TestClient, participant_code: str) -> None:
    table = b"t_s,beta,amplitude_fraction\n0,1,1\n2,1,1\n"
    data = {"participant": participant_code, "visit": "1", "controller": "other"}
    session = client.post("/api/v1/uploads", data=data, files={"file": ("s.csv", table)}).json()["sessions"][0]["id"]
    foreign = client.patch(f"/api/v1/sessions/{session}", json={"controller": "rl", "policy_id": 12345})
    assert foreign.status_code == 422
    assert "no policy 12345" in foreign.json()["detail"]
    nowhere = client.patch(f"/api/v1/sessions/{session}", json={"control_channel": "nope"})
    assert nowhere.status_code == 422
    assert "beta" in nowhere.json()["hint"]
    assert client.get(f"/api/v1/sessions/{session}").json()["controller"] == "other"


def test_a_unit_has_one_spelling(client: TestClient) -> None:
    settings = client.post("/api/v1/participants", json={"code": "U1", "settings": {"beta_unit": "µV²"}}).json()["settings"]
    assert settings["beta_unit"] == "uV2"


def test_a_controller_without_a_policy_takes_none(client: TestClient, participant_code: str) -> None:
    table = b"t_s,beta,amplitude_fraction\n0,1,1\n2,1,1\n"
    data = {"participant": participant_code, "visit": "1", "controller": "cdbs"}
    session = client.post("/api/v1/uploads", data=data, files={"file": ("s.csv", table)}).json()["sessions"][0]["id"]
    refused = client.patch(f"/api/v1/sessions/{session}", json={"policy_id": 1})
    assert refused.status_code == 422
    assert "A cdbs session has no policy" in refused.json()["detail"]


@pytest.mark.parametrize("day", ["0001-01-01", "0226-03-02", "1989-12-31", "2201-01-01", "9999-12-31"])
def test_a_mistyped_year_of_a_visit_is_refused(client: TestClient, participant_code: str, day: str) -> None:
    made = client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": day})
    assert made.status_code == 422
    assert "the year must lie between 1990 and 2200" in made.json()["detail"]
    visit = client.get("/api/v1/participants/P1/visits").json()["items"][0]["id"]
    assert client.patch(f"/api/v1/visits/{visit}", json={"date": day, "reason": "typed"}).status_code == 422
    typed = {"number": "2", "date": day, "note": ""}
    page = client.post("/participants/P1/visits", data=typed, headers={"accept": "text/html"})
    assert page.status_code == 422
    assert "between 1990 and 2200" in page.text
