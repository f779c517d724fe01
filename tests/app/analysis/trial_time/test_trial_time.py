"""The table of trial time: minutes per controller and participant."""

from __future__ import annotations

import pytest
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.analysis.pooled import pooled, trial_time
from app.study import repository as study
from app.tables.sessions import Controller
from tests.app.analysis.conftest import AddSession


def test_minutes_are_those_of_the_sessions_and_excluded_ones_are_counted_apart(upload, client, participant_code, db):
    for controller, steps in (("random", 300), ("cdbs", 300), ("cdbs", 150), ("no_dbs", 150)):
        upload(controller, steps=steps, level=0.0 if controller == "no_dbs" else 1.0)
    bad = upload("cdbs", steps=60)
    answer = client.patch(f"/api/v1/sessions/{bad}", json={"excluded_reason": "the lead moved", "reason": "seen on the trace"})
    assert answer.status_code == 200, answer.text
    table = trial_time(db, [study.participant_by_code(db, participant_code, SYSTEM)], SYSTEM)
    (row,) = table.rows
    found = {t.controller: (t.sessions, t.minutes) for t in row.tested}
    assert found == {
        Controller.CDBS: (2, pytest.approx(15)),
        Controller.RL: (0, 0),
        Controller.DISTILLED: (0, 0),
        Controller.NO_DBS: (1, pytest.approx(5)),
        Controller.RANDOM: (1, pytest.approx(10)),
    }
    assert row.excluded == 1
    assert [(t.sessions, t.minutes) for t in table.totals] == list(found.values())
    assert table.labels[:4] == ["cDBS", "RL", "Distilled RL", "No DBS"]


def test_the_evidence_at_hand_gives_the_same_table(add_session: AddSession, db: Session, participant_code: str) -> None:
    add_session("cdbs")
    add_session("rl", duration_s=600.0, visit=2)
    add_session("random", excluded="the lead moved")
    add_session("other", status="proposed", excluded="sent twice")
    add_session("no_dbs", beta=None, fraction=None, duration_s=1e9)  # longer than can be laid out: not readable, but it ran
    db.rollback()
    people = [study.participant_by_code(db, participant_code, SYSTEM)]
    table = trial_time(db, people, SYSTEM)
    assert pooled(db, people, SYSTEM).trial == table
    assert [t.sessions for t in table.totals] == [1, 1, 0, 1]
    assert table.rows[0].excluded == 1


def test_the_page_shows_minutes_and_n_for_every_participant(upload, client, participant_code):
    upload("cdbs", steps=300)
    page = client.get("/trial-time")
    assert page.status_code == 200
    assert "10<span" in page.text
    assert "(1)" in page.text
