"""Doses with their times, and the time since the last one, which is computed in one place and carried everywhere."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.platform import files
from app.platform.database import new_session
from app.study import doses
from app.study.doses import DRUGS, DoseIn, disagreement_h, levodopa_equivalent_mg, since_last_dose
from app.study.schemas import SessionChange
from app.study.sessions import changes
from app.study.sessions.contradictions import Kind, contradictions
from app.tables.learning import BufferSnapshot
from app.tables.sessions import StudySession
from app.tables.visits import Drug
from ml.trajectories import from_parquet
from tests.app.study.conftest import START
from tests.conftest import PASSWORD

Upload = Callable[..., int]


def take(db: Session, session: StudySession, drug: Drug, hours_before: float, mg: float = 100.0) -> None:
    draft = DoseIn(drug=drug, mg=mg, taken_at=START - timedelta(hours=hours_before))
    doses.add_dose(db, session.visit, draft, SYSTEM)


def test_the_newest_dose_before_the_start_counts(db: Session, study_session: StudySession) -> None:
    assert since_last_dose(study_session) is None
    take(db, study_session, Drug.LEVODOPA, 5.0)
    take(db, study_session, Drug.LEVODOPA, 2.0)
    take(db, study_session, Drug.LEVODOPA, -1.0)  # after the start
    assert since_last_dose(study_session) == (pytest.approx(2.0), "doses")


def test_a_drug_whose_effect_does_not_come_and_go_within_hours_starts_no_clock(db: Session, study_session: StudySession) -> None:
    take(db, study_session, Drug.PRAMIPEXOLE, 4.0, 0.125)
    for drug in (Drug.SELEGILINE, Drug.MUSCLE_RELAXANT):
        take(db, study_session, drug, 1.0, 5.0)
    assert since_last_dose(study_session) == (pytest.approx(4.0), "doses")


def test_what_a_person_stated_of_the_session_counts_and_is_questioned_where_the_doses_differ(
    db: Session, study_session: StudySession
) -> None:
    take(db, study_session, Drug.LEVODOPA, 2.0)
    changes.change_session(db, study_session, SessionChange(medication_h=2.2, reason="diary"), SYSTEM)
    assert since_last_dose(study_session) == (2.2, "stated")
    assert disagreement_h(study_session) is None
    changes.change_session(db, study_session, SessionChange(medication_h=0.5, reason="diary"), SYSTEM)
    (asked,) = [c for c in contradictions(db, study_session) if c.kind is Kind.LAST_DOSE]
    assert asked.facts == {"stated": 0.5, "by_doses": pytest.approx(2.0)}


def test_levodopa_equivalents_are_those_of_tomlinson_2010() -> None:
    published = {
        Drug.LEVODOPA: 1.0,
        Drug.LEVODOPA_CR: 0.75,
        Drug.LEVODOPA_COMT: 1.33,  # entacapone adds a third
        Drug.LEVODOPA_EQUIVALENT: 1.0,
        Drug.APOMORPHINE: 10.0,
        Drug.PRAMIPEXOLE: 100.0,
        Drug.ROPINIROLE: 20.0,
        Drug.ROTIGOTINE: 30.0,
        Drug.SELEGILINE: 10.0,
        Drug.RASAGILINE: 100.0,
        Drug.AMANTADINE: 1.0,
    }
    assert {d: levodopa_equivalent_mg(d, 1.0) for d in Drug} == dict.fromkeys(Drug) | published
    assert set(DRUGS) == set(Drug)
    for drug, form in ((Drug.PRAMIPEXOLE, "immediate release"), (Drug.ROPINIROLE, "immediate release"), (Drug.SELEGILINE, "swallowed")):
        assert form in DRUGS[drug].name, "other forms have other factors, or no time since a dose"


def test_doses_are_entered_refused_and_taken_back(client: TestClient, participant_code: str) -> None:
    visit = client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 5, "date": "2026-03-02"}).json()["id"]
    api = f"/api/v1/visits/{visit}/doses"
    dose = {"drug": "levodopa", "mg": 100, "taken_at": "2026-03-02T07:00:00+02:00"}
    made = client.post(api, json=dose).json()
    assert (made["taken_at"], made["levodopa_equivalent_mg"], made["counts_for_time"]) == ("2026-03-02T05:00:00Z", 100.0, True)
    assert client.post(api, json=dose).status_code == 409
    for taken_at in ("2026-03-05T07:00:00Z", "2026-03-03T12:30:00Z"):  # the latter is the next day in every time zone
        assert "not near visit 5" in client.post(api, json=dose | {"taken_at": taken_at}).json()["detail"]
    tomorrow = (datetime.now(UTC) + timedelta(days=1)).isoformat()
    assert "has not come yet" in client.post(api, json=dose | {"taken_at": tomorrow}).json()["detail"]
    client.post(f"/api/v1/visits/{visit}/lock", json={"reason": "complete", "password": PASSWORD})
    assert client.post(f"/api/v1/doses/{made['id']}/removal", json={"reason": "not taken"}).status_code == 409
    client.post(f"/api/v1/visits/{visit}/unlock", json={"reason": "misread"})
    client.patch(f"/api/v1/participants/{participant_code}", json={"status": "withdrawn", "reason": "asked"})
    assert client.post(api, json=dose | {"mg": 50, "taken_at": "2026-03-02T08:00:00Z"}).status_code == 409
    assert "Write down a dose" not in client.get(f"/visits/{visit}").text
    assert client.post(f"/api/v1/doses/{made['id']}/removal", json={"reason": "not taken"}).status_code == 204
    assert client.get(api).json() == []


def test_analyses_that_were_looked_at_follow_a_dose_that_is_entered_and_one_that_is_taken_back(client: TestClient, upload: Upload) -> None:
    session = upload("cdbs", started_at="2026-03-02T09:00:00Z")
    visit = client.get(f"/api/v1/sessions/{session}").json()["visit_id"]

    def timed() -> list[int]:
        pairs = client.get("/api/v1/participants/P1/analyses/beta").json()["medication"]
        return list(next(p for p in pairs if p["y"] == "grasp")["session_ids"])

    assert timed() == []
    dose = {"drug": "levodopa", "mg": 100, "taken_at": "2026-03-02T07:30:00Z"}
    number = client.post(f"/api/v1/visits/{visit}/doses", json=dose).json()["id"]
    assert timed() == [session]
    assert client.post(f"/api/v1/doses/{number}/removal", json={"reason": "not taken"}).status_code == 204
    assert timed() == []


def test_the_visit_page_the_snapshot_and_the_package_carry_them(client: TestClient, participant_code: str, upload: Upload) -> None:
    settings = {"xi_beta": 1.0, "beta_unit": "uV", "beta_source": "table"}
    client.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": settings})
    session = upload("random", steps=40, started_at="2026-03-02T09:00:00Z")
    visit = client.get(f"/api/v1/sessions/{session}").json()["visit_id"]
    bare = client.post(f"/api/v1/participants/{participant_code}/snapshots").json()
    form = {"drug": "levodopa", "mg": "100", "taken_at": "2026-03-02T07:30"}
    assert client.post(f"/visits/{visit}/doses", data=form, follow_redirects=False).status_code == 303
    assert client.post(f"/visits/{visit}/doses", data=form | {"mg": "a lot"}).status_code == 422
    assert "Levodopa (carbidopa, benserazide)" in client.get(f"/visits/{visit}").text
    assert client.get(f"/api/v1/sessions/{session}").json()["hours_since_dose"] == pytest.approx(1.5)
    stated = {"version": 0, "characteristics": {"hand": "left"}, "reason": "asked"}
    assert client.put(f"/api/v1/participants/{participant_code}/characteristics", json=stated).status_code == 200
    snapshot = client.post(f"/api/v1/participants/{participant_code}/snapshots").json()
    assert snapshot["id"] != bare["id"]
    assert (bare["characteristics_version"], snapshot["characteristics_version"]) == (None, 1)
    assert [m["hours_since_dose"] for m in snapshot["members"]] == [pytest.approx(1.5)]
    with new_session() as db:
        stored = db.scalars(select(BufferSnapshot).order_by(BufferSnapshot.id)).all()
        assert [from_parquet(files.read(s.file_sha256)).sessions[0].medication_h for s in stored] == [None, pytest.approx(1.5)]
    package = zipfile.ZipFile(io.BytesIO(client.get(f"/participants/{participant_code}/export.zip").content))
    rows = {n: list(csv.DictReader(io.StringIO(package.read(f"{participant_code}/{n}.csv").decode()))) for n in ("sessions", "doses")}
    assert float(rows["sessions"][0]["hours_since_dose"]) == pytest.approx(1.5)
    assert [(d["drug"], d["levodopa_equivalent_mg"]) for d in rows["doses"]] == [("levodopa", "100.0")]
    assert b'"hand": "left"' in package.read(f"{participant_code}/characteristics.json")
