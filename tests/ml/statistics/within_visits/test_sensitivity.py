"""Each alternative analysis removes what it is named for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t

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
    skewness_corrected,
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


def contrasts_of(values):
    """Build a study of visits with these contrasts."""
    n = len(values)
    return Measurements.of(np.c_[np.zeros(n), values].ravel(), np.repeat(np.arange(n), 2), np.tile([False, True], n))


def test_symmetric_contrasts_are_left_as_they_are():
    data = contrasts_of([1.0, 2.0, 3.0, 4.0, 5.0])
    plain, found = average(visit_contrasts(data)), skewness_corrected(data)
    assert (found.low, found.high, found.p_value) == pytest.approx((plain.low, plain.high, plain.p_value))
    assert found.adjustment is Adjustment.SKEWNESS


def test_a_p_of_skewed_contrasts_is_that_of_halls_ratio_and_its_interval_excludes_nothing_else():
    values = np.array([0.1, 0.2, 0.3, 0.4, 3.0, 0.2])
    found = skewness_corrected(contrasts_of(values))
    spread = values.std(ddof=1)
    g, u = np.mean((values - values.mean()) ** 3) / spread**3, values.mean() / spread
    ratio = np.sqrt(6) * (((1 + g * u / 3) ** 3 - 1) / g + g / 36)
    assert found.p_value == pytest.approx(2 * t.sf(abs(ratio), 5))
    for edge in (found.low, found.high):  # moved so that the edge is nil, the p-value is 1 less the level
        assert skewness_corrected(contrasts_of(values - edge)).p_value == pytest.approx(0.05)
    assert found.high - values.mean() > values.mean() - found.low
    assert skewness_corrected(contrasts_of(values[:2])) == Unavailable(Reason.TOO_FEW_VISITS, 2, 3)
    assert skewness_corrected(contrasts_of([1.0, 1.0, 1.0])) == Unavailable(Reason.NO_VARIANCE)


def test_the_larger_p_keeps_the_level_where_a_floor_skews_the_contrasts():
    rng, number = np.random.default_rng(4), 3000
    study, both = 0, 0
    for _ in range(number):
        values = rng.exponential(1.0, 6) - 1.0
        data = contrasts_of(values)
        p = average(visit_contrasts(data)).p_value
        study += p < 0.05
        both += max(p, skewness_corrected(data).p_value) < 0.05
    assert study / number > 0.08  # Student's ratio of contrasts as skewed as these errs
    assert both / number < 0.85 * study / number


def test_no_session_between_two_of_cdbs_is_a_typed_reason():
    data = Measurements.of([1.0, 2.0, 3.0, 4.0], [1, 1, 2, 2], [0, 1, 0, 1], order=[0, 1, 0, 1])
    assert bracketed(data) == Unavailable(Reason.NO_BRACKETED_SESSION, 0, 1)
    assert all(isinstance(s.result, Unavailable) for s in sensitivities(Measurements.of([], [], [], order=[])))
