"""Adaptation of a policy and what it adds, against amplitudes and draws that are known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ml.ope.adaptation import WIDER, adaptation_of, gain_by_following
from ml.ope.estimate import Estimate
from ml.ope.posterior.verdict import interval
from ml.ope.support.behaviour_map import BehaviourMap, Curve

N = 200
NOISE = np.linspace(-1.0, 1.0, N)


def beta_map(middle: tuple[float | None, ...], steps: tuple[int, ...], reach: float = 0.0) -> BehaviourMap:
    """Make a map of one policy `p`, whose amplitudes spread by `reach` around the middle of each column of beta."""
    low, high = (tuple(None if m is None else m + sign * reach for m in middle) for sign in (-1, 1))
    edges = tuple(float(k) for k in range(len(steps) + 1))
    return BehaviourMap(edges, tuple((n, 0) for n in steps), {"p": Curve(middle, low, high)}, {})


def estimate(energy: float | None, draws: np.ndarray) -> Estimate:
    predicted = {} if energy is None else {"energy": energy}
    return Estimate("posterior", 0.0, -1.0, 1.0, 0.9, 1.0, 0.0, None, predicted, True, (), N, {"draws": [float(d) for d in draws]})


def test_amplitudes_count_by_the_recorded_steps_of_their_column():
    found = adaptation_of(beta_map((0.6, 1.0, None), (300, 100, 4)), "p")
    assert found is not None
    assert (found.mean, found.low, found.high) == (pytest.approx(0.7), 0.6, 1.0)
    assert found.spread == pytest.approx(0.75 * 0.1 + 0.25 * 0.3)
    assert not found.fixed
    assert adaptation_of(beta_map((None,), (4,)), "p") is None
    assert adaptation_of(beta_map((0.6,), (300,)), "q") is None


def test_a_policy_that_hardly_moves_is_the_same_as_its_mean_all_the_time():
    found = adaptation_of(beta_map((0.84, 0.90), (100, 100), reach=0.02), "p")
    assert found is not None
    assert found.fixed
    assert (found.low, found.high) == (pytest.approx(0.82), pytest.approx(0.92))
    wide = adaptation_of(beta_map((0.84, 0.90), (100, 100), reach=0.15), "p")
    assert wide is not None
    assert not wide.fixed, "columns of beta may hide that a policy follows what is newest"


def test_a_policy_is_compared_with_the_constant_of_its_energy_draw_by_draw():
    common = 10 * NOISE  # a common error of the posterior cancels
    constants = [(1.0, estimate(1.0, 40 + common)), (0.6, estimate(0.36, 50 + common)), (0.8, estimate(0.64, 48 + common))]
    found = gain_by_following(estimate(0.5, 52 + common + NOISE), constants)
    assert found is not None
    assert found.amplitude == pytest.approx(0.5**0.5)
    at = 0.5 * 50 + 0.5 * 48  # half way between the energies 0.36 and 0.64
    assert found.value == pytest.approx(52 - at)
    low, high = interval(NOISE)
    assert (found.low, found.high) == (pytest.approx(52 - at + WIDER * low), pytest.approx(52 - at + WIDER * high))


def test_nothing_is_said_beyond_the_constants_or_without_draws():
    constants = [(0.6, estimate(0.36, NOISE)), (1.0, estimate(1.0, NOISE))]
    assert gain_by_following(estimate(0.30, NOISE), constants) is None
    assert gain_by_following(estimate(None, NOISE), constants) is None
    assert gain_by_following(estimate(0.5, NOISE[:20]), constants) is None
    assert gain_by_following(estimate(0.5, NOISE), constants[:1]) is None
