"""Exact tests within visits against enumeration of every shuffling; the interval against the test it inverts."""

from __future__ import annotations

from functools import reduce
from itertools import combinations, product
from math import gcd

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu, rankdata

from ml.statistics.ranksum import rank_sum
from ml.statistics.within_visits import stratified
from ml.statistics.within_visits.contrasts import Measurements, Reason, Unavailable
from ml.statistics.within_visits.stratified import Method, aligned_rank_test, shift_interval, van_elteren


def shufflings(data, score):
    """Compute the statistic as observed, and of every way to share each visit's scores out between the arms."""
    observed, every = 0.0, []
    for v in np.unique(data.visit):
        rows = data.visit == v
        scores, arms = score(v)[rows], data.tested[rows]
        observed += scores[arms].sum()
        every.append([scores[list(c)].sum() for c in combinations(range(scores.size), int(arms.sum()))])
    return observed, np.array([sum(c) for c in product(*every)])


def p_of(observed, every):
    greater, less = np.mean(every >= observed - 1e-9), np.mean(every <= observed + 1e-9)
    return min(1.0, 2 * min(greater, less)), greater, less


def van_elteren_scores(data):
    sizes = [int(np.sum(data.visit == v)) + 1 for v in np.unique(data.visit)]
    weights = [round(16 * max(sizes) / s) for s in sizes]
    common = reduce(gcd, weights)

    def score(v):
        ranks = np.zeros(data.value.size)
        rows = data.visit == v
        weight = weights[np.unique(data.visit).tolist().index(v)] / common
        ranks[rows] = weight * rankdata(data.value[rows])
        return ranks

    return score


def aligned_scores(data):
    residual = data.value.astype(float).copy()
    for v in np.unique(data.visit):
        residual[data.visit == v] -= residual[data.visit == v].mean()
    ranks = rankdata(np.round(residual, 9))
    return lambda v: ranks


values = st.lists(st.integers(0, 3), min_size=10, max_size=10)


@settings(max_examples=25, deadline=None)
@given(values, st.lists(st.booleans(), min_size=10, max_size=10))
def test_with_ties_and_unequal_visits_both_tests_are_those_of_enumeration(numbers, arms):
    visit = np.repeat([1, 2, 3], [3, 5, 2])
    arms = np.array(arms)
    for v, first in ((1, 0), (2, 3), (3, 8)):  # both arms at every visit
        arms[first], arms[first + 1] = True, False
        assert visit[first] == v
    data = Measurements.of(numbers, visit, arms)
    for test, scores in ((van_elteren, van_elteren_scores), (aligned_rank_test, aligned_scores)):
        found = test(data)
        assert found.method is Method.EXACT
        assert (found.p_value, found.p_greater, found.p_less) == pytest.approx(p_of(*shufflings(data, scores(data))), abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_one_visit_is_the_rank_sum_test(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=6), rng.normal(0.8, 1, 7)
    data = Measurements.of(np.r_[x, y], np.ones(13), np.r_[np.ones(6), np.zeros(7)])
    assert van_elteren(data).p_value == pytest.approx(mannwhitneyu(x, y, method="exact").pvalue)
    theirs, ours = rank_sum(x, y), shift_interval(data)
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high))
    assert ours.estimate == pytest.approx(theirs.shift)


def test_days_that_differ_change_nothing():
    rng = np.random.default_rng(1)
    visit, arms = np.repeat(np.arange(4), 6), np.tile([False, True], 12)
    value = rng.normal(size=24)
    plain, moved = (van_elteren(Measurements.of(v, visit, arms)) for v in (value, value + 100.0 * visit))
    assert plain == moved


@pytest.mark.parametrize("tied", [False, True])
def test_the_interval_holds_the_shifts_that_the_test_does_not_reject(tied):
    rng = np.random.default_rng(4)
    visit, arms = np.repeat(np.arange(4), [5, 6, 7, 4]), rng.permutation(np.tile([False, True], 11))
    value = np.round(2 * rng.normal(size=22)) if tied else rng.normal(size=22)
    data = Measurements.of(value, visit, arms)
    found = shift_interval(data)
    tests = {s: van_elteren(Measurements.of(np.round(value - s * arms, 12), visit, arms)) for s in np.linspace(-6, 6, 241).round(3)}
    accepted = [s for s, t in tests.items() if min(t.p_greater, t.p_less) > 0.025]
    assert found.low <= min(accepted)
    assert found.high >= max(accepted)
    assert all(s in accepted for s in tests if found.low + 0.06 < s < found.high - 0.06 and not tied)
    assert found.high - max(accepted) < (1.01 if tied else 0.06)


def test_too_few_sessions_for_an_end_of_the_interval_leave_it_open():
    found = shift_interval(Measurements.of([1.0, 2.0, 4.0, 3.0], [1, 1, 2, 2], [0, 1, 0, 1]))
    assert (found.low, found.high) == (-np.inf, np.inf)


