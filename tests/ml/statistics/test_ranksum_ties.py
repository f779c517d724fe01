"""The rank-sum test with ties against enumeration of every way to share the values out."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import permutation_test, rankdata

from ml.statistics.ranksum import rank_sum, u_distribution_given_ties


def enumerated_p(x: list[float], y: list[float]) -> float:
    """Compute the two-sided p: twice the smaller tail of U over every choice of the first group."""
    pooled = np.array([*x, *y])
    us = []
    for chosen in combinations(range(pooled.size), len(x)):
        first = pooled[list(chosen)]
        second = np.delete(pooled, list(chosen))
        us.append(np.sum(first[:, None] > second) + 0.5 * np.sum(first[:, None] == second))
    observed = np.sum(np.array(x)[:, None] > np.array(y)) + 0.5 * np.sum(np.array(x)[:, None] == np.array(y))
    everything = np.array(us)
    return float(min(1.0, 2 * min(np.mean(everything >= observed - 1e-9), np.mean(everything <= observed + 1e-9))))


@settings(max_examples=60, deadline=None)
@given(x=st.lists(st.integers(0, 4), min_size=1, max_size=5), y=st.lists(st.integers(0, 4), min_size=1, max_size=5))
def test_the_exact_p_is_that_of_enumeration_ties_or_not(x: list[int], y: list[int]) -> None:
    result = rank_sum(x, y)
    assert result.method == "exact"
    assert result.p_value == pytest.approx(enumerated_p([float(v) for v in x], [float(v) for v in y]), abs=1e-12)


@pytest.mark.parametrize(
    ("x", "y"),
    [([7, 7, 8, 6], [6, 6, 7, 5, 8]), ([1, 1, 1], [1, 2, 2, 3]), ([5, 5, 5, 9], [5, 5, 5, 5, 1]), ([0, 0, 0, 4, 4], [0, 0, 4, 4, 4])],
)
def test_the_exact_p_of_ratings_is_that_of_scipys_permutation_test(x: list[int], y: list[int]) -> None:
    ranks = rankdata([*x, *y])
    found = permutation_test(
        (ranks[: len(x)], ranks[len(x) :]),
        lambda first, _: first.sum(),
        permutation_type="independent",
        n_resamples=np.inf,
        vectorized=False,
    )
    assert rank_sum(x, y).p_value == pytest.approx(found.pvalue, abs=1e-12)


def test_all_values_equal_says_nothing() -> None:
    assert rank_sum([1.0] * 4, [1.0] * 6).p_value == 1.0


def test_cdbs_energies_that_are_all_one_cannot_give_less_than_the_smallest_possible_p() -> None:
    assert rank_sum([0.4, 0.5, 0.45], [1.0] * 11).p_value == pytest.approx(2 / 364)


def test_the_tied_distribution_sums_to_one_and_is_symmetric_for_symmetric_ties() -> None:
    p = u_distribution_given_ties(3, (2, 1, 2, 1, 2))
    assert p.sum() == pytest.approx(1.0)
    assert p == pytest.approx(p[::-1])


@pytest.mark.parametrize(("n_x", "sizes"), [(6, (3, 2, 4)), (2, (3, 2, 4)), (5, (1, 1, 5, 1, 1))])
def test_whichever_group_is_the_larger_every_choice_of_it_counts_the_same(n_x: int, sizes: tuple[int, ...]) -> None:
    pooled = np.repeat(np.arange(len(sizes)), sizes)
    counts = np.zeros(2 * n_x * (pooled.size - n_x) + 1)
    for chosen in combinations(range(pooled.size), n_x):
        x, y = pooled[list(chosen)], np.delete(pooled, list(chosen))
        counts[2 * np.sum(x[:, None] > y) + np.sum(x[:, None] == y)] += 1
    assert u_distribution_given_ties(n_x, sizes) == pytest.approx(counts / counts.sum(), abs=1e-14)
