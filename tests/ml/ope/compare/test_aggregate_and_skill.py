from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from ml.faults import BROKE
from ml.ope.compare.aggregate import combine, convex_weights, error_matrix
from ml.ope.compare.skill import Prediction, held_out_skill, skills, with_held_out_error
from ml.ope.estimate import Estimate, checked_horizon
from ml.ope.fqe.estimator import Fqe, FqeConfig
from ml.ope.linear.estimator import LinearConfig, LinearModel
from ml.policies.policy import ConstantPolicy
from ml.qoc import Qoc


def estimate(value, draws, method="linear", supported=True, resampled=None):
    draws = np.asarray(draws, dtype=np.float64)
    spread = float(draws.std()) or 1.0
    details = {"draws": [float(d) for d in draws], "resampled": resampled}
    return Estimate(method, value, value - spread, value + spread, 0.9, spread, value, None, {}, supported, (), 9, details)


def test_weights_are_those_of_the_quadratic_programme():
    rng = np.random.default_rng(0)
    for _ in range(5):
        half = rng.normal(size=(4, 6))
        errors = half @ half.T
        found = minimize(
            lambda w, a=errors: w @ a @ w,
            np.full(4, 0.25),
            bounds=[(0, 1)] * 4,
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
            options={"ftol": 1e-12},
        )
        weights = convex_weights(errors)
        assert weights @ errors @ weights == pytest.approx(found.fun, rel=1e-4)
        assert weights.sum() == pytest.approx(1.0)
        assert (weights >= 0).all()


def test_two_independent_methods_are_weighted_by_their_inverse_variances():
    assert convex_weights(np.diag([1.0, 4.0])) == pytest.approx([0.8, 0.2], abs=1e-4)


def test_known_bias_moves_weight_to_the_other_method_and_shared_draws_count_as_covariance():
    rng = np.random.default_rng(1)
    shared = rng.normal(size=100)
    near = shared + 0.1 * rng.normal(size=100)

    def covariance(one, other):
        tables = {"a": {"p": estimate(1.0, shared, resampled=one)}, "b": {"p": estimate(3.0, near, "b", resampled=other)}}
        return error_matrix(tables, ["a", "b"])

    matrix = covariance("9 sessions, seed 0", "9 sessions, seed 0")
    assert matrix[0, 1] == pytest.approx(matrix[0, 0], rel=0.2)
    # draws that were not made on the same sessions have nothing in common but their number
    assert covariance("9 sessions, seed 0", "8 sessions, seed 0")[0, 1] == covariance(None, None)[0, 1] == 0
    tables = {"a": {"p": estimate(1.0, shared)}, "b": {"p": estimate(3.0, near, "b")}}
    assert combine(tables, {"a": 0.0, "b": 5.0})["p"].details["weights"]["a"] > 0.95
    assert combine(tables, {"a": 5.0, "b": 0.0})["p"].value > 2.8


def test_methods_that_disagree_widen_the_combined_interval():
    rng = np.random.default_rng(2)
    tables = {"a": {"p": estimate(0.0, 0.1 * rng.normal(size=60))}, "b": {"p": estimate(10.0, 0.1 * rng.normal(size=60), "b")}}
    combined = combine(tables)["p"]
    assert combined.low < 0.5 < 9.5 < combined.high
    assert combined.method == "aggregate"


def test_a_method_that_supports_no_policy_takes_no_part():
    draws = np.random.default_rng(3).normal(size=50)
    tables = {"a": {"p": estimate(1.0, draws)}, "is": {"p": estimate(9.0, 0.001 * draws, "is", supported=False)}}
    assert combine(tables)["p"].value == 1.0
    with pytest.raises(ValueError, match="no method supports"):
        combine({"is": tables["is"]})


def test_fitted_methods_combine_to_an_estimate_among_theirs(small_buffer):
    parts = {"linear": LinearModel(LinearConfig(draws=20)), "fqe": Fqe(FqeConfig(members=1, refits=20))}
    policies = {"half": ConstantPolicy(0.5), "full": ConstantPolicy(1.0)}
    tables = {name: part.fit(small_buffer).evaluate(policies, 30) for name, part in parts.items()}
    found, single = combine(tables), [table["half"].value for table in tables.values()]
    assert min(single) <= found["half"].value <= max(single)
    assert sum(found["half"].details["weights"].values()) == pytest.approx(1.0, abs=1e-3)


