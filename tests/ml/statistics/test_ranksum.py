from __future__ import annotations

from itertools import combinations, product
from math import comb

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from ml.statistics.ranksum import RankSum, as_in_the_paper, p_greater, rank_sum, u_distribution
from ml.statistics.within_visits.contrasts import Measurements, Reason, Unavailable


@pytest.mark.parametrize(("n_x", "n_y"), [(1, 1), (2, 5), (4, 4), (5, 3)])
def test_the_exact_distribution_is_that_of_counting_every_assignment_of_ranks(n_x, n_y):
    counts = np.zeros(n_x * n_y + 1)
    for ranks in combinations(range(1, n_x + n_y + 1), n_x):
        counts[sum(ranks) - n_x * (n_x + 1) // 2] += 1
    np.testing.assert_allclose(u_distribution(n_x, n_y), counts / counts.sum(), rtol=1e-12)


@pytest.mark.parametrize(("n_x", "n_y", "seed"), [(3, 4, 0), (8, 8, 1), (12, 7, 2), (30, 40, 3)])
def test_without_ties_the_exact_p_value_is_scipys(n_x, n_y, seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0.4, 1, n_x), rng.normal(0, 1, n_y)
    ours, theirs = rank_sum(x, y), mannwhitneyu(x, y, method="exact")
    assert ours.method == "exact"
    assert ours.u == theirs.statistic
    assert ours.p_value == pytest.approx(theirs.pvalue, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_with_ties_the_normal_approximation_is_scipys(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.integers(1, 11, 55), rng.integers(2, 11, 60)
    ours, theirs = rank_sum(x, y), mannwhitneyu(x, y, method="asymptotic", use_continuity=True)
    assert ours.method == "normal approximation"
    assert ours.p_value == pytest.approx(theirs.pvalue, rel=1e-9)


def test_large_groups_use_the_normal_approximation_and_say_so():
    rng = np.random.default_rng(5)
    x, y = rng.normal(size=60), rng.normal(size=60)
    ours, theirs = rank_sum(x, y), mannwhitneyu(x, y, method="asymptotic")
    assert ours.method == "normal approximation"
    assert ours.p_value == pytest.approx(theirs.pvalue, rel=1e-9)


def test_identical_ratings_on_both_sides_have_p_one():
    assert rank_sum([7, 7, 7], [7, 7]).p_value == 1.0


def test_the_shift_is_the_median_of_all_pairwise_differences():
    result = rank_sum([1.0, 4.0, 9.0], [0.0, 2.5])
    assert result.shift == np.median([1, -1.5, 4, 1.5, 9, 6.5])
    assert result.superiority == pytest.approx(5 / 6)
    assert (result.n_x, result.n_y, result.median_x, result.median_y) == (3, 2, 4.0, 1.25)


def test_the_interval_of_the_shift_holds_exactly_the_shifts_that_the_test_does_not_reject():
    rng = np.random.default_rng(6)
    x, y = rng.normal(0.5, 1, 9), rng.normal(0, 1, 8)
    result = rank_sum(x, y, level=0.9)
    for shift in np.linspace(result.low - 1, result.high + 1, 301):
        rejected = mannwhitneyu(x - shift, y, method="exact").pvalue <= 0.1
        assert rejected == (not result.low < shift < result.high)


def test_the_interval_of_the_shift_covers_the_true_shift_as_often_as_it_says():
    rng = np.random.default_rng(1)
    results = [rank_sum(rng.normal(1, 1, 7), rng.normal(0, 1, 9), level=0.9) for _ in range(1500)]
    assert 0.89 <= np.mean([r.low <= 1 <= r.high for r in results]) <= 0.96


def test_the_papers_test_takes_all_sessions_whatever_their_visit_and_leaves_missing_values_out():
    value, visit, arms = [1.0, 2.0, np.nan, 4.0, 3.5], [1, 1, 1, 2, 3], [0, 0, 1, 1, 1]
    assert as_in_the_paper(Measurements.of(value, visit, arms)) == rank_sum([4.0, 3.5], [1.0, 2.0])
    assert as_in_the_paper(Measurements.of(value[:3], visit[:3], arms[:3])) == Unavailable(Reason.NO_SESSION, 0, 1)
    assert as_in_the_paper(Measurements.of([], [], [])).reason is Reason.NO_SESSION


def test_an_empty_group_and_a_missing_measurement_are_refused_in_words():
    with pytest.raises(ValueError, match="second group has no session"):
        rank_sum([1.0], [])
    with pytest.raises(ValueError, match="leave sessions without a measurement out"):
        rank_sum([1.0, np.nan], [2.0])


def test_the_one_sided_p_value_of_complete_separation_is_one_over_the_number_of_rankings():
    assert p_greater([5, 6, 7, 8], [1, 2, 3, 4]) == pytest.approx(1 / comb(8, 4))
    assert p_greater([1, 2, 3, 4], [5, 6, 7, 8]) == pytest.approx(1.0)


def test_the_two_one_sided_p_values_cover_everything_and_share_the_observed_ranking():
    x, y = [1.0, 4.0, 6.0], [2.0, 3.0, 5.0, 7.0]
    probability = u_distribution(3, 4)[round(rank_sum(x, y).u)]
    assert p_greater(x, y) + p_greater(y, x) == pytest.approx(1 + probability)


SIZES = [(n, m) for n in range(1, 7) for m in range(1, 7)]


def covers(found: RankSum, shift: float) -> bool:
    """Check whether the interval holds a shift; one that does not exist leaves every shift open."""
    return found.low is None or found.high is None or found.low <= shift <= found.high


@pytest.mark.parametrize("level", [0.8, 0.95, 0.99])
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_the_interval_covers_as_often_as_its_label_says_over_all_rankings(n: int, m: int, level: float) -> None:
    everyone = np.arange(n + m, dtype=float)
    found = [rank_sum(everyone[list(own)], np.delete(everyone, own), level) for own in combinations(range(n + m), n)]
    assert np.mean([covers(f, 0.0) for f in found]) >= level - 1e-12
    # there is one exactly where the widest possible one has the level
    widest = 1 - 2 / comb(n + m, n)
    assert {f.low is not None for f in found} == {f.high is not None for f in found} == {widest >= level - 1e-12}


@pytest.mark.parametrize(("n", "m"), [(2, 2), (2, 3), (3, 3), (2, 5), (3, 4)])
def test_sizes_that_cannot_have_95_percent_have_no_interval(n: int, m: int) -> None:
    found = rank_sum(np.arange(n), 0.5 + np.arange(m))
    assert (found.low, found.high, found.shift) == (None, None, found.shift)
    assert np.isfinite(found.shift)


@pytest.mark.parametrize("level", [0.9, 0.95])
def test_with_ties_the_interval_covers_at_least_as_often_over_all_outcomes(level: float) -> None:
    # four sessions against four, each of three values with equal chances
    hits = [covers(rank_sum(outcome[:4], outcome[4:], level), 0.0) for outcome in product((0.0, 1.0, 2.0), repeat=8)]
    assert np.mean(hits) >= level


def test_one_session_against_thousands_has_the_widest_interval_that_its_level_allows() -> None:
    many = np.arange(3000, dtype=float)
    found = rank_sum([1500.5], many)
    assert (found.low, found.high) == (1500.5 - 2999, 1500.5)
    assert rank_sum([1500.5], many, level=0.9999).low is None
