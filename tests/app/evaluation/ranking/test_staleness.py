"""Staleness is a matter of pins: rows are compared, no trace and no buffer is read, and what is taken back leaves nothing stale."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation import repository, wording
from app.evaluation.ranking.staleness import stale_reasons
from app.learning.gate import decide
from app.platform.numbers import counted
from app.study.repository import participant_by_code, sessions_of_participant
from app.tables.learning import GateChoice
from app.tables.participants import Hemisphere
from app.tables.recordings import Trace
from app.tables.sessions import SessionConditions, StudySession
from app.tables.visits import CdbsAmplitude, Dose, Drug
from tests.app.evaluations import estimate

Upload = Callable[..., int]


def stale(db: Session) -> list[str]:
    db.rollback()
    participant = participant_by_code(db, "P1", SYSTEM)
    evaluation = repository.newest_evaluation(db, participant.id)
    assert evaluation is not None
    return [wording.sentence(reason) for reason in stale_reasons(db, participant, evaluation)]


@pytest.fixture
def evaluated(policies: list[int], evaluate: Callable[..., int]) -> int:
    return evaluate({i: estimate("dlsm", 50.0) for i in policies})


def test_no_trace_is_read_to_see_whether_a_ranking_is_stale(
    client: TestClient, evaluated: int, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []

    def values(trace: Trace) -> None:
        read.append(trace.recording_id)
        raise AssertionError("a trace was read")

    monkeypatch.setattr("app.study.traces.unpack", values)
    monkeypatch.setattr("app.learning.snapshots.collect", lambda *_: pytest.fail("the buffer was built again"))
    assert stale(db) == []
    assert read == []


def test_the_ranking_reads_only_sessions_whose_results_it_shows(
    client: TestClient, evaluated: int, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    from app.study import traces

    read: set[int] = set()
    unpack = traces.unpack
    monkeypatch.setattr(traces, "unpack", lambda trace: read.add(trace.recording_id) or unpack(trace))
    assert client.get("/api/v1/participants/P1/ranking").json()["stale"] is False
    sessions = sessions_of_participant(db, participant_by_code(db, "P1", SYSTEM).id)
    assert len(sessions) == 4
    assert read == {g.recording_id for s in sessions if s._controller == "cdbs" for g in s.segments}


def test_corrected_steps_make_it_stale_and_taking_the_correction_back_does_not(evaluated: int, db: Session) -> None:
    session = sessions_of_participant(db, participant_by_code(db, "P1", SYSTEM).id)[0]
    number, seconds, segment = session.id, session.duration_s, session.segments[0]
    start = segment.start_s
    session.duration_s = seconds - 20
    segment.start_s = start + 4
    db.commit()
    assert stale(db) == ["1 session whose times, control channel, controller or stop were corrected"]
    again = db.get_one(StudySession, number)
    again.duration_s, again.segments[0].start_s = seconds, start
    db.commit()
    assert stale(db) == []


def test_an_exclusion_that_is_taken_back_leaves_nothing_stale(client: TestClient, evaluated: int, db: Session) -> None:
    client.patch("/api/v1/sessions/1", json={"excluded_reason": "tablet froze"})
    assert stale(db) == ["1 session newly left out"]
    client.patch("/api/v1/sessions/1", json={"excluded_reason": None})
    assert stale(db) == []


def test_a_session_that_is_marked_as_stopped_makes_it_stale(client: TestClient, evaluated: int, db: Session) -> None:
    client.patch("/api/v1/sessions/1", json={"stopped_reason": "dyskinesia"})
    assert stale(db) == ["1 session whose times, control channel, controller or stop were corrected"]
    client.patch("/api/v1/sessions/1", json={"stopped_reason": None})
    assert stale(db) == []


def test_a_gate_that_opens_lets_sessions_in_and_one_that_shuts_leaves_them_out(
    client: TestClient, upload: Upload, policies: list[int], evaluate: Callable[..., int], db: Session
) -> None:
    upload("rl", policy=policies[0])
    evaluate({i: estimate("dlsm", 50.0) for i in policies})
    assert stale(db) == []
    decide(db, participant_by_code(db, "P1", SYSTEM), GateChoice.OPEN, "reviewed by hand", SYSTEM)
    db.commit()
    assert stale(db) == ["1 session newly included"]
    evaluate({i: estimate("dlsm", 50.0) for i in policies})
    assert stale(db) == []
    decide(db, participant_by_code(db, "P1", SYSTEM), GateChoice.SHUT, "an adverse event", SYSTEM)
    db.commit()
    assert stale(db) == ["1 session newly left out"]


def decoded_again(db: Session, session: StudySession) -> None:
    for old in list(session.segments[0].recording.traces):
        db.expunge(old)
        columns = {c.name: getattr(old, c.name) for c in Trace.__table__.columns if c.name != "id"}
        db.add(Trace(**columns | {"decode_version": old.decode_version + 1}))


def stated_anew(db: Session, session: StudySession) -> None:
    old = session.conditions
    assert old is not None
    columns = {c.name: getattr(old, c.name) for c in SessionConditions.__table__.columns if c.name not in ("id", "created_at")}
    db.add(SessionConditions(**columns | {"revision": old.revision + 1}))


def amplitude_stated(db: Session, session: StudySession) -> None:
    db.add(CdbsAmplitude(visit_id=session.visit_id, hemisphere=Hemisphere.LEFT, program=0, amplitude_ma=2.2))


def renumbered(_: Session, session: StudySession) -> None:
    session.visit.number = 9


def another_controller(_: Session, session: StudySession) -> None:
    session._controller = "other"


def another_channel(_: Session, session: StudySession) -> None:
    session.control_channel = "no such channel"


def medicated(db: Session, session: StudySession) -> None:
    taken = (session.started_at or datetime(2026, 1, 1, 8, tzinfo=UTC)) - timedelta(hours=1)
    db.add(Dose(visit_id=session.visit_id, drug=Drug.LEVODOPA, mg=100, taken_at=taken, entered_by="test"))


def proposed_again(_: Session, session: StudySession) -> None:
    session.status = "proposed"


@pytest.mark.parametrize(
    "change",
    [decoded_again, stated_anew, amplitude_stated, renumbered, another_controller, another_channel, medicated, proposed_again],
)
def test_a_reading_that_was_kept_gives_way_to_every_kind_of_change(
    change: Callable[[Session, StudySession], None], evaluated: int, db: Session
) -> None:
    """With QoCs, exclusions, stops, settings, policies, new sessions and the gate (`test_ranking`, above) all that `_changes` reads."""
    assert stale(db) == []
    assert stale(db) == []  # the second reading is the kept one
    change(db, sessions_of_participant(db, participant_by_code(db, "P1", SYSTEM).id)[0])
    db.commit()
    assert stale(db) != [], change.__name__


def test_doses_of_a_visit_change_what_is_adjusted_for_and_make_it_stale_but_where_a_person_has_stated_the_time(
    evaluated: int, db: Session
) -> None:
    first, *others = sessions_of_participant(db, participant_by_code(db, "P1", SYSTEM).id)
    together = [s for s in (first, *others) if s.visit_id == first.visit_id and s.medication_h is None]
    medicated(db, first)
    db.commit()
    assert stale(db) == [f"{counted(len(together), 'session')} with other doses of medication at their visit"]


def test_what_a_transaction_read_before_a_change_does_not_hide_it(client: TestClient, evaluated: int, db: Session) -> None:
    participant = participant_by_code(db, "P1", SYSTEM)
    evaluation = repository.newest_evaluation(db, participant.id)
    assert evaluation is not None
    read = sessions_of_participant(db, participant.id)  # a page reads sessions, and meanwhile another user excludes one
    assert not any(s.excluded_reason for s in read)
    client.patch("/api/v1/sessions/1", json={"excluded_reason": "tablet froze"})
    here = [wording.sentence(reason) for reason in stale_reasons(db, participant, evaluation)]
    assert here == ["1 session newly left out"]
    assert stale(db) == ["1 session newly left out"]


def test_a_policy_that_is_retired_is_no_candidate_any_more_and_taken_back_it_is(
    client: TestClient, policies: list[int], evaluate: Callable[..., int], db: Session
) -> None:
    """Verdicts, margins and retirement are read live: nothing is to be evaluated again for them."""
    evaluate({i: estimate("dlsm", 50.0) for i in policies[:2]})
    assert stale(db) == ["1 policy not in it: p2"]
    client.patch(f"/api/v1/policies/{policies[2]}", json={"retired_reason": "unstable"})
    assert stale(db) == []
    client.patch(f"/api/v1/policies/{policies[0]}", json={"retired_reason": "an adverse event"})
    ranked = client.get("/api/v1/participants/P1/ranking").json()["policies"]
    assert {p["policy_id"]: p["retired"] for p in ranked} == {policies[0]: True, policies[1]: False}
    client.patch(f"/api/v1/policies/{policies[2]}", json={"retired_reason": None})
    assert stale(db) == ["1 policy not in it: p2"]
