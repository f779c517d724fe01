"""The audit trail of a user who reads it in one of several studies: all of theirs, and nothing of others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, true
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.accounts.permissions import Caller, Grant
from app.overview.trail_rows import audit_events
from app.overview.trail_scope import TrailFilter, of_reader
from app.platform.audit import AUDITED
from app.tables.accounts import Membership, Role, Site, Study
from app.tables.audit import AuditEvent
from tests.conftest import PASSWORD

Upload = Callable[..., int]
NOT_OF_A_STUDY = {"app_user", "second_factor", "sign_in", "sign_on_link", "api_token", "stored_file"}


@pytest.fixture
def viewer(client_as: Callable[[str], TestClient]) -> TestClient:
    """A user who reads no trail, in the first study."""
    return client_as("viewer")


@pytest.fixture
def north(client: TestClient, viewer: TestClient, db: Session) -> Study:
    """A second study with two sites and a participant at each."""
    study = Study(code="north", name="North")
    db.add(study)
    db.flush()
    db.add_all([Site(study_id=study.id, code=code, name=code) for code in ("n1", "n2")])
    admin = db.scalars(select(Membership).where(Membership.role == Role.ADMIN)).first()
    assert admin is not None
    db.add(Membership(user_id=admin.user_id, study_id=study.id, role=Role.ADMIN))
    db.commit()
    for code, site in (("N1", "n1"), ("N2", "n2")):
        assert client.post("/api/v1/participants", json={"code": code, "site": site}).status_code == 201
        visit = client.post(f"/api/v1/participants/{code}/visits", json={"number": 1}).json()["id"]
        assert client.post(f"/api/v1/visits/{visit}/lock", json={"reason": f"seen {code}", "password": PASSWORD}).status_code == 200
        margins = {"version": 1, "reason": f"protocol {code}", "password": PASSWORD}
        assert client.post(f"/api/v1/participants/{code}/margins/locks", json=margins).status_code == 201
        assert client.get(f"/participants/{code}/export.zip").status_code == 200
        assert client.get(f"/api/v1/participants/{code}/analyses").status_code == 200
    return study


def reader(db: Session, study: str, name: str, site: int | None = None) -> str:
    user = accounts.add_user(db, f"{name}@clinic.example", Role.MONITOR, PASSWORD, study_code=study)
    user.memberships[0].site_id = site
    db.flush()
    token = accounts.create_token(db, user.email, "trail")
    db.commit()
    return token


def seen(db: Session, caller: Caller) -> list[AuditEvent]:
    return list(audit_events(db, of_reader(caller), TrailFilter(), 10_000, 0)[0])


def test_every_row_of_ones_own_study_is_shown_and_none_of_another(client: TestClient, upload: Upload, north: Study, db: Session) -> None:
    session = upload("cdbs")
    client.put(f"/api/v1/sessions/{session}/qoc", json={"rating": 7})
    main = db.scalars(select(Study).where(Study.code == "main")).one()
    whole, _ = audit_events(db, true(), TrailFilter(), 10_000, 0)
    of = {s.code: seen(db, Caller("x", 1, (Grant(s.id, None, Role.MONITOR),))) for s in (main, north)}
    numbers = {code: {e.id for e in events} for code, events in of.items()}
    assert numbers["main"].isdisjoint(numbers["north"])
    rest = [e for e in whole if e.id not in numbers["main"] | numbers["north"]]
    assert {e.entity for e in rest if e.entity in AUDITED} <= NOT_OF_A_STUDY, "every row of a study is somebody's"
    for code, own, other in (("main", "P1", ("N1", "N2")), ("north", "N1", ("P1",))):
        words = repr([(e.entity, e.entity_id, e.before, e.after, e.reason) for e in of[code]])
        assert own in words
        assert not any(f"'{name}'" in words or f" {name}'" in words for name in other), code
    kinds = {e.entity for e in of["main"]}
    assert {"participant", "visit", "session", "qoc", "trace", "recording", "upload", "upload_file", "session_segment"} <= kinds
    acts = {(e.action, e.entity) for e in of["north"]}
    assert {("insert", "signature"), ("export", "participant"), ("view", "results"), ("insert", "site"), ("insert", "membership")} <= acts
    assert sum(e.entity == "signature" for e in of["north"]) == 4


def test_rows_of_a_visit_that_was_removed_stay_in_the_trail_of_its_study(client: TestClient, north: Study, db: Session) -> None:
    body = {"number": 9, "cdbs_amplitudes": [{"hemisphere": "left", "amplitude_ma": 2.5}]}
    visit = client.post("/api/v1/participants/N1/visits", json=body).json()["id"]
    assert client.post(f"/api/v1/visits/{visit}/removal", json={"reason": "entered twice"}).status_code in (200, 204)
    sites = {code: db.scalars(select(Site.id).where(Site.code == code)).one() for code in ("n1", "n2")}
    main = db.scalars(select(Study.id).where(Study.code == "main")).one()

    def amplitudes(study: int, site: int | None) -> list[str]:
        found = seen(db, Caller("x", 1, (Grant(study, site, Role.MONITOR),)))
        return [
            e.action
            for e in found
            if e.entity == "cdbs_amplitude" and visit in ((e.after or {}).get("visit_id"), (e.before or {}).get("visit_id"))
        ]

    whole = ["update", "update", "insert"]  # taken back, then without its visit
    assert amplitudes(north.id, None) == whole
    assert amplitudes(north.id, sites["n1"]) == whole
    assert amplitudes(north.id, sites["n2"]) == amplitudes(main, None) == []


def test_a_reader_at_one_site_sees_that_site(north: Study, db: Session) -> None:
    site = db.scalars(select(Site).where(Site.code == "n1")).one()
    found = seen(db, Caller("x", 1, (Grant(north.id, site.id, Role.MONITOR),)))
    words = repr([(e.entity_id, e.before, e.after, e.reason) for e in found])
    assert ("'N1'" in words, "'N2'" in words, "seen N2" in words) == (True, False, False)
    assert {e.entity for e in found}.isdisjoint({"study", "membership"} | NOT_OF_A_STUDY)


def test_who_reads_no_trail_anywhere_sees_nothing(north: Study, db: Session) -> None:
    assert seen(db, Caller("x", 1, (Grant(north.id, None, Role.VIEWER),))) == []
    assert seen(db, Caller("x", 1, ())) == []


def test_the_page_shows_it_and_says_that_it_is_a_part(
    service_app: Any, client: TestClient, viewer: TestClient, north: Study, db: Session
) -> None:
    calling = {"Authorization": f"Bearer {reader(db, 'north', 'mona')}"}
    page = TestClient(service_app, headers=calling).get("/audit")
    assert (page.status_code, "seen N1" in page.text, "admin@clinic.example" in page.text) == (200, True, True)
    assert "of the studies and sites in which your role reads it" in page.text
    assert "Nothing matches" in TestClient(service_app, headers=calling).get("/audit?entity=app_user").text
    assert "of the studies and sites" not in client.get("/audit").text, "who reads it everywhere reads all of it"
    assert viewer.get("/audit").status_code == 403
