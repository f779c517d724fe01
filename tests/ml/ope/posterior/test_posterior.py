"""The posterior as an estimator: its contract, its answers on sessions whose truth is known, tests, and skill."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.ope.compare.aggregate import combine
from ml.ope.compare.metrics import spearman
from ml.ope.estimate import Estimate
from ml.ope.posterior.constants import MODEL_ERRORS
from ml.ope.posterior.draws import KEPT, systematic
from ml.ope.posterior.estimator import CDBS, Posterior, PosteriorConfig, shared_out
from ml.ope.posterior.gaussian import TestedDifference
from ml.ope.posterior.structures import STRUCTURES, Fit
from ml.ope.registry import POSTERIOR, build
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.qoc import Qoc, failed_qoc
from tests.ml.ope.posterior.known_system import STEPS, KnownSystem

POLICIES = {f"constant {a}": ConstantPolicy(a) for a in (0.4, 0.55, 0.7, 0.85, 1.0)} | {"off": ConstantPolicy(0.0)}
SMALL = Posterior(PosteriorConfig(draws=24))


@pytest.fixture(scope="module")
def found(known_buffer):
    return SMALL.fit(known_buffer).evaluate(POLICIES)


def test_an_estimate_holds_what_verdicts_and_pages_are_made_from(found) -> None:
    for estimate in found.values():
        d = estimate.details
        assert estimate.method == POSTERIOR
        assert estimate.low < estimate.value < estimate.high
        assert estimate.value == pytest.approx(estimate.step_return + estimate.end_reward)
        assert len(d["draws"]) == KEPT
        assert set(d["outcome_draws"]) == {"energy", "grasp_hz", "rating", "tremor_percent"}
        assert {len(v) for v in d["outcome_draws"].values()} == {KEPT}
        assert set(d["support"]) == {"near_sessions", "near_visits", "leverage", "dose", "lowest_supported"}
        assert set(d["behaviour"]) == {"below_cdbs_20_percent", "closeness_to_cdbs", "mean_amplitude"}
        assert set(d["weights"]) == set(STRUCTURES)
        assert sum(d["weights"].values()) == pytest.approx(1, abs=1e-3)
        assert d["skill"]["told"] is True
        assert Estimate.from_json(estimate.to_json()) == estimate
    assert found["off"].details["behaviour"]["below_cdbs_20_percent"] == 1
    assert found["constant 0.7"].details["behaviour"]["closeness_to_cdbs"] == pytest.approx(0.3)
    assert found["constant 0.7"].predicted["energy"] == pytest.approx(0.49, abs=0.01)
    assert found["constant 0.7"].supported
    ratings = np.array(found["off"].details["outcome_draws"]["rating"])
    assert ratings.min() >= 1


def test_statistical_and_model_error_stand_apart(known_buffer, found) -> None:
    """Their squares add up to that of the whole; the second is what constants say at the leverage, the first of draws without them."""
    exact = replace(SMALL, config=replace(SMALL.config, model_errors={})).fit(known_buffer).evaluate(POLICIES)
    settings = known_buffer.settings
    reach = float(np.sum(settings.gamma ** np.arange(STEPS))) * abs(settings.r_a - settings.r_b)
    for name, estimate in found.items():
        errors = estimate.details["standard_errors"]
        assert set(errors) == {"statistical", "model_error"}
        assert errors["statistical"] == pytest.approx(exact[name].standard_error, abs=1e-3), "the draws without model errors"
        assert exact[name].details["standard_errors"]["model_error"] == 0
        assert estimate.standard_error**2 == pytest.approx(errors["statistical"] ** 2 + errors["model_error"] ** 2, rel=0.25)
        leverage = estimate.details["support"]["leverage"]
        of_qocs = [MODEL_ERRORS["grasp_hz"].sd(leverage) * settings.c2, MODEL_ERRORS["rating"].sd(leverage) * settings.c3]
        wanted = np.hypot(reach * MODEL_ERRORS["steps"].sd(leverage), np.hypot(*of_qocs))
        assert errors["model_error"] == pytest.approx(wanted, rel=0.15)


def test_the_same_seed_gives_the_same_numbers(known_buffer, found) -> None:
    assert SMALL.fit(known_buffer).evaluate(POLICIES) == found


def test_known_doses_are_ordered_and_covered(found) -> None:
    """Truth by simulation of the system on new sessions."""
    system, rng = KnownSystem(), np.random.default_rng(5)
    settings = system.buffer().settings
    discount = settings.gamma ** np.arange(STEPS)
    truth = {}
    for name in list(POLICIES)[:5]:
        runs = [system.session(i, 1, "other", np.full(STEPS, POLICIES[name].amplitude), rng) for i in range(60)]
        truth[name] = np.mean([(s.rewards(settings) * discount).sum() for s in runs])
    said = [found[n].step_return for n in truth]
    assert spearman(list(truth.values()), said) > 0.8
    assert np.abs(np.array(said) - list(truth.values())).max() < 8


def test_tested_sessions_move_what_was_tested_and_its_neighbours(known_buffer, found) -> None:
    cdbs = found["constant 1.0"].value
    gap = found["constant 0.7"].value - cdbs
    tests = [TestedDifference("constant 0.7", v, 4, {"return": gap - 15.0}, {"return": 1.0}) for v in (4, 5, 6)]
    after = SMALL.with_tests(tests).fit(known_buffer).evaluate(POLICIES)
    moved = {n: (after[n].value - after["constant 1.0"].value) - (found[n].value - cdbs) for n in POLICIES}
    assert moved["constant 0.7"] < -7
    assert moved["constant 0.55"] < moved["off"] + 1
    assert abs(moved["constant 0.55"]) < abs(moved["constant 0.7"])
    assert after["constant 0.7"].standard_error < found["constant 0.7"].standard_error
    before, left = found["constant 0.7"].details["standard_errors"], after["constant 0.7"].details["standard_errors"]
    assert left["model_error"] < before["model_error"], "what sessions showed is not left to the structures"
    assert after["constant 0.7"].value == pytest.approx(after["constant 0.7"].step_return + after["constant 0.7"].end_reward)
    with pytest.raises(ValueError, match="not evaluated"):
        SMALL.with_tests([replace(tests[0], policy_name="gone")]).fit(known_buffer).evaluate(POLICIES)


def test_without_outcomes_the_return_is_that_of_the_steps_and_says_so() -> None:
    buffer = KnownSystem().buffer()
    bare = replace(buffer, sessions=tuple(replace(s, qoc=Qoc()) for s in buffer.sessions))
    found = SMALL.fit(bare).evaluate({"half": ConstantPolicy(0.5)})["half"]
    assert found.end_reward is None
    assert found.value == pytest.approx(found.step_return)
    assert "few_end_rewards" in {f.code for f in found.flags}
    assert set(found.details["outcome_draws"]) == {"energy"}


def test_data_that_cannot_order_policies_say_so() -> None:
    """Beta that answers to nothing, and missing outcomes."""
    buffer = KnownSystem(depth=0.0).buffer(weight=0.0)
    noise = replace(buffer.settings, xi_beta=1.0)
    bare = replace(buffer, settings=noise, sessions=tuple(replace(s, qoc=Qoc()) for s in buffer.sessions))
    skill = SMALL.fit(bare).evaluate({"half": ConstantPolicy(0.5)})["half"].details["skill"]
    assert skill["told"] is False
    assert "no_better_than_equal" in skill["reasons"]


def test_a_policy_that_follows_beta_can_be_evaluated_at_every_size(known_buffer) -> None:
    policy = ProportionalPolicy(0.4, 0.8, 0.3, 3)
    for size in ("demo", "full"):
        assert build(POSTERIOR, 1, size).fit(known_buffer).evaluate({"p": policy}, 40)["p"].n == len(known_buffer.sessions)


def test_the_posterior_takes_no_part_in_the_combination_of_the_methods(found) -> None:
    other = {n: replace(e, method="linear", value=e.value + 1) for n, e in found.items()}
    made = combine({"linear": other, POSTERIOR: found})
    assert made["constant 0.7"].value == pytest.approx(other["constant 0.7"].value)


def test_draws_are_dealt_out_by_weight() -> None:
    assert shared_out({"a": 0.9, "b": 0.09, "c": 0.01}, 40) == {"a": 36, "b": 6}
    counts = np.bincount(systematic(np.array([0.5, 0.3, 0.2]), 100, np.random.default_rng(0)))
    assert counts.tolist() == [50, 30, 20]


def test_a_stopped_session_lowers_the_estimate_and_the_flag_says_what_it_would_be_as_measured(known_buffer, found) -> None:
    lowest = min((s for s in known_buffer.sessions if s.controller == "random"), key=lambda s: s.amplitude.mean())
    worst = failed_qoc(s.qoc for s in known_buffer.sessions)
    sessions = tuple(replace(s, stopped_as=worst if s is lowest else None) for s in known_buffer.sessions)
    after = SMALL.fit(replace(known_buffer, sessions=sessions)).evaluate({"constant 0.4": POLICIES["constant 0.4"]})["constant 0.4"]
    before = found["constant 0.4"]
    assert after.end_reward is not None
    assert before.end_reward is not None
    assert after.end_reward < before.end_reward - 5
    flag = next(f for f in after.flags if f.code == "stopped_sessions")
    assert flag.value == 1
    assert flag.fact("counted") == pytest.approx(after.end_reward)
    assert flag.fact("measured") == pytest.approx(before.end_reward, abs=3)
    assert "stopped_sessions" not in {f.code for f in before.flags}


def test_where_structures_disagree_on_a_lasting_dose_the_interval_holds_both(known_buffer) -> None:
    """The same fit with one structure's answer to the dose turned round: nothing says which is right, so both must stay possible."""
    fitted = SMALL.fit(known_buffer)
    linear = next(f for f in fitted.fits if f.key == "linear")
    turned = replace(linear, key="turned", drawn=replace(linear.drawn, beta=-linear.drawn.beta))

    def steps(*fits: Fit) -> np.ndarray:
        weights = {f.key: 1 / len(fits) for f in fits}
        alone = replace(
            fitted,
            fits=fits,
            shares={f.key: 12 for f in fits},
            predictions=replace(fitted.predictions, weights=weights),
            config=replace(fitted.config, model_errors={}, common_share=0.0),
        )
        _, _, draws = alone.joint({"low": ConstantPolicy(0.4), CDBS: ConstantPolicy(1.0)}, STEPS)
        return np.asarray(draws.values["steps"][0] - draws.values["steps"][1])

    one, other, both = steps(linear), steps(turned), steps(linear, turned)
    low, high = np.quantile(both, [0.05, 0.95])
    assert np.ptp([one.mean(), other.mean()]) > 3 * max(one.std(), other.std()), "they do disagree"
    assert low < min(one.mean(), other.mean())
    assert high > max(one.mean(), other.mean())
