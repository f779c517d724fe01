"""Sessions of a policy confirm by when they began, not by when their files arrival."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta

import pytest

from app.analysis.facts import Facts
from app.analysis.primary_results import Basis, results
from app.study.blinding import Arm
from app.tables.sessions import Controller

PICKED = datetime(2026, 3, 2, 12, tzinfo=UTC)
HOUR = timedelta(hours=1)
WEEK = timedelta(days=7)


def session(number: int, *, began: datetime | None, arrival: datetime, day: date | None = None) -> Facts:
    arm = Arm(Controller.RL, 7)
    return Facts(number, 1, 1, number, arm, None, began, arrival, 300.0, {"energy": 0.5}, {}, None, None, (), None, None, day)


@pytest.mark.parametrize(
    ("row", "basis"),
    [
        (session(1, began=PICKED - HOUR, arrival=PICKED + WEEK), Basis.SELECTION),
        (session(1, began=PICKED + HOUR, arrival=PICKED - WEEK), Basis.CONFIRMATION),
        (session(1, began=None, arrival=PICKED + WEEK), Basis.SELECTION),
        (session(1, began=None, arrival=PICKED + WEEK, day=PICKED.date()), Basis.SELECTION),
        (session(1, began=None, arrival=PICKED - WEEK, day=(PICKED + WEEK).date()), Basis.CONFIRMATION),
    ],
    ids=["uploaded late", "clock of the service behind", "start unknown", "start unknown on the day", "start unknown on a later day"],
)
def test_a_session_confirms_by_when_it_began(row: Facts, basis: Basis) -> None:
    of_policy = next(r for r in results([row], {7: "rl-07"}, {7: PICKED}) if r.tested.policy_id == 7)
    assert of_policy.tested.basis is basis


def test_a_late_upload_of_an_earlier_session_is_left_out_beside_a_later_one() -> None:
    early, late = session(1, began=PICKED - HOUR, arrival=PICKED + WEEK), session(2, began=PICKED + HOUR, arrival=PICKED + WEEK)
    of_policy = next(r for r in results([early, late], {7: "rl-07"}, {7: PICKED}) if r.tested.policy_id == 7)
    assert (of_policy.tested.sessions, of_policy.tested.selection_sessions) == ((2,), (1,))
