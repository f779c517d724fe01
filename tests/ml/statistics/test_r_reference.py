"""The statistics against R. `tests/data/r-reference.R` made tables with R 4.2.2: coin 1.4-2, lmerTest 3.1-3, lme4 1.1-31, metafor 3.8-1.

The values are stored, so that no R is needed here. Where ties meet groups of unequal size, coin's two-sided p counts every outcome that is
as far from the mean as the observed one. Ours doubles the smaller tail. One-sided p-values are the same number in both.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import rankdata

from ml.statistics.multiplicity import benjamini_hochberg, holm, hommel
from ml.statistics.pooling import paule_mandel, pool_estimates
from ml.statistics.ranksum import p_greater, rank_sum, u_distribution_given_ties
from ml.statistics.within_visits.contrasts import Average, Measurements
from ml.statistics.within_visits.mixed_models import MixedComparison, linear_comparison
from ml.statistics.within_visits.stratified import Method, StratifiedTest, aligned_rank_test, van_elteren

R = json.loads((Path(__file__).parents[2] / "data" / "r-reference.json").read_text())
Row = dict[str, Any]


def rows(table: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("row", R[table], ids=[r.get("name", str(i)) for i, r in enumerate(R[table])])


def test_the_versions_of_r_are_stored_with_its_values() -> None:
    assert R["versions"] == {"R": "4.2.2", "coin": "1.4.2", "lme4": "1.1.31", "lmerTest": "3.1.3", "metafor": "3.8.1"}
    assert (len(R["ranksum"]), len(R["stratified"]), len(R["mixed"])) == (14, 6, 5)


@rows("ranksum")
def test_the_rank_sum_test_is_that_of_coin(row: Row) -> None:
    found = rank_sum(row["x"], row["y"])
    assert found.method == "exact"
    assert p_greater(row["x"], row["y"]) == pytest.approx(row["greater"], abs=1e-12)
    assert p_greater(row["y"], row["x"]) == pytest.approx(row["less"], abs=1e-12)
    assert found.p_value == pytest.approx(min(1.0, 2 * min(row["greater"], row["less"])), abs=1e-12)
    symmetric = len(row["x"]) == len(row["y"]) or len({*row["x"], *row["y"]}) == len(row["x"]) + len(row["y"])
    if symmetric:
        assert found.p_value == pytest.approx(row["two_sided"], abs=1e-12)


@rows("ranksum")
def test_the_distribution_gives_coins_own_two_sided_p(row: Row) -> None:
    sizes = np.unique(rankdata([*row["x"], *row["y"]]), return_counts=True)[1]
    probability = u_distribution_given_ties(len(row["x"]), tuple(int(s) for s in sizes))
    centre = len(row["x"]) * len(row["y"]) / 2
    away = np.abs(np.arange(probability.size) / 2 - centre)
    observed = abs(rank_sum(row["x"], row["y"]).u - centre)
    assert probability[away >= observed - 1e-9].sum() == pytest.approx(row["two_sided"], abs=1e-12)


@pytest.mark.parametrize(
    "row", [r for r in R["ranksum"] if r["low"] is not None and r["name"].startswith("no ties")], ids=lambda r: r["name"]
)
def test_shift_and_interval_without_ties_are_those_of_coin(row: Row) -> None:
    found = rank_sum(row["x"], row["y"])
    assert (found.low, found.shift, found.high) == pytest.approx((row["low"], row["shift"], row["high"]))


@rows("stratified")
def test_the_tests_that_shuffle_within_visits_are_those_of_coin(row: Row) -> None:
    data = Measurements.of(row["value"], row["visit"], np.array(row["tested"]) == 1)
    for expected, test in ((row["van_elteren"], van_elteren), (row["aligned"], aligned_rank_test)):
        if expected is None:
            continue
        found = test(data)
        assert isinstance(found, StratifiedTest)
        assert found.method is Method.EXACT
        assert (found.p_greater, found.p_less) == pytest.approx((expected["greater"], expected["less"]), abs=1e-9)


@rows("mixed")
def test_the_linear_mixed_model_is_that_of_lmer(row: Row) -> None:
    data = Measurements.of(row["value"], row["visit"], np.array(row["tested"]) == 1)
    found = linear_comparison(data, np.array(row["policy"]))
    assert isinstance(found, MixedComparison)
    assert found.effect.estimate == pytest.approx(row["estimate"], abs=1e-4)
    assert found.effect.standard_error == pytest.approx(row["error"], rel=1e-3)
    assert (found.visit_sd, found.session_sd) == pytest.approx((row["visit_sd"], row["session_sd"]), rel=1e-3)
    assert found.slope_sd == pytest.approx(row["slope_sd"], rel=1e-3, abs=0.02)
    # Satterthwaite's degrees, but never more than one fewer than visits
    assert found.effect.degrees == pytest.approx(min(row["satterthwaite"], len({*row["visit"]}) - 1), rel=0.02)
    assert (found.policy_sd is None) == (row["policy_sd"] is None)
    if row["policy_sd"] is not None:
        assert found.policy_sd == pytest.approx(row["policy_sd"], rel=1e-3)


@rows("adjusted")
def test_adjusted_p_values_are_those_of_p_adjust(row: Row) -> None:
    assert holm(row["p"]) == pytest.approx(row["holm"])
    assert hommel(row["p"]) == pytest.approx(row["hommel"])
    assert benjamini_hochberg(row["p"]) == pytest.approx(row["BH"])


@rows("pooled")
def test_the_random_effects_summary_is_that_of_metafor(row: Row) -> None:
    estimates, errors = np.array(row["y"], dtype=float), np.array(row["se"], dtype=float)
    assert paule_mandel(estimates, errors) == pytest.approx(row["tau2"], rel=1e-6, abs=1e-9)
    found = pool_estimates(estimates, errors)
    assert not isinstance(found, Average)
    assert (found.estimate, found.low, found.high, found.p_value) == pytest.approx(
        (row["estimate"], row["low"], row["high"], row["p"]), rel=1e-6
    )
