"""Entries and measurements stay readable when they are taken back or replaced, and the service may not delete them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from psycopg.errors import InsufficientPrivilege, RestrictViolation
from sqlalchemy import select, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from app.ingest.proposals import service as proposals
from app.study.outcomes import service as outcomes
from app.study.outcomes import values as of_files
from app.tables.audit import AuditEvent
from app.tables.outcomes import GraspTest, TremorSeries
from app.tables.sessions import StudySession
from app.tables.visits import CdbsAmplitude, Dose
from tests.app.study.conftest import minutes

NewFile = Callable[[StudySession], int]
NO_MARKS = np.zeros(3, dtype=bool)


def last(db: Session, entity: str) -> tuple[str, str | None]:
    """Return what was done last to rows of a table, and why."""
    found = db.execute(
        select(AuditEvent.action, AuditEvent.reason).where(AuditEvent.entity == entity).order_by(AuditEvent.id.desc())
    ).first()
    assert found is not None
    return found[0], found[1]


@pytest.mark.parametrize("table", ["dose", "cdbs_amplitude", "tremor_series", "grasp_test", "qoc", "trace", "visit_lock", "participant"])
def test_the_service_may_not_delete_what_was_entered_or_measured(db: Session, table: str) -> None:
    with pytest.raises(DBAPIError) as refused:
        db.execute(text(f"delete from {table}"))
    assert isinstance(refused.value.orig, InsufficientPrivilege)


def test_a_confirmed_session_is_deleted_by_nobody(db: Session, owner_db: Session, study_session: StudySession) -> None:
    for session in (db, owner_db):
        with pytest.raises(DBAPIError, match="never changed or deleted") as refused:
            session.execute(text("delete from session"))
        assert isinstance(refused.value.orig, RestrictViolation)
        session.rollback()


def test_a_dose_that_was_taken_back_stays_and_may_be_entered_anew(client: TestClient, participant_code: str, db: Session) -> None:
    visit = client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 5, "date": "2026-03-02"}).json()["id"]
    dose = {"drug": "levodopa", "mg": 100, "taken_at": "2026-03-02T07:00:00Z"}
    number = client.post(f"/api/v1/visits/{visit}/doses", json=dose).json()["id"]
    assert client.post(f"/api/v1/doses/{number}/removal", json={"reason": "it was 50 mg"}).status_code == 204
    assert client.post(f"/api/v1/doses/{number}/removal", json={"reason": "again"}).status_code == 404
    assert client.post(f"/api/v1/visits/{visit}/doses", json=dose | {"mg": 50}).status_code == 201
    rows = db.execute(select(Dose.mg, Dose.removed_at.is_not(None)).order_by(Dose.id)).all()
    assert [tuple(row) for row in rows] == [(100, True), (50, False)]
    assert [row["mg"] for row in client.get(f"/api/v1/visits/{visit}/doses").json()] == [50]
    reasons = db.scalars(select(AuditEvent.reason).where(AuditEvent.entity == "dose", AuditEvent.action == "update")).all()
    assert reasons == ["it was 50 mg"]
    assert "took back a dose of levodopa" in client.get("/audit?entity=dose").text
    removal = client.post(f"/api/v1/visits/{visit}/removal", json={"reason": "x"})
    assert (removal.status_code, "doses of medication" in removal.text) == (409, True)


def test_an_amplitude_that_is_stated_no_more_stays_and_outlasts_its_visit(client: TestClient, participant_code: str, db: Session) -> None:
    def stated(*sides: tuple[str, float]) -> list[dict[str, Any]]:
        return [{"hemisphere": side, "amplitude_ma": ma} for side, ma in sides]

    first = {"number": 6, "cdbs_amplitudes": stated(("left", 2.5), ("right", 3.0))}
    visit = client.post(f"/api/v1/participants/{participant_code}/visits", json=first).json()["id"]
    path = f"/api/v1/visits/{visit}"
    assert client.patch(path, json={"cdbs_amplitudes": stated(("left", 2.5)), "reason": "the left side alone"}).status_code == 200
    assert [a["hemisphere"] for a in client.get(path).json()["cdbs_amplitudes"]] == ["left"]
    again = client.patch(path, json={"cdbs_amplitudes": stated(("left", 2.5), ("right", 2.8)), "reason": "both"}).json()
    assert [(a["hemisphere"], a["amplitude_ma"]) for a in again["cdbs_amplitudes"]] == [("left", 2.5), ("right", 2.8)]
    assert client.post(f"{path}/removal", json={"reason": "put off for good"}).status_code in (200, 204)
    rows = db.execute(
        select(CdbsAmplitude.amplitude_ma, CdbsAmplitude.visit_id, CdbsAmplitude.removed_at.is_not(None)).order_by("id")
    ).all()
    assert [tuple(row) for row in rows] == [(2.5, None, True), (3.0, None, True), (2.8, None, True)]
    assert last(db, "visit") == ("delete", "put off for good")


def tremor(db: Session, session: StudySession, file: int, shares: Sequence[dict[str, float]]) -> list[str]:
    return outcomes.store_tremor(db, session.visit.participant_id, file, *minutes(shares))


def test_minutes_that_a_newer_reading_replaced_stay_as_they_were(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    file = new_file(study_session)
    tremor(db, study_session, file, [{"mild": 0.5}] * 10)
    (before,) = db.scalars(select(TremorSeries)).all()
    held = before.fractions_f32
    tremor(db, study_session, file, [{"mild": 0.5}] * 10)
    assert len(db.scalars(select(TremorSeries)).all()) == 1, "the same minutes are no newer row"
    tremor(db, study_session, file, [{"mild": 0.9}] * 10)
    assert study_session.qoc is not None
    assert study_session.qoc.tremor_percent == pytest.approx(90)
    tremor(db, study_session, file, [])
    assert of_files.tremor_series_of_file(db, study_session.visit.participant_id, file) is None
    db.expire_all()
    rows = db.scalars(select(TremorSeries).order_by(TremorSeries.id)).all()
    assert [row.removed_at is not None for row in rows] == [True, True]
    assert (rows[0].fractions_f32, rows[1].fractions_f32 != held) == (held, True)


def test_grasp_tests_that_were_replaced_or_moved_stay_as_they_were(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    file = new_file(study_session)
    outcomes.store_grasp(db, study_session, file, "right", np.arange(4) / 2.0, NO_MARKS)
    outcomes.store_grasp(db, study_session, file, "right", np.arange(4) / 2.0, NO_MARKS)
    outcomes.store_grasp(db, study_session, file, "right", np.arange(4) / 4.0, NO_MARKS)
    other = StudySession(visit_id=study_session.visit_id, ordinal=2, status="proposed", duration_s=600.0)
    db.add(other)
    db.flush()
    outcomes.store_grasp(db, other, file, "right", np.arange(4) / 4.0, NO_MARKS)
    db.expire_all()
    rows = db.scalars(select(GraspTest).order_by(GraspTest.id)).all()
    assert [(row.session_id == other.id, row.removed_at is not None) for row in rows] == [(False, True), (False, True), (True, False)]
    assert [np.frombuffer(row.open_fist_s_f64, "<f8")[1] for row in rows] == [0.5, 0.25, 0.25]
    assert of_files.grasp_tests(db, study_session.id) == []


def test_grasp_tests_outlast_a_proposal_that_was_given_up(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    other = StudySession(visit_id=study_session.visit_id, ordinal=2, status="proposed", duration_s=600.0)
    db.add(other)
    db.flush()
    outcomes.store_grasp(db, other, new_file(study_session), "right", np.arange(4) / 2.0, NO_MARKS)
    proposals._delete(db, other)
    db.expire_all()
    (row,) = db.scalars(select(GraspTest)).all()
    assert (row.session_id, row.removed_at is not None, row.n) == (None, True, 4)
    assert last(db, "session")[0] == "delete"
