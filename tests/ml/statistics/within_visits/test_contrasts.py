"""The average over visits against closed forms, and typed answers where there is nothing to average."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from ml.statistics.effects import cliffs_delta
from ml.statistics.ranksum import rank_sum
from ml.statistics.within_visits.averages import adjusted_average, order_imbalance, primary
from ml.statistics.within_visits.contrasts import (
    Adjustment,
    Average,
    Measurements,
    Reason,
    Unavailable,
    average,
    visit_contrasts,
    win_probability,
)
from ml.statistics.within_visits.sensitivity import skewness_corrected


def study(seed=0, visits=5, each=3, effect=0.0, drift=0.0, first_cdbs=False):
    rng = np.random.default_rng(seed)
    visit = np.repeat(np.arange(visits), 2 * each)
    arms = np.tile([False, True], visits * each)
    if not first_cdbs:
        arms = np.concatenate([rng.permutation(arms[: 2 * each]) for _ in range(visits)])
    order = np.tile(np.arange(2.0 * each), visits)
    value = 2 * rng.standard_normal(visits)[visit] + effect * arms + drift * order + rng.standard_normal(visit.size)
    return Measurements.of(value, visit, arms, order=order)


def test_the_average_is_the_one_sample_t_test_of_the_visits_contrasts():
    data = study(1)
    contrasts = visit_contrasts(data)
    expected = ttest_1samp(contrasts.contrast, 0.0)
    ends = expected.confidence_interval(0.95)
    found = average(contrasts)
    assert found.p_value == pytest.approx(expected.pvalue)
    assert (found.low, found.high) == pytest.approx((ends.low, ends.high))
    assert found.p_above(0.3) == pytest.approx(ttest_1samp(contrasts.contrast, 0.3, alternative="greater").pvalue)
    assert found.p_below(0.3) == pytest.approx(ttest_1samp(contrasts.contrast, 0.3, alternative="less").pvalue)


def test_a_contrast_is_the_difference_of_the_means_of_a_visit_and_days_drop_out():
    data = Measurements.of([1, 3, 5, 101, 103, 108], [1, 1, 1, 2, 2, 2], [0, 0, 1, 1, 0, 0])
    assert visit_contrasts(data).contrast == pytest.approx([3.0, 101 - 105.5])


def test_the_win_probability_counts_pairs_of_one_visit_and_ties_half():
    assert win_probability(np.array([2.0, 3.0]), np.array([1.0, 2.0, 4.0])) == pytest.approx((1 + 0.5 + 2) / 6)
    data = Measurements.of([1, 2, 2, 9, 8], [1, 1, 1, 2, 2], [0, 1, 0, 0, 1])
    assert visit_contrasts(data, "win_probability").contrast == pytest.approx([0.75, 0.0])


def test_missing_values_and_visits_without_both_arms_are_left_out():
    data = Measurements.of([1, np.nan, 2, 5, 6, 7], [1, 1, 1, 2, 3, 3], [0, 0, 1, 1, 0, 1])
    contrasts = visit_contrasts(data)
    assert contrasts.visit.tolist() == [1, 3]
    assert (contrasts.n_tested.tolist(), contrasts.n_cdbs.tolist()) == ([1, 1], [1, 1])


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (Measurements.of([], [], []), Reason.NO_SESSION),
        (Measurements.of([1.0], [1], [True]), Reason.NO_SESSION),
        (Measurements.of([np.nan] * 4, [1, 1, 2, 2], [0, 1, 0, 1]), Reason.NO_SESSION),
        (Measurements.of([1, 2, 3, 4], [1, 1, 2, 2], [0, 0, 1, 1]), Reason.NO_VISIT_WITH_BOTH_ARMS),
        (Measurements.of([1, 2, 3, 4], [1, 1, 1, 1], [0, 0, 1, 1]), Reason.TOO_FEW_VISITS),
        (Measurements.of([1.0] * 8, np.repeat([1, 2], 4), [0, 1] * 4), Reason.ALL_EQUAL),
        (Measurements.of([1, 1, 2, 2], [1, 1, 2, 2], [0, 1] * 2), Reason.NO_VARIANCE),
    ],
)
@pytest.mark.parametrize("scale", ["difference", "win_probability"])
def test_what_cannot_be_averaged_has_a_typed_reason(data, reason, scale):
    found = primary(data, scale=scale)
    if reason in (Reason.ALL_EQUAL, Reason.NO_VARIANCE) and scale == "win_probability":
        assert found.p_value == pytest.approx(1.0)  # a share of pairs has a known smallest variance
    else:
        assert isinstance(found, Unavailable)
        assert found.reason is reason


def test_what_only_rounding_of_the_computer_tells_apart_is_equal():
    rounded = Measurements.of([0.1 + 0.2, 0.3] * 4, np.repeat([1, 2], 4), [0, 1] * 4)
    assert primary(rounded) == Unavailable(Reason.ALL_EQUAL)


def test_ratings_that_agree_at_every_visit_are_no_infinite_evidence():
    visit, arms = np.repeat([1, 2, 3], 4), np.tile([False, True], 6)
    same = Measurements.of(np.where(arms, 8, 7), visit, arms, resolution=1)
    found = average(visit_contrasts(same))
    assert found.estimate == 1.0
    assert found.standard_error == pytest.approx(np.sqrt(1 / 12 * (1 / 2 + 1 / 2) / 3))
    assert 0.01 < found.p_value < 0.05
    assert average(visit_contrasts(Measurements.of(np.where(arms, 8, 7), visit, arms))).reason is Reason.NO_VARIANCE


def test_an_unbalanced_order_is_adjusted_for_and_a_balanced_one_is_not():
    late = study(3, visits=6, each=4, drift=1.0, first_cdbs=True)
    assert order_imbalance(late) > 0.2
    assert primary(study(3)).adjustment is Adjustment.NONE
    late = Measurements.of(late.value, late.visit, late.tested, order=np.where(late.tested, late.order + 4, late.order))
    assert primary(late).adjustment is Adjustment.ORDER


def test_the_adjusted_average_is_least_squares_with_visits_and_their_effects_as_columns():
    data = study(4, visits=5, each=4, effect=0.5, drift=0.7, first_cdbs=True)
    levels = (data.visit[:, None] == np.arange(5)).astype(float)
    columns = np.c_[levels, levels * data.tested[:, None], data.order]
    coefficients = np.linalg.lstsq(columns, data.value, rcond=None)[0]
    found = adjusted_average(data, [data.order], Adjustment.ORDER)
    assert found.estimate == pytest.approx(coefficients[5:10].mean())

    def without(v):
        rows = data.visit != v
        keep = [c for c in range(11) if c not in (v, v + 5)]
        return np.linalg.lstsq(columns[np.ix_(rows, keep)], data.value[rows], rcond=None)[0][4:8].mean()

    left_out = np.array([without(v) for v in range(5)])
    assert found.standard_error == pytest.approx(np.sqrt(4 / 5 * np.sum((left_out - left_out.mean()) ** 2)))


def test_without_a_slope_to_find_the_adjustment_is_not_identified():
    data = Measurements.of([1, 2, 3, 4], [1, 1, 2, 2], [0, 1, 0, 1], order=[0, 1, 0, 1])
    assert adjusted_average(data, [data.order], Adjustment.ORDER) == Unavailable(Reason.NOT_IDENTIFIED)


def test_the_adjusted_win_probability_is_that_of_the_values_freed_from_the_slope():
    data = study(5, visits=4, each=4, drift=2.0, first_cdbs=True)
    found = adjusted_average(data, [data.order], Adjustment.ORDER, scale="win_probability")
    centred = [(data.order[r] - data.order[r].mean(), data.value[r] - data.value[r].mean()) for _, a, b in data.arms for r in (a, b)]
    slope = sum(x @ y for x, y in centred) / sum(x @ x for x, _ in centred)
    freed = Measurements.of(data.value - slope * data.order, data.visit, data.tested)
    assert found.estimate == pytest.approx(visit_contrasts(freed, "win_probability").contrast.mean())


def test_days_and_days_of_different_effect_do_not_break_the_level_as_they_break_the_papers_test():
    wrong, naive, number = 0, 0, 400
    rng = np.random.default_rng(11)
    for _ in range(number):
        visit, arms = np.repeat(np.arange(5), 6), np.tile([False, True], 15)
        value = rng.standard_normal(5)[visit] + 1.5 * rng.standard_normal(5)[visit] * arms + rng.standard_normal(30)
        found = primary(Measurements.of(value, visit, arms))
        assert isinstance(found, Average)
        wrong += found.p_value < 0.05
        naive += rank_sum(value[arms], value[~arms]).p_value < 0.05
    assert wrong / number <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / number)
    assert naive / number > 0.08


def test_inputs_that_do_not_fit_together_are_refused_in_words():
    with pytest.raises(ValueError, match="one entry per session"):
        Measurements.of([1, 2], [1], [0, 1])
    with pytest.raises(ValueError, match="infinite value"):
        Measurements.of([np.inf], [1], [0])
    with pytest.raises(ValueError, match="resolution"):
        Measurements.of([1.0], [1], [0], resolution=-1)
    with pytest.raises(ValueError, match="must be between 0 and 1"):
        average(visit_contrasts(study()), 1.0)


SKEWED = np.array([0.1, 0.2, 0.3, 0.4, 3.0, 0.2])


def of_contrasts(values, bounded, order=None):
    """Build a study of visits with these contrasts, one session of either arm."""
    n = len(values)
    value, visit = np.c_[np.zeros(n), values].ravel(), np.repeat(np.arange(n), 2)
    return Measurements.of(value, visit, np.tile([False, True], n), order=order, bounded=bounded)


def test_of_a_metric_with_a_floor_the_larger_p_counts_and_the_interval_holds_both():
    plain, found = primary(of_contrasts(SKEWED, False)), primary(of_contrasts(SKEWED, True))
    freed = skewness_corrected(of_contrasts(SKEWED, False))
    assert plain.skewness == 0.0
    assert found.skewness > 0.3
    assert (found.estimate, found.standard_error) == (plain.estimate, plain.standard_error)
    assert found.p_value == max(plain.p_value, freed.p_value)
    assert (found.low, found.high) == pytest.approx((plain.low, freed.high))
    assert plain.low < freed.low
    assert plain.high < freed.high
    # turned round, nothing changes but the sign
    turned = primary(of_contrasts(-SKEWED, True))
    assert (turned.low, turned.high, turned.p_value) == pytest.approx((-found.high, -found.low, found.p_value))


def test_the_one_sided_p_values_are_those_of_the_interval_of_twice_their_error():
    found = primary(of_contrasts(SKEWED, True), 0.9)
    assert found.p_above(found.low) == pytest.approx(0.05)
    assert found.p_below(found.high) == pytest.approx(0.05)
    plain = primary(of_contrasts(SKEWED, False), 0.9)
    assert found.p_below(1.5) > plain.p_below(1.5)
    assert found.p_above(-0.5) >= plain.p_above(-0.5)


def test_symmetric_contrasts_and_two_visits_have_students_p_whatever_the_metric():
    for values in ([1.0, 2.0, 3.0, 4.0, 5.0], [1.0, 2.5]):
        one, two = primary(of_contrasts(values, True)), primary(of_contrasts(values, False))
        assert (one.low, one.high, one.p_value) == pytest.approx((two.low, two.high, two.p_value))


def test_cliffs_delta_is_bounded_whatever_the_metric():
    data = study(3, visits=6, effect=1.5)
    wins = primary(data, 0.95, "win_probability")
    delta = cliffs_delta(data)
    assert wins.skewness == 0.0
    assert delta.skewness != 0.0
    assert delta.p_value >= wins.p_value
    assert delta.high >= 2 * wins.high - 1 or delta.high == 1.0


def test_contrasts_freed_from_the_order_have_their_own_skewness():
    data = study(2, visits=6, effect=0.3, drift=0.8, first_cdbs=True)
    bounded = Measurements.of(data.value, data.visit, data.tested, order=data.order, bounded=True)
    plain, found = primary(data), primary(bounded)
    assert found.adjustment is plain.adjustment is Adjustment.ORDER
    slope = adjusted_average(data, [data.order], Adjustment.ORDER)
    later = np.array([data.order[one].mean() - data.order[two].mean() for _, one, two in data.arms])
    drift = (visit_contrasts(data).contrast.mean() - slope.estimate) / later.mean()
    freed = visit_contrasts(data).contrast - drift * later
    spread = found.standard_error * np.sqrt(6)
    assert found.skewness == pytest.approx(np.mean((freed - freed.mean()) ** 3) / spread**3)
    assert found.p_value >= plain.p_value


def test_where_a_floor_skews_the_contrasts_the_primary_test_errs_less_often_than_students():
    rng, number = np.random.default_rng(5), 2000
    errs = {True: 0, False: 0}
    for _ in range(number):
        values = rng.exponential(1.0, 6) - 1.0
        for bounded in errs:
            errs[bounded] += primary(of_contrasts(values, bounded)).p_value < 0.05
    assert errs[False] / number > 0.08
    assert errs[True] < 0.85 * errs[False]
