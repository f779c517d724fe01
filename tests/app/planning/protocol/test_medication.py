"""Medication due before the sessions of a plan."""

from __future__ import annotations

from datetime import time

from app.planning.protocol.schedule import due_before
from app.study.characteristics import PlannedDose
from app.tables.visits import Drug

SCHEDULE = [PlannedDose(drug=Drug.LEVODOPA, mg=mg, at=at) for mg, at in ((100.0, "07:00"), (50.0, "09:20"), (100.0, "12:00"))]


def test_a_dose_is_due_before_the_first_session_that_begins_after_it() -> None:
    due = due_before([15, 15, 15], time(9), SCHEDULE)  # 9:00, 9:15, 9:30
    assert [d[:5] for d in due] == ["07:00", "", "09:20"]
    assert due[0].endswith("100 mg")
    assert due_before([20, 20], time(9), SCHEDULE)[1].startswith("09:20")  # at the very start


def test_without_a_time_of_day_nothing_is_said_to_be_due() -> None:
    assert due_before([15, 15], None, SCHEDULE) == ["", ""]
