"""Each alternative analysis removes what it is named for."""

from __future__ import annotations

import numpy as np
import pytest

from ml.statistics.within_visits.contrasts import (
    Adjustment,
    Average,
    Measurements,
    Reason,
    Unavailable,
    average,
    visit_contrasts,
)
from ml.statistics.within_visits.sensitivity import (
    bracketed,
    carry_over_adjusted,
    medication_adjusted,
    order_adjusted,
    sensitivities,
)

VISITS, EACH = 6, 4
VISIT = np.repeat(np.arange(VISITS), 2 * EACH)
ORDER = np.tile(np.arange(2.0 * EACH), VISITS)


def study(extra, arms, medication=None, seed=0):
    rng = np.random.default_rng(seed)
    value = rng.standard_normal(VISITS)[VISIT] + extra + 0.01 * rng.standard_normal(VISIT.size)
    return Measurements.of(value, VISIT, arms, order=ORDER, medication_h=medication)


CDBS_FIRST = np.tile([False, True], VISITS * EACH)


def test_a_drift_that_favours_the_later_arm_goes_with_the_order_and_between_brackets():
    data = study(0.5 * ORDER, CDBS_FIRST)
    assert average(visit_contrasts(data)).estimate == pytest.approx(0.5, abs=0.02)
    assert order_adjusted(data).estimate == pytest.approx(0.0, abs=0.02)
    assert bracketed(data).estimate == pytest.approx(0.0, abs=0.02)


def test_the_bracketed_contrast_is_against_the_neighbours_by_nearness_and_leaves_the_last_session_out():
    data = Measurements.of([1.0, 4.0, 3.0, 9.0] * 2, [1] * 4 + [2] * 4, [0, 1, 0, 1] * 2, order=[0, 1, 4, 5] * 2, resolution=1)
    found = bracketed(data)
    assert found.estimate == pytest.approx(4 - (0.75 * 1 + 0.25 * 3))
    assert (found.n_tested, found.n_cdbs, found.adjustment) == (2, 4, Adjustment.BRACKETED)


def test_what_the_session_before_leaves_behind_is_taken_out():
    arms = np.tile(np.repeat([False, True], 2), VISITS * EACH // 2)
    after = np.concatenate([[0, *arms[v == VISIT][:-1]] for v in range(VISITS)])
    data = study(1.0 * arms + 0.8 * after, arms)
    assert abs(average(visit_contrasts(data)).estimate - 1.0) > 0.1
    assert carry_over_adjusted(data).estimate == pytest.approx(1.0, abs=0.02)


def test_the_rise_and_wearing_off_of_medication_is_taken_out():
    rng = np.random.default_rng(2)
    hours = rng.uniform(0, 4, VISIT.size)
    arms = hours + rng.uniform(0, 2, VISIT.size) > 3
    data = study(1.0 * arms + 0.6 * hours - 0.2 * hours**2, arms, hours)
    assert medication_adjusted(data).estimate == pytest.approx(1.0, abs=0.03)
    unknown = Measurements.of(data.value, VISIT, arms, order=ORDER, medication_h=np.full(VISIT.size, np.nan))
    assert medication_adjusted(unknown) == Unavailable(Reason.NOT_RECORDED)


def test_all_of_them_answer_and_what_was_not_recorded_is_a_reason():
    data = study(0.0, CDBS_FIRST)
    found = {s.adjustment: s.result for s in sensitivities(data)}
    assert list(found) == list(Adjustment)
    assert isinstance(found[Adjustment.ORDER], Average)
    assert found[Adjustment.MEDICATION] == Unavailable(Reason.NOT_RECORDED)
    bare = Measurements.of(data.value, VISIT, CDBS_FIRST)
    reasons = {s.adjustment: getattr(s.result, "reason", None) for s in sensitivities(bare)}
    assert reasons[Adjustment.BRACKETED] is reasons[Adjustment.CARRY_OVER] is Reason.NOT_RECORDED


def test_no_session_between_two_of_cdbs_is_a_typed_reason():
    data = Measurements.of([1.0, 2.0, 3.0, 4.0], [1, 1, 2, 2], [0, 1, 0, 1], order=[0, 1, 0, 1])
    assert bracketed(data) == Unavailable(Reason.NO_BRACKETED_SESSION, 0, 1)
    assert all(isinstance(s.result, Unavailable) for s in sensitivities(Measurements.of([], [], [], order=[])))
