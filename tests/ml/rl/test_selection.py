from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from ml.mdp import MdpSettings
from ml.ope.fqe.estimator import Fqe, FqeConfig
from ml.policies.policy import ConstantPolicy
from ml.rl.selection import Gain, gain, gains_over, surest


def test_what_all_policies_share_cancels_in_a_gain():
    rng = np.random.default_rng(0)
    days = 100 * rng.standard_normal(4000)
    ours, theirs = 7.0 + days + rng.standard_normal(4000), 5.0 + days
    found = gain(ours, theirs)
    assert found.value == pytest.approx(2.0, abs=0.05)
    assert found.standard_error == pytest.approx(1.0, abs=0.05)
    assert found.low == pytest.approx(2.0 - norm.ppf(0.95), abs=0.1)
    assert gain(ours, theirs, level=0.5).low == pytest.approx(2.0, abs=0.1)


def test_the_surest_gain_is_chosen_and_not_the_largest():
    lucky, sure = Gain(9.0, -3.0, 7.0), Gain(2.0, 1.0, 0.5)
    assert surest({"lucky": lucky, "sure": sure}) == "sure"
    assert surest({"lucky": lucky}) is None
    assert surest({"level": Gain(0.0, 0.0, 0.0)}) is None, "cDBS is not above itself"
    assert surest({}) is None


def test_draws_that_cannot_be_compared_are_refused():
    draws = np.arange(40.0)
    with pytest.raises(ValueError, match="same resampled sessions"):
        gain(draws, draws[:30])
    with pytest.raises(ValueError, match="20 draws or more"):
        gain(draws[:19], draws[:19])
    with pytest.raises(ValueError, match="not finite"):
        gain(np.where(draws == 3, np.nan, draws), draws)
    with pytest.raises(ValueError, match="between 0 and 1"):
        gain(draws, draws, level=1.0)


def test_draws_of_fitted_q_evaluation_say_which_amplitude_is_better_where_the_data_show_it(make_buffer):
    # beta falls with the amplitude, and the threshold lies between what 0.3 and what 1 reach
    buffer = make_buffer(MdpSettings(xi_beta=100.0, c1=0.1, c2=0.0, c3=0.0, c4=0.0), count=8, steps=120)
    fitted = Fqe(FqeConfig(members=1, refits=30)).fit(buffer)
    low, high = ConstantPolicy(0.4), ConstantPolicy(1.0)
    upwards = gains_over(fitted, {"high": high, "same": low}, low)
    assert surest(upwards) == "high"
    assert upwards["same"] == Gain(0.0, 0.0, 0.0)
    downwards = gains_over(fitted, {"low": low}, high)
    assert downwards["low"].value == pytest.approx(-upwards["high"].value)
    assert surest(downwards) is None
