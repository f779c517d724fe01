"""Sessions planned, done, and missing."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta
from typing import Any

from sqlalchemy.orm import Session

from app.overview.state import Actor, State, Task, VisitProgress, next_steps, progress, visit_progress, what
from app.tables.participants import Participant, SettingsVersion
from tests.clinic_day import clinic_day
from tests.conftest import PASSWORD

__all__ = ["clinic_day"]

TABLE = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,1\n" for k in range(-9, 301))


def test_logs_are_missing_only_after_the_day_of_the_visit(clinic_day: Any, db: Session) -> None:
    fields = {"participant": "P1", "visit": "2", "controller": "cdbs"}
    assert clinic_day.client.post("/api/v1/uploads", data=fields, files={"file": ("a.csv", TABLE)}).status_code == 201
    day = date(2099, 11, 22)
    assert visit_progress(db, [1, 99], day) == {1: [VisitProgress(clinic_day.visit, 2, day, 3, 0, 0, 0)], 99: []}
    assert clinic_day.client.post(f"/api/v1/visits/{clinic_day.visit}/slots/confirm", json={}).status_code == 200
    home = clinic_day.client.get("/", headers={"Accept": "text/html"}).text
    assert f'<a href="/visits/{clinic_day.visit}/slots">Visit 2: 1 of 3 planned sessions held</a>' in home
    db.expire_all()
    assert visit_progress(db, [1], date(2099, 11, 23)) == {1: [VisitProgress(clinic_day.visit, 2, day, 3, 1, 2, 0)]}
    for change, missing in (("lock", 0), ("unlock", 2)):
        body = {"reason": "complete"} | ({"password": PASSWORD} if change == "lock" else {})
        assert clinic_day.client.post(f"/api/v1/visits/{clinic_day.visit}/{change}", json=body).status_code in (200, 201)
        (found,) = visit_progress(db, [1], date(2099, 11, 23))[1]
        assert found.logs_missing == missing, "a locked visit takes no logs"


def test_the_steps_name_missing_logs_and_go_on_from_policies_that_were_tested() -> None:
    participant = Participant(code="P1", settings=[SettingsVersion(version=1, xi_beta=1.0, cdbs_amplitude_ma=3.0)])
    snapshot = datetime(2026, 3, 1, tzinfo=UTC)
    state = State(
        sessions=9, visits=2, evaluated_at=snapshot, snapshot_at=snapshot, newest_session=snapshot + timedelta(days=1),
        planned_visits=[VisitProgress(7, 2, date(2026, 3, 2), 5, 4, 1, 0)],
    )  # fmt: skip
    logs, rank = next_steps(participant, state)
    assert (logs.task, logs.actor, logs.url, what(logs)) == (
        Task.SEND_LOGS, Actor.COORDINATOR, "/visits/7/slots", "1 planned session without a log",
    )  # fmt: skip
    assert (rank.task, rank.url) == (Task.RANK_AGAIN, "/participants/P1/jobs"), "no policy was tested"
    state.planned_visits = [VisitProgress(7, 2, date(2026, 3, 2), 5, 5, 0, 2)]
    (train,) = next_steps(participant, state)
    assert (train.task, train.actor, train.url) == (Task.TRAIN_NEXT, Actor.ENGINEER, "/participants/P1/next-generation")
    assert state.last_planned is not None
    assert progress(state.last_planned) == "Visit 2: 5 of 5 planned sessions held"
