"""QoCs derived from uploaded minutes of tremor and grasp tests: right numbers, shown with what they rest on, and no person's value lost."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta

import numpy as np
import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.platform.errors import Invalid
from app.study import blinding
from app.study.outcomes import service as outcomes
from app.study.outcomes import values as outcome_values
from app.study.schemas import QocIn, SessionChange
from app.study.sessions import changes
from app.tables.audit import AuditEvent
from app.tables.outcomes import TremorSeries
from app.tables.participants import Hemisphere
from app.tables.sessions import Controller, StudySession
from tests.app.study.conftest import minutes

NewFile = Callable[[StudySession], int]
HALF_MILD = [{"mild": 0.5}] * 10


def store(db: Session, session: StudySession, file: int, *args: object, **more: float) -> list[str]:
    return outcomes.store_tremor(db, session.visit.participant_id, file, *minutes(*args, **more))  # type: ignore[arg-type]


def grasps(n: int, hz: float) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(n) / hz, np.zeros(max(0, n - 1), dtype=bool)


def test_tremor_is_the_share_of_the_session_with_mild_or_worse_tremor(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    shares = [{"mild": 0.3, "slight": 0.4}, {"moderate": 0.2, "unknown": 0.5}, {"strong": 1.0}, *[{}] * 7]
    said = store(db, study_session, new_file(study_session), shares)
    qoc = study_session.qoc
    assert qoc is not None
    assert qoc.tremor_percent == pytest.approx(100 * (0.3 + 0.2 + 1.0) / 10)
    assert qoc.derived == ["tremor_percent"]
    assert qoc.entered_by.startswith("derived from upload ")
    assert "duration-weighted, 10.0 of 10.0 min covered, 0.5 min unknown; by each minute's largest class 10 %" in (qoc.reason or "")
    assert any("tremor 15 % (duration-weighted" in s for s in said)


def test_minutes_at_the_edges_count_by_the_part_inside_the_session(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    store(db, study_session, new_file(study_session), [{"mild": 1.0}, *[{}] * 9, {"mild": 1.0}], first_min=-0.5)
    assert study_session.qoc is not None
    assert study_session.qoc.tremor_percent == pytest.approx(10.0)


def test_a_session_that_minutes_cover_too_little_gets_no_value_and_the_reason(
    db: Session, study_session: StudySession, new_file: NewFile
) -> None:
    said = store(db, study_session, new_file(study_session), [{"mild": 1.0}] * 8)
    assert study_session.qoc is None
    assert any("no tremor derived: 8.0 of 10.0 min covered; 90 % of the session are needed" in s for s in said)


def test_a_session_that_is_mostly_unknown_gets_no_value(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    said = store(db, study_session, new_file(study_session), [{"unknown": 0.9}] * 10)
    assert study_session.qoc is None
    assert any("9.0 min unknown; at most 50 % of the session may be" in s for s in said)


def test_minutes_that_tell_only_all_tremor_together_give_no_value(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    start, length, fractions, any_tremor = minutes([{"slight": 0.5}] * 10)
    fractions[:] = np.nan
    file = new_file(study_session)
    said = outcomes.store_tremor(db, study_session.visit.participant_id, file, start, length, fractions, any_tremor)
    assert study_session.qoc is None
    assert any("0.0 of 10.0 min covered, besides 10.0 min that tell only all tremor together" in s for s in said)


def test_the_same_file_twice_makes_one_revision(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    file = new_file(study_session)
    store(db, study_session, file, HALF_MILD)
    store(db, study_session, file, HALF_MILD)
    assert [q.tremor_percent for q in study_session.qocs] == [pytest.approx(50.0)]
    assert len(db.scalars(select(TremorSeries)).all()) == 1


def test_a_file_decoded_to_nothing_takes_its_value_back(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    file = new_file(study_session)
    store(db, study_session, file, HALF_MILD)
    nothing = np.empty(0), np.empty(0), np.empty((0, 6)), np.empty(0)
    outcomes.store_tremor(db, study_session.visit.participant_id, file, *nothing)
    assert study_session.qoc is not None
    assert study_session.qoc.tremor_percent is None


def test_minutes_of_two_files_count_once_as_the_newer_file_tells_them(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    store(db, study_session, new_file(study_session), [{"mild": 1.0}] * 10)
    said = store(db, study_session, new_file(study_session), [{"mild": 1.0}] * 5 + [{}] * 3)
    # the newer file speaks of eight minutes, the older one still of the last two
    assert study_session.qoc is not None
    assert study_session.qoc.tremor_percent == pytest.approx(70.0)
    assert "8 of these minutes came in other files too, 3 of them with other values" in said[1]
    assert "3 minutes of upload" in (study_session.qoc.reason or "")


def test_minutes_of_one_file_that_contradict_each_other_are_left_out(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    start, length, fractions, any_tremor = minutes([{"mild": 1.0}, *HALF_MILD])
    start[1] = start[0]  # two claims for the first minute, as a spreadsheet that rounds times makes them
    start[2:] -= 60
    file = new_file(study_session)
    outcomes.store_tremor(db, study_session.visit.participant_id, file, start, length, fractions, any_tremor)
    qoc = study_session.qoc
    assert qoc is not None
    assert qoc.tremor_percent == pytest.approx(45.0)
    assert "9.0 of 10.0 min covered" in (qoc.reason or "")
    assert "2 minutes of upload" in (qoc.reason or "")
    assert "left out: the same time is told twice, in different ways" in (qoc.reason or "")


def test_a_typed_value_stays_and_both_numbers_are_told(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    changes.record_qoc(db, study_session, QocIn(tremor_percent=12.0, rating=7), SYSTEM)
    said = store(db, study_session, new_file(study_session), HALF_MILD)
    qoc = study_session.qoc
    assert qoc is not None
    assert (qoc.revision, qoc.tremor_percent) == (1, 12.0)
    assert any("entered 12 % for tremor, which stays; the files give tremor 50 %" in s for s in said)
    [clash] = outcomes.disagreements(study_session, outcome_values.derive(db, study_session))
    assert (clash.typed, clash.derived.value, clash.author) == (12.0, pytest.approx(50.0), SYSTEM.label)


def test_a_value_that_a_person_took_back_is_not_derived_again(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    file = new_file(study_session)
    store(db, study_session, file, HALF_MILD)
    changes.record_qoc(db, study_session, QocIn(tremor_percent=None, reason="watch on the wrong arm"), SYSTEM)
    store(db, study_session, file, HALF_MILD)
    assert study_session.qoc is not None
    assert study_session.qoc.tremor_percent is None
    [clash] = outcomes.disagreements(study_session, outcome_values.derive(db, study_session))
    assert clash.typed is None


def test_the_other_qocs_stay_when_one_is_derived(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    changes.record_qoc(db, study_session, QocIn(grasp_hz=2.5, rating=7), SYSTEM)
    store(db, study_session, new_file(study_session), HALF_MILD)
    qoc = study_session.qoc
    assert qoc is not None
    assert (qoc.grasp_hz, qoc.rating, qoc.tremor_percent) == (2.5, 7, pytest.approx(50.0))
    # and a later entry of a person keeps the derived one as derived
    changes.record_qoc(db, study_session, QocIn(rating=8), SYSTEM)
    assert study_session.qoc is not None
    assert study_session.qoc.derived == ["tremor_percent"]


def test_taking_the_derived_value_replaces_the_typed_one_and_says_who_took_it(
    db: Session, study_session: StudySession, new_file: NewFile
) -> None:
    changes.record_qoc(db, study_session, QocIn(tremor_percent=12.0), SYSTEM)
    file = new_file(study_session)
    store(db, study_session, file, HALF_MILD)
    with pytest.raises(Invalid, match="another value by now"):
        outcomes.take_derived(db, study_session, "tremor_percent", 49.0, "ada@clinic.example")
    outcomes.take_derived(db, study_session, "tremor_percent", 50.0, "ada@clinic.example")
    qoc = study_session.qoc
    assert qoc is not None
    assert (qoc.tremor_percent, qoc.entered_by, qoc.derived) == (pytest.approx(50.0), "ada@clinic.example", ["tremor_percent"])
    assert outcomes.disagreements(study_session, outcome_values.derive(db, study_session)) == []


def test_a_proposed_session_gets_its_qocs_when_it_is_confirmed(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    study_session.status = "proposed"
    db.flush()
    store(db, study_session, new_file(study_session), HALF_MILD)
    assert study_session.qoc is None
    assert outcomes.derive_for_session(db, study_session) == [
        f"Session {study_session.id} is proposed: its outcomes are derived when it is confirmed."
    ]
    study_session.status = "confirmed"
    db.flush()
    outcomes.derive_for_session(db, study_session)
    assert study_session.qoc is not None


def test_a_session_moved_out_of_the_minutes_loses_its_derived_value(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    store(db, study_session, new_file(study_session), HALF_MILD)
    assert study_session.started_at is not None
    study_session.started_at += timedelta(days=1)
    outcomes.derive_for_session(db, study_session)
    qoc = study_session.qoc
    assert qoc is not None
    assert (qoc.tremor_percent, qoc.revision) == (None, 2)


def test_a_session_without_a_start_is_named_in_the_report(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    study_session.started_at = None
    db.flush()
    said = store(db, study_session, new_file(study_session), HALF_MILD)
    assert any(f"cannot be laid over these minutes: {study_session.id}." in s for s in said)
    assert study_session.qoc is None


def test_grasp_frequency_is_one_over_the_mean_interval_between_open_fists(
    db: Session, study_session: StudySession, new_file: NewFile
) -> None:
    times = np.array([0.0, 0.4, 1.0, 1.3, 2.0])
    said = outcomes.store_grasp(db, study_session, new_file(study_session), "right", times, np.zeros(4, dtype=bool))
    qoc = study_session.qoc
    assert qoc is not None
    assert qoc.grasp_hz == pytest.approx(4 / 2.0)
    assert "right hand, 5 open fists" in (qoc.reason or "")
    assert len(said) == 2


def test_of_two_hands_the_one_contralateral_to_the_stimulated_side_counts(
    db: Session, study_session: StudySession, new_file: NewFile
) -> None:
    file = new_file(study_session)
    outcomes.store_grasp(db, study_session, file, "left", *grasps(20, 3.0))
    assert study_session.qoc is not None
    assert "on the side of the stimulated left hemisphere: the other hand was not tested" in (study_session.qoc.reason or "")
    outcomes.store_grasp(db, study_session, file, "right", *grasps(10, 2.0))
    assert study_session.qoc.grasp_hz == pytest.approx(2.0)
    assert "right hand, contralateral to the left hemisphere" in (study_session.qoc.reason or "")
    changes.change_session(db, study_session, SessionChange(hemisphere=Hemisphere.RIGHT), SYSTEM)
    assert study_session.qoc.grasp_hz == pytest.approx(3.0)


def test_without_a_hemisphere_the_hands_are_averaged_and_it_says_so(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    study_session.hemisphere = None
    file = new_file(study_session)
    outcomes.store_grasp(db, study_session, file, "left", *grasps(20, 3.0))
    outcomes.store_grasp(db, study_session, file, "right", *grasps(10, 2.0))
    assert study_session.qoc is not None
    assert study_session.qoc.grasp_hz == pytest.approx(2.5)
    assert "mean of left hand and right hand: the session names no hemisphere" in (study_session.qoc.reason or "")


def test_the_newest_test_of_a_hand_counts(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    outcomes.store_grasp(db, study_session, new_file(study_session), "right", *grasps(10, 2.0))
    outcomes.store_grasp(db, study_session, new_file(study_session), "right", *grasps(10, 1.0))
    assert study_session.qoc is not None
    assert study_session.qoc.grasp_hz == pytest.approx(1.0)
    outcome = outcome_values.grasp_outcome(db, study_session)
    assert outcome is not None
    assert [(t.counts, t.role) for t in outcome.tests] == [(True, "counts"), (False, "replaced by a newer test of this hand")]


def test_a_file_attached_to_another_session_leaves_no_value_behind(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    file = new_file(study_session)
    outcomes.store_grasp(db, study_session, file, "left", *grasps(10, 3.0))
    outcomes.store_grasp(db, study_session, file, "right", *grasps(10, 2.0))
    other = StudySession(visit_id=study_session.visit_id, ordinal=2, started_at=None, duration_s=600.0, status="confirmed")
    blinding.assign(other, Controller.RANDOM, None)
    db.add(other)
    db.flush()
    said = outcomes.store_grasp(db, other, file, "right", *grasps(10, 2.0))
    assert f"The grasp tests of this file no longer belong to session {study_session.id}." in said
    assert study_session.qoc is not None
    assert study_session.qoc.grasp_hz is None
    assert other.qoc is not None
    assert other.qoc.grasp_hz == pytest.approx(2.0)


def test_one_open_fist_gives_no_frequency(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    said = outcomes.store_grasp(db, study_session, new_file(study_session), "right", *grasps(1, 1.0))
    assert study_session.qoc is None
    assert "no grasp frequency derived: right hand; fewer than two open fists (right hand)" in said[1]


def test_implausible_intervals_count_and_the_value_without_them_is_told(
    db: Session, study_session: StudySession, new_file: NewFile
) -> None:
    times = np.array([0.0, 0.5, 1.0, 5.0])
    outcomes.store_grasp(db, study_session, new_file(study_session), None, times, np.array([False, False, True]))
    qoc = study_session.qoc
    assert qoc is not None
    assert qoc.grasp_hz == pytest.approx(3 / 5)
    assert "1 intervals outside 0.08 to 3 s counted, without them 2 Hz" in (qoc.reason or "")


def test_a_test_whose_every_interval_is_implausible_gives_no_frequency(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    study_session.hemisphere = None
    file = new_file(study_session)
    microseconds = 1e6 * np.arange(10) * 0.4  # times in us under a header in s
    outcomes.store_grasp(db, study_session, file, "left", *grasps(10, 2.0))
    said = outcomes.store_grasp(db, study_session, file, "right", microseconds, np.ones(9, dtype=bool))
    assert study_session.qoc is not None
    assert study_session.qoc.grasp_hz is None
    assert "no grasp frequency derived: mean of left hand and right hand" in said[1]
    assert "every interval lies outside 0.08 to 3 s (right hand)" in said[1]


def test_what_is_said_of_minutes_stays_true_when_a_session_comes_after_them(
    db: Session, study_session: StudySession, new_file: NewFile
) -> None:
    study_session.status = "proposed"
    said = store(db, study_session, new_file(study_session), HALF_MILD)
    study_session.status = "confirmed"
    outcomes.derive_for_session(db, study_session)
    assert study_session.qoc is not None
    assert [s for s in said if "No confirmed session" in s] == []
    assert said[-1] == "They count in every confirmed session with a start that they cover, also in one that is made later."


def test_a_frequency_that_no_hand_reaches_is_refused(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    said = outcomes.store_grasp(db, study_session, new_file(study_session), "right", *grasps(100, 50.0))
    assert study_session.qoc is None
    assert "50 Hz is faster than any hand" in said[1]


def test_every_derived_revision_stands_in_the_audit_trail_with_its_basis(
    db: Session, study_session: StudySession, new_file: NewFile
) -> None:
    store(db, study_session, new_file(study_session), HALF_MILD)
    event = db.scalars(select(AuditEvent).where(AuditEvent.entity == "qoc")).one()
    assert event.actor == "test"
    assert "duration-weighted" in (event.reason or "")
    series = db.scalars(select(AuditEvent).where(AuditEvent.entity == "tremor_series")).one()
    assert series.reason is None
    assert "fractions_f32" not in (series.after or {})


def test_the_basis_of_a_value_does_not_become_the_reason_of_what_is_written_next(
    db: Session, study_session: StudySession, new_file: NewFile
) -> None:
    store(db, study_session, new_file(study_session), HALF_MILD)
    study_session.visit.note = "afterwards"
    db.flush()
    event = db.scalars(select(AuditEvent).where(AuditEvent.entity == "visit", AuditEvent.action == "update")).one()
    assert event.reason is None
