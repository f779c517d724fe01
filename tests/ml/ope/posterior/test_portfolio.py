"""The portfolio of a visit, against closed forms of expected improvement and by what it must never do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from ml.ope.posterior.portfolio import portfolio

N = 200_000


def drawn(mean: float, sd: float, seed: int) -> np.ndarray:
    return mean + sd * np.random.default_rng(seed).normal(size=N)


@pytest.mark.parametrize(("mean", "sd"), [(2.0, 1.0), (0.0, 3.0), (-1.0, 2.0)])
def test_one_policy_is_worth_its_expected_improvement(mean: float, sd: float) -> None:
    (only,) = portfolio({"a": drawn(mean, sd, 1)}, 4)
    z = mean / sd
    assert only.adds == pytest.approx(mean * norm.cdf(z) + sd * norm.pdf(z), rel=0.02)
    assert only.expected == pytest.approx(mean, abs=0.03)
    assert only.better == pytest.approx(norm.cdf(z), abs=0.01)
    assert only.informs == 0.0


def test_two_policies_of_equal_law_are_worth_the_mean_of_their_maximum() -> None:
    """E max of two independent N(m, s^2) is m + s / sqrt(pi); far above cDBS the floor at 0 plays no part."""
    found = portfolio({"a": drawn(10.0, 1.0, 1), "b": drawn(10.0, 1.0, 2)}, 2)
    assert sum(s.adds for s in found) == pytest.approx(10 + 1 / np.sqrt(np.pi), rel=0.005)


def test_a_policy_that_does_the_same_adds_nothing_and_another_is_taken() -> None:
    first = drawn(5.0, 2.0, 1)
    found = portfolio({"first": first, "twin": first - 0.001, "other": drawn(4.0, 2.0, 2)}, 3)
    assert [s.name for s in found] == ["first", "other"]
    assert portfolio({"first": first, "twin": first - 0.001}, 2)[0].informs == pytest.approx(1.0)


def test_a_bold_policy_is_taken_before_a_sure_one_that_is_known_to_be_a_little_better_than_nothing() -> None:
    found = portfolio({"sure": drawn(0.2, 0.01, 1), "bold": drawn(0.0, 5.0, 2)}, 1)
    assert [s.name for s in found] == ["bold"]


def test_a_visit_takes_one_test_with_care() -> None:
    given = {"x": drawn(6.0, 2.0, 1), "y": drawn(5.9, 2.0, 2), "plain": drawn(1.0, 1.0, 3)}
    assert {"x", "y"} <= {s.name for s in portfolio(given, 3)}
    names = [s.name for s in portfolio(given, 3, careful={"x", "y"})]
    assert names[0] == "x"
    assert "y" not in names


def test_greedy_finds_the_best_pair_of_a_small_set() -> None:
    given = {name: drawn(mean, sd, k) for k, (name, mean, sd) in enumerate([("a", 1, 1), ("b", 0.8, 2), ("c", 0.9, 0.1), ("d", -3, 1)])}
    worth = {(p, q): np.maximum(0, np.maximum(given[p], given[q])).mean() for p in given for q in given if p < q}
    assert {s.name for s in portfolio(given, 2)} == set(max(worth, key=lambda pair: worth[pair]))


def test_what_is_known_already_is_not_tested_again_and_what_may_beat_it_is() -> None:
    known, open_, worse = drawn(5.0, 0.01, 1), drawn(4.0, 2.0, 2), drawn(-9.0, 0.5, 3)
    assert [s.name for s in portfolio({"known": known, "open": open_, "worse": worse}, 3, tested={"known"})] == ["open"]
    z = (4.0 - 5.0) / 2.0
    (only,) = portfolio({"known": known, "open": open_}, 3, tested={"known"})
    assert only.adds == pytest.approx(2.0 * (norm.pdf(z) + z * norm.cdf(z)), rel=0.02), "expected improvement over what is in hand"


def test_what_is_known_adds_nothing_with_noise_either() -> None:
    assert portfolio({"known": drawn(10.0, 2.0, 1)[:400]}, 1, tested={"known"}, noise=3.0) == ()
    given = {"a": drawn(10.0, 2.0, 1)[:400], "b": drawn(3.0, 1.0, 2)[:400], "c": drawn(4.0, 1.5, 3)[:400]}
    assert portfolio(given, 3, tested={"a"}, noise=6.0) == ()


def test_a_session_with_noise_is_worth_what_it_may_change_the_mean_by() -> None:
    """One session moves the mean by a normal of variance sd^4 / (sd^2 + noise^2): the knowledge gradient."""
    sd, noise, mean = 2.0, 3.0, -1.0
    moved = sd**2 / np.sqrt(sd**2 + noise**2)
    z = mean / moved
    (only,) = portfolio({"a": drawn(mean, sd, 1)}, 1, noise=noise)
    assert only.adds == pytest.approx(moved * (norm.pdf(z) + z * norm.cdf(z)), rel=0.03)
    again = portfolio({"lucky": drawn(1.0, sd, 1)}, 1, tested={"lucky"}, noise=noise)
    assert [s.name for s in again] == ["lucky"], "one session does not settle it"


def test_a_slot_that_is_left_goes_to_a_new_policy_that_several_sessions_would_tell() -> None:
    """One session with so much noise moves the mean of the open policy by nothing that counts; knowing it may be worth much."""
    given = {"sure": drawn(8.0, 0.01, 1)[:4000], "open": drawn(4.0, 3.0, 2)[:4000], "hopeless": drawn(-9.0, 0.5, 3)[:4000]}
    assert [s.name for s in portfolio(given, 3, noise=60.0)] == ["sure", "open"]
    assert [s.name for s in portfolio(given, 3, tested={"sure"}, noise=60.0)] == ["open"]
    assert portfolio(given, 3, tested={"sure", "open"}, noise=60.0) == (), "it has run already"


def test_nothing_is_suggested_where_there_is_nothing() -> None:
    assert portfolio({}, 3) == ()
    assert portfolio({"a": drawn(1, 1, 1)}, 0) == ()
    assert portfolio({"a": np.full(100, -2.0)}, 3) == ()


def test_draws_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="not aligned"):
        portfolio({"a": np.zeros(3), "b": np.zeros(4)}, 2)
    with pytest.raises(ValueError, match="finite"):
        portfolio({"a": np.array([1.0, np.nan])}, 2)
