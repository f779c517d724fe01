"""The process over candidates against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from ml.ope.posterior.gaussian import LENGTH, TestedDifference, correlated, errors_of_tests, similarity, updated
from ml.policies.policy import ConstantPolicy


def test_policies_are_alike_as_far_as_they_act_alike() -> None:
    states = np.random.default_rng(0).random((50, 10))
    found = similarity([ConstantPolicy(0.5), ConstantPolicy(0.5), ConstantPolicy(0.65)], states)
    assert found[0, 1] == pytest.approx(1)
    assert found[0, 2] == pytest.approx(np.exp(-0.5 * (0.15 / LENGTH) ** 2))


def test_draws_have_the_spread_and_the_correlation_they_were_asked_for() -> None:
    asked = np.array([[1, 0.8], [0.8, 1]])
    found = correlated(asked, np.array([2.0, 0.5]), 50000, np.random.default_rng(0))
    assert np.allclose(found.std(1), [2.0, 0.5], rtol=0.02)
    assert np.corrcoef(found)[0, 1] == pytest.approx(0.8, abs=0.01)


def prior(draws: int = 40000) -> dict[str, np.ndarray]:
    """Draw three policies, the last of them the reference; the first two alike."""
    rng = np.random.default_rng(1)
    covariance = np.array([[4.0, 3.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.0, 1.0]])
    return {"return": rng.multivariate_normal([10.0, 8.0, 9.0], covariance, draws).T}


def test_a_test_moves_the_draws_as_conditioning_a_normal_does() -> None:
    test = TestedDifference("first", 4, 3, {"return": -5.0}, {"return": 1.5})
    found = updated(prior(), ["first", "second", "cdbs"], 2, [test], {"return": 2.0}, np.random.default_rng(0))["return"]
    # y = f0 - f2 + e, variance of f0 - f2 is 5, of e 1.5^2 + 2^2; prior mean of the difference is 1
    total = 5.0 + 1.5**2 + 2.0**2
    gain = np.array([4.0, 3.0, -1.0]) / total
    assert np.allclose(found.mean(1), np.array([10.0, 8.0, 9.0]) + gain * (-5.0 - 1.0), atol=0.1)
    assert found[0].var() == pytest.approx(4.0 - 16.0 / total, rel=0.05)
    assert found[1].mean() < 8.0  # what was not tested moves with what was


def test_policies_of_one_visit_share_the_chance_of_its_cdbs_sessions() -> None:
    """Errors of two tests of one visit: variance sd^2 (1/n + 1/m), covariance sd^2 / m; other visits have none in common."""
    sd, m = 2.0, 2
    tests = [
        TestedDifference(p, v, n, {"return": 1.0}, {"return": sd * np.sqrt(1 / n + 1 / m)}, m)
        for p, v, n in (("first", 4, 1), ("second", 4, 2), ("first", 5, 1))
    ]
    found = errors_of_tests([(t, "return") for t in tests], {"return": 1.0}, {})
    assert np.allclose(found, [[1 + 4 * 1.5, 2.0, 0.0], [2.0, 1 + 4 * 1.0, 0.0], [0.0, 0.0, 1 + 4 * 1.5]])
    # so the difference between two policies of one visit is known as well as without cDBS between them
    assert found[0, 0] + found[1, 1] - 2 * found[0, 1] == pytest.approx(2 * 1.0 + sd**2 * (1 / 1 + 1 / 2))


def test_errors_stay_a_covariance_whatever_was_measured_in_which_test() -> None:
    rng, weights = np.random.default_rng(0), {"grasp_hz": 5.0, "rating": 10.0, "tremor_percent": 0.0}
    spread = {"return": 4.0, "rating": 0.5, "energy": 0.02}
    for _ in range(300):
        seen = []
        for k in range(4):
            names = [q for q in ("return", "energy", "grasp_hz", "rating", "tremor_percent") if rng.random() < 0.7] or ["energy"]
            errors = dict(zip(names, rng.uniform(0.05, 5, len(names)), strict=True))
            test = TestedDifference(
                f"p{k % 3}", 4 + k // 3, int(rng.integers(1, 6)), dict.fromkeys(names, 0.0), errors, int(rng.integers(1, 4))
            )
            seen += [(test, q) for q in names]
        found = errors_of_tests(seen, spread, weights, lambda a, b: 1.0 if a == b else 0.9)
        assert np.allclose(found, found.T)
        assert np.linalg.eigvalsh(found).min() > -1e-9 * np.trace(found)


def test_a_qoc_without_weight_that_one_test_lacks_is_no_obstacle() -> None:
    draws = prior(500) | {"tremor_percent": prior(500)["return"]}
    full = TestedDifference("first", 4, 1, {"return": 1.0, "tremor_percent": 2.0}, {"return": 1.0, "tremor_percent": 1.0}, 2)
    lacks = TestedDifference("second", 4, 1, {"return": 1.0}, {"return": 1.0}, 2)
    for tests in ([full, lacks], [lacks, full]):
        found = updated(draws, ["first", "second", "cdbs"], 2, tests, {}, np.random.default_rng(0), {"tremor_percent": 0.0})
        assert np.isfinite(found["return"]).all()


def test_twins_of_one_visit_share_its_day() -> None:
    tests = [TestedDifference(p, 4, 1, {"return": 1.0}, {"return": 1.0}, 2) for p in ("first", "twin")]
    found = errors_of_tests([(t, "return") for t in tests], {"return": 3.0}, {}, lambda a, b: 1.0)
    assert found[0, 1] == pytest.approx(9.0 + 1 / 1.5 / 2), "the day, and the chance of the two cDBS sessions"


def test_a_lucky_rating_is_not_counted_again_in_the_return() -> None:
    """Returns that are only their rating's part: seeing both says no more than seeing the rating."""
    draws = prior()
    draws["rating"] = draws["return"] / 2.0
    names, weights = ["first", "second", "cdbs"], {"rating": 2.0}
    both = TestedDifference("first", 4, 1, {"return": 6.0, "rating": 3.0}, {"return": 3.0, "rating": 1.5}, 2)
    alone = TestedDifference("first", 4, 1, {"rating": 3.0}, {"rating": 1.5}, 2)
    together, one = (updated(draws, names, 2, [test], {}, np.random.default_rng(0), weights)["return"][0] for test in (both, alone))
    assert together.mean() == pytest.approx(one.mean(), abs=0.1)
    assert together.std() == pytest.approx(one.std(), rel=0.05)
    twice = updated(draws, names, 2, [both], {}, np.random.default_rng(0))["return"][0]
    assert twice.std() < 0.95 * one.std(), "what it would say if the two were taken for independent"