def test_skill_numbers_are_those_of_counting_by_hand():
    said, seen = [1.0, 5.0, 2.0], [0.0, 4.0, 2.0]
    rows = tuple(Prediction("m", str(i), 1, a, b, None, True) for i, (a, b) in enumerate(zip(said, seen, strict=True)))
    skill = skills(rows)[0]
    assert skill.error == pytest.approx((1 + 1 + 0) / 3 / 4)
    assert skill.bias == pytest.approx(np.sqrt(2 / 3))
    assert skill.difference_error == pytest.approx((0 + 1 + 1) / 3 / 4)
    assert skill.pairs_in_order == 1.0
    assert skill.rank_correlation == 1.0


def test_predictions_that_are_all_off_by_the_same_amount_lose_nothing_in_the_table():
    rows = tuple(Prediction("m", str(i), 1, v + 50.0, v, None, True) for i, v in enumerate([0.0, 1.0, 3.0]))
    assert skills(rows)[0].difference_error == pytest.approx(0.0)


def test_the_method_that_predicts_left_out_controllers_is_first_in_the_table(linear_simulator):
    class Backwards:
        """Says the opposite of a linear model."""

        method = "fqe"

        def fit(self, buffer, report=None, checkpoint_dir=None):
            self.inner = LinearModel(LinearConfig(draws=20)).fit(buffer)
            return self

        def evaluate(self, policies, horizon_steps=None, report=None):
            found = self.inner.evaluate(policies, horizon_steps)
            return {n: replace(e, value=-e.value, step_return=-e.step_return) for n, e in found.items()}

    buffer = linear_simulator.buffer(seed=0, n=16, steps=100)
    candidates = {"fqe": Backwards(), "linear": LinearModel(LinearConfig(draws=20))}
    held = held_out_skill(buffer, candidates, aggregate=False)
    assert held.table[0].method == "linear"
    assert held.table[0].difference_error < held.table[1].difference_error
    assert {p.controller for p in held.predictions} == {"random", "cdbs", "rl", "other"}
    json.dumps(held.to_json())


def test_a_method_that_cannot_work_is_named_with_its_reason(small_buffer):
    class Refusing:
        method = "dlsm"

        def fit(self, buffer, report=None, checkpoint_dir=None):
            checked_horizon(buffer, 0)

    class Broken:
        method = "fqe"

        def fit(self, buffer, report=None, checkpoint_dir=None):
            np.linalg.cholesky(-np.eye(2))

    bare = replace(small_buffer, sessions=tuple(replace(s, qoc=Qoc()) for s in small_buffer.sessions))
    held = held_out_skill(bare, {"dlsm": Refusing(), "fqe": Broken(), "linear": LinearModel(LinearConfig(draws=20))})
    with pytest.raises(ValueError) as refused:
        checked_horizon(small_buffer, 0)
    assert held.failed == {"dlsm": str(refused.value), "fqe": BROKE}, "what a library says of its arrays is nobody's reason"


def test_intervals_are_widened_by_errors_on_left_out_controllers_that_chance_does_not_explain():
    exact = tuple(Prediction("m", str(i), 1, v + 3.0, v, 3.0, True) for i, v in enumerate([0.0, 5.0, 9.0]))
    wrong = tuple(replace(p, observed_standard_error=0.0) for p in exact)
    base = estimate(1.0, np.random.default_rng(0).normal(size=50))
    assert with_held_out_error(base, skills(exact)[0].excess).low == pytest.approx(base.low)
    wider = with_held_out_error(base, skills(wrong)[0].excess)
    assert wider.value - wider.low == pytest.approx(np.hypot(base.value - base.low, 1.645 * 3.0))
    assert wider.high - wider.value == pytest.approx(np.hypot(base.high - base.value, 1.645 * 3.0))
    assert wider.details["held_out_error"] == pytest.approx(3.0)


def test_a_controller_without_r_end_is_left_out_of_the_comparison_where_enough_others_have_it(linear_simulator):
    buffer = linear_simulator.buffer(seed=0, n=16, steps=60)
    bare = replace(buffer, sessions=tuple(replace(s, qoc=Qoc()) if s.controller == "other" else s for s in buffer.sessions))
    linear = {"linear": LinearModel(LinearConfig(draws=20))}
    found = held_out_skill(bare, linear, aggregate=False).predictions
    assert {p.controller for p in found} == {"random", "cdbs", "rl"}
    few = replace(bare, sessions=tuple(s for s in bare.sessions if s.controller != "rl"))
    steps = held_out_skill(few, linear, aggregate=False).predictions
    assert {p.controller for p in steps} == {"random", "cdbs", "other"}
    assert all(p.observed < 0 for p in steps)  # step returns, every one of them; r_end is positive here
