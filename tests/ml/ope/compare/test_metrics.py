from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy.stats import spearmanr

from ml.ope.compare.metrics import accuracy, spearman, spearman_p


def test_spearman_is_scipys_with_and_without_ties():
    rng = np.random.default_rng(0)
    for _ in range(10):
        x, y = rng.integers(0, 6, 9), rng.normal(size=9)
        assert spearman(x, y) == pytest.approx(spearmanr(x, y).statistic)


def test_the_permutation_p_value_of_six_policies_is_that_of_counting():
    x, y = np.array([1.0, 2, 3, 4, 5, 6]), np.array([1.0, 2, 3, 4, 6, 5])
    observed = abs(spearmanr(x, y).statistic)
    counted = np.mean([abs(spearmanr(x, y[list(p)]).statistic) >= observed - 1e-12 for p in permutations(range(6))])
    assert spearman_p(x, y) == pytest.approx(counted)
    assert spearman_p(x, x) == pytest.approx(2 / 720)


def test_sampled_permutations_agree_with_scipys_p_value():
    rng = np.random.default_rng(1)
    x = rng.normal(size=14)
    y = x + 1.5 * rng.normal(size=14)
    assert spearman_p(x, y) == pytest.approx(spearmanr(x, y).pvalue, abs=0.02)


def test_regret_is_what_picking_by_the_estimates_loses():
    result = accuracy([10.0, 30.0, 20.0], [5.0, 1.0, 9.0])
    assert result.regret == 10.0
    assert result.regret_of_range == 0.5
    assert result.regret_as_paper == pytest.approx(1 / 3)
    assert result.mae == pytest.approx((5 + 29 + 11) / 3)
    assert result.mae_of_range == pytest.approx((5 + 29 + 11) / 60)


def test_the_papers_regret_changes_sign_with_the_return_and_the_range_normalised_one_does_not():
    result = accuracy([-10.0, -30.0, -20.0], [0.0, 2.0, 1.0])
    assert result.regret_as_paper == pytest.approx(-2.0)
    assert result.regret_of_range == 1.0


def test_equal_returns_have_no_rank_and_no_range():
    result = accuracy([1.0, 1.0], [0.0, 2.0])
    assert result.rank_correlation is None
    assert result.rank_p is None
    assert result.regret_of_range is None


def test_returns_of_unequal_number_are_refused():
    with pytest.raises(ValueError, match="one actual and one estimated return"):
        accuracy([1.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="finite"):
        accuracy([1.0, np.nan], [1.0, 2.0])
