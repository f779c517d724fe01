"""Guesses at the visit and the controller of a recording, and their evidence, in words on pages."""

from __future__ import annotations

import json
from datetime import date

import numpy as np
import pytest

from app.ingest import wording
from app.ingest.evidence import BY_CUT, BY_UPLOAD, Evidence, Reason, Source, guess_controller, guess_visit
from app.study.sessions.stimulation import Delivered
from app.study.traces import StepTable
from app.tables.sessions import Controller
from app.tables.visits import Visit

nan = float("nan")


def steps(amplitude_ma: list[float], cdbs_ma: float | None = 3.0) -> StepTable:
    amount = np.array([9.9, *amplitude_ma])  # the row before the session must not count
    t_s = 2.0 * np.arange(amount.size)
    fraction = amount / cdbs_ma if cdbs_ma else np.full(amount.size, nan)
    return StepTable(t_s, np.ones(amount.size), amount, fraction, None, None, cdbs_ma)


def side(table: StepTable | None, name: str = "right side") -> Delivered:
    return Delivered(name, None, False, table)


@pytest.mark.parametrize(
    ("amplitude_ma", "guess", "why"),
    [
        ([0, 0, 0, 0], Controller.NO_DBS, "0 in all 4 steps"),
        ([0, 0, nan, 0], Controller.NO_DBS, "0 in all 3 steps where it is known"),
        ([3.0, 3.0, 3.0], Controller.CDBS, "within 5 % of the cDBS amplitude of 3 mA"),
        ([3.15, 2.85, 3.0], Controller.CDBS, "within 5 %"),
        ([3.2, 3.2, 3.2], None, "constant at 3.2 mA, 107 % of the cDBS amplitude"),
        ([1.5, 1.5, 1.5], None, "50 % of the cDBS amplitude"),
        ([0, 0, 0, 0.1], None, "varies between 0 and 0.1 mA"),
        ([1.0, 3.0, 2.0], None, "varies between 1 and 3 mA"),
        ([nan, nan], None, "states no amplitude"),
        ([3.0, nan, nan, nan], None, "known in only 1 of 4 steps"),
    ],
)
def test_the_controller_is_guessed_from_the_amplitude_or_left_open(amplitude_ma: list[float], guess: Controller | None, why: str) -> None:
    found, evidence = guess_controller([side(steps(amplitude_ma))])
    assert found is guess
    assert why in wording.reason(evidence)


def test_without_a_stated_cdbs_amplitude_a_constant_one_proves_nothing_but_zero_does() -> None:
    found, evidence = guess_controller([side(steps([2.4, 2.4], cdbs_ma=None))])
    assert found is None
    assert wording.reason(evidence) == "the amplitude is constant at 2.4 mA, but no cDBS amplitude was stated for it when it was read"
    assert guess_controller([side(steps([0, 0], cdbs_ma=None))])[0] is Controller.NO_DBS


@pytest.mark.parametrize(
    ("left", "right", "guess", "why"),
    [
        (steps([0, 0, 0]), steps([0, 0, 0]), Controller.NO_DBS, "left side: the amplitude is 0 in all 3 steps"),
        (steps([3, 3, 3]), steps([2, 2, 2], cdbs_ma=2.0), Controller.CDBS, "right side: about 2 mA throughout"),
        (steps([3, 3, 3]), steps([0, 0, 0]), None, "right side: the amplitude is 0 in all 3 steps"),
        (steps([1, 3, 2]), steps([0, 0, 0]), None, "left side: the amplitude varies between 1 and 3 mA"),
        (steps([3, 3, 3]), steps([1.5, 1.5, 1.5]), None, "50 % of the cDBS amplitude"),
        (steps([0, 0, 0]), None, None, "right side: the file states no amplitude"),
    ],
)
def test_the_controller_is_guessed_from_every_side_or_left_open(
    left: StepTable, right: StepTable | None, guess: Controller | None, why: str
) -> None:
    found, evidence = guess_controller([side(left, "left side"), side(right)])
    assert found is guess
    assert why in wording.reason(Evidence.from_json(json.loads(json.dumps(evidence.as_json()))))


VISITS = [Visit(number=1, date=date(2026, 3, 2)), Visit(number=2, date=date(2026, 3, 30)), Visit(number=3, date=date(2026, 4, 27))]
TODAY = date(2026, 4, 1)


def test_the_visit_of_the_recordings_day_is_taken() -> None:
    guess = guess_visit(VISITS, date(2026, 3, 2), None, TODAY)
    assert (guess.visit.number, guess.open) == (1, False)
    assert wording.reason(guess.why) == "recorded on 2026-03-02, the day of visit 1"


def test_the_stated_visit_wins_over_the_day() -> None:
    guess = guess_visit(VISITS, date(2026, 3, 2), VISITS[1], TODAY)
    assert (guess.visit.number, guess.open) == (2, False)


@pytest.mark.parametrize(
    ("day", "why"),
    [(None, "states no date"), (date(2026, 3, 9), "recorded on 2026-03-09, and no visit has that date")],
)
def test_without_a_visit_of_that_day_the_choice_is_open_and_kept_in_the_newest_past_visit(day: date | None, why: str) -> None:
    guess = guess_visit(VISITS, day, None, TODAY)
    assert (guess.visit.number, guess.open) == (2, True)
    assert why in wording.reason(guess.why)


def test_two_visits_of_one_day_leave_the_choice_open() -> None:
    twice = [*VISITS, Visit(number=4, date=date(2026, 3, 2))]
    guess = guess_visit(twice, date(2026, 3, 2), None, TODAY)
    assert guess.open
    assert "2 visits are dated 2026-03-02" in wording.reason(guess.why)


def test_a_persons_word_is_told_from_a_guess_by_its_source_and_not_by_its_sentence() -> None:
    by_person = Evidence(Source.PERSON, Reason.STATED, {"by": "a@clinic.example"})
    assert [e.stated for e in (BY_UPLOAD, BY_CUT, by_person)] == [True, True, True]
    assert not guess_visit(VISITS, date(2026, 3, 2), None, TODAY).why.stated
    assert not guess_controller([side(steps([0, 0]))])[1].stated


def test_every_reason_has_words() -> None:
    assert set(wording._SENTENCES) | {Reason.STATED} == set(Reason)
