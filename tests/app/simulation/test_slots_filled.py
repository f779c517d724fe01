"""The sessions of a simulated visit stand in the slots of its signed plan."""

from __future__ import annotations

import datetime as dt
from typing import Any

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.planning.plans.models import PlanItem
from app.platform.errors import BetaloopError
from app.simulation.design import Remembered, design
from app.simulation.loop import ParticipantLoop, Signer
from app.study.models import StudySession
from app.study.repository import visit as visit_of
from tests.clinic_day import clinic_day

__all__ = ["clinic_day"]


class Silent:
    """Progress that nobody watches."""

    def say(self, code: str, what: str) -> None:
        """Nothing."""

    def session_held(self, code: str) -> None:
        """Nothing."""

    def job(self, code: str, share: float) -> None:
        """Nothing."""


def test_each_session_is_confirmed_into_its_slot_once_and_a_missing_one_is_an_error(clinic_day: Any, db: Session) -> None:
    study = Remembered(0, {}, dt.date(2099, 10, 25))
    loop = ParticipantLoop("P1", design(["P1"], 2, 0, "quick"), study, SYSTEM, Signer(SYSTEM, ""), Silent(), lambda: None)
    items = list(db.scalars(select(PlanItem).order_by(PlanItem.position)))
    for k, item in enumerate(items):
        if k == len(items) - 1:
            with pytest.raises(BetaloopError, match=f"planned sessions {item.position}"):
                loop._fill(db, visit_of(db, clinic_day.visit, SYSTEM))
            db.rollback()
        rows = "".join(f"{2 * i},{1 + 0.01 * k + 0.001 * i},1\n" for i in range(-9, 301))
        stated = {"participant": "P1", "visit": "2", "controller": str(item.controller)}
        sent = clinic_day.client.post("/api/v1/uploads", data=stated, files={"file": (f"{k}.csv", f"t_s,beta,amplitude_fraction\n{rows}")})
        assert sent.status_code == 201, sent.text
        db.expire_all()
    for _ in range(2):
        loop._fill(db, visit_of(db, clinic_day.visit, SYSTEM))
    db.expire_all()
    held = db.scalars(select(StudySession).where(StudySession.visit_id == clinic_day.visit).order_by(StudySession.ordinal)).all()
    assert [s.plan_item_id for s in held] == [item.id for item in items]
