from __future__ import annotations

import numpy as np
import pytest

from ml.ope.compare.ranking import default_method, probability_best, rank_policies
from ml.ope.estimate import Estimate
from ml.ope.registry import estimators
from ml.ope.support.coverage import AmplitudeSupport, effective_sample_size
from ml.policies.policy import ConstantPolicy


def estimate(value, se=1.0, supported=True, draws=None, method="dlsm"):
    details = {} if draws is None else {"draws": list(draws)}
    return Estimate(method, value, value - se, value + se, 0.9, se, value, None, {}, supported, (), 10, details)


def test_a_policy_below_every_logged_amplitude_is_not_supported_and_the_flag_says_why(small_buffer):
    support = AmplitudeSupport(small_buffer)
    seen = {"none": support.of_policy(ConstantPolicy(0.0)), "half": support.of_policy(ConstantPolicy(0.5))}
    assert not seen["none"].supported
    assert seen["none"].outside_range == 1.0
    assert (seen["none"].flags()[0].code, seen["none"].flags()[0].value, seen["none"].flags()[0].refuses) == ("thin", 1.0, True)
    assert seen["half"].supported
    assert not any(flag.refuses for flag in seen["half"].flags())


def test_an_amplitude_inside_the_range_but_in_a_gap_of_the_data_counts_as_thin(small_buffer):
    support = AmplitudeSupport(small_buffer)
    support.sorted_actions = np.sort(np.r_[np.zeros(500), np.full(500, 1.0)])
    seen = support.look(np.full(10, 0.5))
    assert seen.outside_range == 0.0
    assert seen.thin == 1.0
    assert support.look(np.array([0.0, 1.0])).thin == 0.0


def test_the_effective_sample_size_counts_equal_weights_and_survives_tiny_ones():
    assert effective_sample_size(np.full(7, -5000.0)) == pytest.approx((7.0, 1 / 7))
    assert effective_sample_size(np.array([-9000.0, -9800.0])) == pytest.approx((1.0, 1.0))
    assert effective_sample_size(np.log([3.0, 1.0])) == pytest.approx((16 / 10, 0.75))
    assert effective_sample_size(np.full(3, -np.inf)) == (0.0, 1.0)


def test_a_policy_that_the_data_do_not_support_never_stands_above_one_that_they_do():
    table = {"dlsm": {"a": estimate(1.0), "wild": estimate(99.0, supported=False), "b": estimate(2.0)}}
    ranked = rank_policies(table)
    assert [(r.policy, r.rank) for r in ranked] == [("b", 1), ("a", 2), ("wild", 3)]
    assert ranked[2].probability_best == 0.0
    assert sum(r.probability_best for r in ranked) == pytest.approx(1.0)


def test_errors_that_all_policies_share_do_not_blur_which_is_best():
    shared = np.random.default_rng(0).normal(0, 10, 200)
    kept = {"a": estimate(1.0, 10.0, draws=1 + shared), "b": estimate(2.0, 10.0, draws=2 + shared)}
    assert probability_best(kept)["b"] == 1.0
    independent = {"a": estimate(1.0, 10.0), "b": estimate(2.0, 10.0)}
    assert 0.4 < probability_best(independent)["b"] < 0.7


def test_two_normals_have_the_probability_of_the_closed_form():
    # P(N(1, 1) > N(0, 1)) = Phi(1 / sqrt 2) = 0.760
    assert probability_best({"a": estimate(1.0), "b": estimate(0.0)}, draws=40_000)["a"] == pytest.approx(0.760, abs=0.01)


def test_the_ranking_rests_on_the_first_method_that_supports_a_policy():
    supported, not_supported = {"a": estimate(1.0)}, {"a": estimate(1.0, supported=False)}
    assert default_method({"pdis": supported, "dlsm": supported}) == "dlsm"
    assert default_method({"dlsm": supported, "linear": supported}) == "linear"
    assert default_method({"dlsm": supported, "linear": not_supported}) == "dlsm"
    assert default_method({"dlsm": not_supported, "pdis": not_supported}) == "dlsm"
    with pytest.raises(ValueError, match="at least one method"):
        default_method({"dlsm": {}})


def test_the_panel_names_its_methods_by_the_keys_of_the_ranking():
    panel = estimators(demo=True)
    models = ["dlsm", "dlsm_paper", "linear", "impulse", "dlmm"]
    assert list(panel) == [*models, "fqe", "wdr", "dual_dice", "wis", "pdis", "cwpdis", "posterior"]
    assert all(e.method == key for key, e in panel.items())


def test_an_estimate_that_is_not_a_number_is_refused_where_it_is_made():
    with pytest.raises(ValueError, match="value of an estimate must be finite"):
        estimate(float("nan"))
