"""The first screen of the demo offers the questions that its study can answer by now."""

from __future__ import annotations

from app.overview.overview_web import offers
from app.overview.state import State, VisitProgress
from app.tables.participants import Participant


def participants() -> list[Participant]:
    return [Participant(id=number, code=f"P{number}") for number in range(1, 5)]


def planned(visit_id: int) -> State:
    return State(planned_visits=[VisitProgress(visit_id=visit_id, number=4, date=None, planned=8, held=0, logs_missing=0, tested=0)])


def test_it_offers_what_the_study_can_answer_by_now() -> None:
    assert offers([], {}) == []
    begun = offers(participants()[:1], {1: State()})
    assert [o.question for o in begun] == ["What would you test at P1's next visit?", "Who did what, and when?"]
    whole = offers(participants(), {1: State()} | {k: planned(10 * k) for k in (2, 3, 4)})
    assert [o.url for o in whole] == [
        "/participants/P1/ranking",
        "/visit-day/20",
        "/participants/P3/analyses",
        "/participants/P4/calibration",
        "/audit",
    ]