def test_shufflings_at_random_come_near_the_exact_p_and_never_below_one_in_all(monkeypatch):
    rng = np.random.default_rng(2)
    visit, arms = np.repeat(np.arange(4), 8), np.tile([False, True], 16)
    data = Measurements.of(rng.normal(size=32) + 0.7 * arms, visit, arms)
    far = Measurements.of(rng.normal(size=32) + 100.0 * arms, visit, arms)
    exact = van_elteren(data)
    monkeypatch.setattr(stratified, "LARGEST_LATTICE", 0)
    drawn = van_elteren(data, seed=3)
    assert drawn.method is Method.MONTE_CARLO
    assert drawn.p_value == pytest.approx(exact.p_value, abs=0.012)
    assert van_elteren(data, seed=3) == drawn
    assert van_elteren(far).p_greater == 1 / (stratified.DRAWS + 1)


def test_the_distribution_of_large_visits_is_that_of_random_shufflings(monkeypatch):
    rng = np.random.default_rng(6)
    visit, arms = np.repeat(np.arange(10), 20), rng.random(200) < 0.4
    data = Measurements.of(rng.integers(1, 11, 200) + 0.4 * arms.round(), visit, arms)
    exact = aligned_rank_test(data), van_elteren(data)
    assert {t.method for t in exact} == {Method.EXACT}
    monkeypatch.setattr(stratified, "LARGEST_LATTICE", 0)
    for found, drawn in zip(exact, (aligned_rank_test(data), van_elteren(data)), strict=True):
        assert drawn.p_greater == pytest.approx(found.p_greater, abs=0.02)


@pytest.mark.parametrize("test", [van_elteren, aligned_rank_test, shift_interval])
def test_no_visit_with_both_arms_is_a_typed_answer(test):
    assert test(Measurements.of([1, 2], [1, 2], [0, 1])) == Unavailable(Reason.NO_VISIT_WITH_BOTH_ARMS, 0, 1)
    assert test(Measurements.of([], [], [])).reason is Reason.NO_SESSION


def test_all_values_equal_say_nothing():
    data = Measurements.of(np.ones(12), np.repeat([1, 2], 6), [0, 1] * 6)
    assert van_elteren(data).p_value == aligned_rank_test(data).p_value == 1.0
    found = shift_interval(data)
    assert found.estimate == 0.0
    assert found.low <= 0 <= found.high


def test_without_ties_the_counted_ends_are_those_of_asking_every_place():
    rng = np.random.default_rng(8)
    for _ in range(10):
        visit = np.repeat(np.arange(4), [4, 9, 6, 5])
        arms = np.concatenate([rng.permutation(np.resize([False, True, True], n)) for n in (4, 9, 6, 5)])
        data = Measurements.of(rng.normal(size=24), visit, arms)
        found = shift_interval(data)
        strata = stratified._strata(data)
        weights = stratified._weights(strata)
        assert len(set(weights)) > 1
        knots = np.sort(np.concatenate([np.subtract.outer(x, y).ravel() for x, y in strata]))
        asked = stratified._Inversion(strata, weights, knots, 0.025, 0)
        assert (found.low, found.high) == (asked.end(upper=False), asked.end(upper=True))


def test_the_interval_of_shufflings_at_random_comes_near_the_exact_one(monkeypatch):
    rng = np.random.default_rng(9)
    data = Measurements.of(rng.normal(size=60), np.repeat(np.arange(6), 10), np.tile([False, True], 30))
    exact = shift_interval(data)
    monkeypatch.setattr(stratified, "LARGEST_LATTICE", 0)
    drawn = shift_interval(data)
    assert drawn.method is Method.MONTE_CARLO
    assert (drawn.low, drawn.high) == pytest.approx((exact.low, exact.high), abs=0.15)


@pytest.mark.parametrize(
    "sizes", [[(n, m)] for n in range(1, 5) for m in range(1, 5)] + [[(1, 1), (2, 1)], [(2, 2), (1, 2)], [(1, 1), (1, 1), (2, 1)]]
)
def test_the_interval_covers_as_often_as_its_label_says_over_all_rankings_within_visits(sizes: list[tuple[int, int]]) -> None:
    visit = np.concatenate([np.full(n + m, v) for v, (n, m) in enumerate(sizes)])
    value = np.arange(visit.size, dtype=float)
    hits = []
    for chosen in product(*[list(combinations(range(n + m), n)) for n, m in sizes]):
        tested = np.concatenate([np.isin(np.arange(n + m), own) for (n, m), own in zip(sizes, chosen, strict=True)])
        found = shift_interval(Measurements.of(value, visit, tested), 0.95)
        hits.append(found.low <= 0.0 <= found.high)
    assert np.mean(hits) >= 0.95