def test_many_precise_tests_are_mostly_what_happened() -> None:
    tests = [TestedDifference("second", v, 5, {"return": 6.0}, {"return": 0.3}) for v in range(2, 8)]
    found = updated(prior(), ["first", "second", "cdbs"], 2, tests, {}, np.random.default_rng(0))["return"]
    assert (found[1] - found[2]).mean() == pytest.approx(6.0, abs=0.1)
    assert (found[1] - found[2]).std() < 0.3


def test_nothing_tested_changes_nothing_and_unknown_policies_are_refused() -> None:
    before = prior(50)
    assert updated(before, ["first", "second", "cdbs"], 2, [], {}, np.random.default_rng(0)) == before
    stranger = TestedDifference("stranger", 4, 1, {"return": 1.0}, {"return": 1.0})
    with pytest.raises(ValueError, match="'stranger' at visit 4 is of a policy that is not evaluated"):
        updated(before, ["first", "second", "cdbs"], 2, [stranger], {}, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_sessions": 0}, "at least one session"),
        ({"differences": {"mood": 1.0}, "standard_errors": {"mood": 1.0}}, "difference of 'mood'"),
        ({"standard_errors": {}}, "one standard error for each"),
        ({"standard_errors": {"return": 0.0}}, "the error above 0, not 0.0"),
        ({"differences": {"return": float("nan")}}, "must be finite"),
    ],
)
def test_a_test_that_cannot_be_is_refused_in_words(change, message) -> None:
    fields = {"policy_name": "p", "visit": 2, "n_sessions": 1, "differences": {"return": 1.0}, "standard_errors": {"return": 1.0}}
    with pytest.raises(ValueError, match=message):
        TestedDifference(**{**fields, **change})
