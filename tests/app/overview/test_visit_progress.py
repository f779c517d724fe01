"""Sessions planned, held, and missing."""

from __future__ import annotations

from datetime import date
from typing import Any

from sqlalchemy.orm import Session

from app.overview.visit_progress import VisitProgress, visit_progress
from tests.clinic_day import clinic_day

__all__ = ["clinic_day"]

TABLE = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,1\n" for k in range(-9, 301))


def test_logs_are_missing_only_after_the_day_of_the_visit(clinic_day: Any, db: Session) -> None:
    fields = {"participant": "P1", "visit": "2", "controller": "cdbs"}
    assert clinic_day.client.post("/api/v1/uploads", data=fields, files={"file": ("a.csv", TABLE)}).status_code == 201
    day = date(2099, 11, 22)
    assert visit_progress(db, [1, 99], day) == {1: [VisitProgress(clinic_day.visit, 2, day, 3, 0, 0)], 99: []}
    assert clinic_day.client.post(f"/api/v1/visits/{clinic_day.visit}/slots/confirm", json={}).status_code == 200
    db.expire_all()
    assert visit_progress(db, [1], date(2099, 11, 23)) == {1: [VisitProgress(clinic_day.visit, 2, day, 3, 1, 2)]}
