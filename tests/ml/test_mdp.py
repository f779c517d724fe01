"""Rewards and returns against hand calculations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.mdp import MdpSettings, end_reward, step_reward
from ml.qoc import Qoc, grasp_frequency, tremor_percent

PAPER = MdpSettings(xi_beta=1.0)


def test_the_papers_constants_are_the_defaults() -> None:
    assert (PAPER.window, PAPER.period_s, PAPER.r_a, PAPER.r_b, PAPER.c1) == (10, 2.0, 0.0, -1.0, 0.3)
    assert (PAPER.c2, PAPER.c3, PAPER.c4) == (10, 10, 10)


def test_beta_at_the_threshold_counts_as_above_it() -> None:
    rewards = step_reward(PAPER, np.array([0.999, 1.0, 1.001]), np.array([0.5, 0.5, 0.0]))
    assert rewards == pytest.approx([-0.15, -1.15, -1.0])


def test_an_unknown_beta_or_amplitude_gives_no_reward() -> None:
    rewards = step_reward(PAPER, np.array([np.nan, 0.5]), np.array([0.5, np.nan]))
    assert np.isnan(rewards).all()


def test_r_end_takes_tremor_as_a_fraction_unless_told_otherwise() -> None:
    qoc = Qoc(grasp_hz=2.0, rating=8, tremor_percent=25.0)
    assert end_reward(PAPER, qoc) == pytest.approx(10 * 2 + 10 * 8 - 10 * 0.25)
    assert end_reward(MdpSettings(xi_beta=1.0, tremor_as_fraction=False), qoc) == pytest.approx(10 * 2 + 10 * 8 - 10 * 25)


def test_a_missing_qoc_masks_r_end_unless_its_weight_is_zero() -> None:
    qoc = Qoc(rating=8)
    assert end_reward(PAPER, qoc) is None
    assert end_reward(MdpSettings(xi_beta=1.0, c2=0, c4=0), qoc) == pytest.approx(80)


@given(beta=st.floats(0, 1e3), low=st.floats(0, 1), high=st.floats(0, 1))
def test_more_amplitude_never_earns_more_at_the_same_beta(beta: float, low: float, high: float) -> None:
    low, high = sorted((low, high))
    assert step_reward(PAPER, np.array(beta), np.array(low)) >= step_reward(PAPER, np.array(beta), np.array(high))


@given(beta=st.floats(0, 1e3), amplitude=st.floats(0, 1))
def test_step_rewards_stay_in_the_papers_range(beta: float, amplitude: float) -> None:
    assert -1.3 <= float(step_reward(PAPER, np.array(beta), np.array(amplitude))) <= 0


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"c1": -0.1}, "c1"),
        ({"c4": -1}, "c4"),
        ({"gamma": 1.0}, "gamma"),
        ({"window": 0}, "window"),
        ({"period_s": 0}, "period_s"),
        ({"lower_bound": 1.0}, "lower bound"),
        ({"xi_beta": float("nan")}, "xi_beta"),
        ({"r_a": -2.0}, "r_a"),
    ],
)
def test_impossible_constants_are_refused_by_name(change: dict[str, float], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        MdpSettings(**({"xi_beta": 1.0} | change))  # type: ignore[arg-type]


def test_grasp_frequency_is_the_inverse_mean_interval() -> None:
    assert grasp_frequency(np.array([0.0, 0.4, 1.0])) == pytest.approx(2.0)


@pytest.mark.parametrize("times", [[], [1.0], [0.0, 0.5, 0.5], [1.0, 0.5]])
def test_a_grasp_frequency_needs_two_open_fists_in_order(times: list[float]) -> None:
    with pytest.raises(ValueError, match="open"):
        grasp_frequency(np.array(times))


def test_tremor_counts_mild_and_worse_over_the_whole_session() -> None:
    seconds = {"none": 300.0, "slight": 60.0, "mild": 60.0, "moderate": 30.0, "strong": 30.0, "unknown": 120.0}
    assert tremor_percent(seconds, 600.0) == pytest.approx(20.0)
    with pytest.raises(ValueError, match="fit"):
        tremor_percent({"strong": 700.0}, 600.0)


@pytest.mark.parametrize("values", [{"rating": 0}, {"rating": 11}, {"rating": 2.5}, {"tremor_percent": 101}, {"grasp_hz": -1}])
def test_impossible_qocs_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must"):
        Qoc(**values)  # type: ignore[arg-type]
