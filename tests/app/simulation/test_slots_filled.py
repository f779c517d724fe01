"""A visit of the simulated study goes through the doors of the clinic: signed plan, bundles, tablet, clinic day, logs, slots."""

from __future__ import annotations

import datetime as dt

import numpy as np
import pytest
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.platform.database import transaction
from app.platform.errors import BetaloopError, Conflict
from app.simulation import sessions, tablet
from app.simulation.design import Design, Preset, Remembered
from app.simulation.loop import ParticipantLoop, Signer
from app.study.blinding import arm
from app.study.recordings import controller_log
from app.study.sessions.usable_steps import session_data
from app.tables.accounts import Role
from app.tables.plans import BundleRelease, DayEntry, PlanItem
from app.tables.recordings import Recording
from app.tables.sessions import Controller, StudySession
from app.tables.uploads import Upload
from ml.deploy.runtime.control_loop import End
from ml.deploy.runtime.session import run_slot

DAY = dt.date(2024, 3, 4)
SIZE = Preset(visits=2, random_visits=1, random_sessions=1, session_minutes=5, policies_per_kind=1, pipeline={})
PASSWORD = "a password of the simulated signer"


class Silent:
    """Progress without a watcher."""

    def say(self, code: str, what: str) -> None:
        """Do nothing."""

    def session_held(self, code: str) -> None:
        """Do nothing."""

    def job(self, code: str, share: float) -> None:
        """Do nothing."""


@pytest.fixture
def loop(db: Session) -> ParticipantLoop:
    """P2 enrolled, without a session."""
    with transaction("test") as people:
        drafter = accounts.caller_of(accounts.add_user(people, "drafter@clinic.example", Role.CLINICIAN, PASSWORD))
        signer = accounts.caller_of(accounts.add_user(people, "second@clinic.example", Role.CLINICIAN, PASSWORD))
    wanted = Design(participants=("P2",), visits=2, seed=3, preset=SIZE)
    made = ParticipantLoop("P2", wanted, Remembered(3, {}, DAY), drafter, Signer(signer, PASSWORD), Silent(), lambda: None)
    with made._transaction() as first:
        made._participant(first)
        first.commit()
    return made


def held(db: Session) -> list[StudySession]:
    db.expire_all()
    return list(db.scalars(select(StudySession).order_by(StudySession.ordinal)))


def test_each_session_runs_from_its_bundle_and_its_log_fills_its_slot(loop: ParticipantLoop, db: Session) -> None:
    loop._visit(1)
    items = list(db.scalars(select(PlanItem).order_by(PlanItem.position)))
    assert [i.controller for i in items] == ["cdbs", "random", "no_dbs"]
    found = held(db)
    assert [s.plan_item_id for s in found] == [i.id for i in items]
    assert [(s.status, s.duration_s) for s in found] == [("confirmed", 300)] * 3
    assert db.scalars(select(BundleRelease.plan_item_id).order_by(BundleRelease.id)).all() == [i.id for i in items[:2]]
    recordings = [s.segments[0].recording for s in found]
    assert [controller_log.simulated(r) for r in recordings] == [True, True, False]
    for recording, item in zip(recordings[:2], items[:2], strict=True):
        slot = controller_log.slot_of_recording(db, recording)
        assert slot is not None
        assert (slot.slot_id, slot.visit_date) == (item.id, str(DAY))
    random = found[1]
    planned = random.conditions.design_parameters
    fraction = session_data(db, random).table.fraction[-150:]
    wanted = np.repeat([h["amplitude"] for h in planned["holds"]], [h["steps"] for h in planned["holds"]])
    assert np.abs(fraction - np.maximum(wanted, items[1].min_ma / items[1].cdbs_ma)).max() < 1e-5, "within the signed limits, as drawn"
    kinds = db.scalars(select(DayEntry.kind)).all()
    assert (kinds.count("start"), kinds.count("rating"), kinds.count("clinical_settings")) == (3, 3, 1)
    for session in found:
        assert session.qoc is not None
        assert None not in (session.qoc.rating, session.qoc.grasp_hz, session.qoc.tremor_percent)


def test_what_a_stop_cut_is_run_again_with_the_same_numbers_and_nothing_comes_twice(
    loop: ParticipantLoop, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = sessions.run_slot_of

    def stopped(*args: object, **more: object) -> object:
        if args[2] == 2:
            raise KeyboardInterrupt
        return real(*args, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(sessions, "run_slot_of", stopped)
    with pytest.raises(KeyboardInterrupt):
        loop._visit(1)
    assert [s.status for s in held(db)] == ["proposed"]
    monkeypatch.setattr(sessions, "run_slot_of", real)
    for _ in range(2):
        loop._visit(1)
    found = held(db)
    assert [arm(s, loop.caller).controller for s in found] == [Controller.CDBS, Controller.RANDOM, Controller.NO_DBS]
    assert all(s.qoc is not None and s.qoc.tremor_percent is not None for s in found)
    assert db.scalar(select(func.count()).select_from(Recording)) == db.scalar(select(func.count()).select_from(Upload)) == 3
    assert db.scalar(select(func.count()).select_from(DayEntry)) == 3 * 8 + 1


def test_a_session_that_does_not_come_to_its_end_is_an_error(loop: ParticipantLoop, db: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    def ends_early(*args: object, **more: object) -> object:
        outcome = run_slot(*args, **more)  # type: ignore[arg-type]
        return type(outcome)(End.STOPPED, "asked for by the device", outcome.session)

    monkeypatch.setattr(tablet, "run_slot", ends_early)
    with pytest.raises(BetaloopError, match="Session 1 of visit 1 of P2 ended as stopped"):
        loop._visit(1)
    assert held(db) == []


def test_a_bundle_is_refused_to_the_study_on_another_day_than_that_of_its_visit(
    loop: ParticipantLoop, db: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tablet, "TAKEN_BEFORE", dt.timedelta(days=-1))
    with pytest.raises(Conflict, match="its bundles have expired"):
        loop._visit(1)
