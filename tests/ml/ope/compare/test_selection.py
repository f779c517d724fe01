from __future__ import annotations

import pytest

from ml.mdp import MdpSettings
from ml.ope.compare.selection import Gain, gains_over, surest
from ml.ope.fqe.estimator import Fqe, FqeConfig
from ml.policies.policy import ConstantPolicy


def test_the_surest_gain_is_chosen_and_not_the_largest():
    lucky, sure = Gain(9.0, -3.0, 7.0), Gain(2.0, 1.0, 0.5)
    assert surest({"lucky": lucky, "sure": sure}) == "sure"
    assert surest({"lucky": lucky}) is None
    assert surest({"level": Gain(0.0, 0.0, 0.0)}) is None, "cDBS is not above itself"
    assert surest({}) is None


def test_draws_of_fitted_q_evaluation_say_which_amplitude_is_better_where_the_data_show_it(make_buffer):
    # beta falls with the amplitude, and the threshold lies between what 0.3 and what 1 reach
    buffer = make_buffer(MdpSettings(xi_beta=100.0, c1=0.1, c2=0.0, c3=0.0, c4=0.0), count=8, steps=120)
    fitted = Fqe(FqeConfig(members=1, refits=30)).fit(buffer)
    low, high = ConstantPolicy(0.4), ConstantPolicy(1.0)
    upwards = gains_over(fitted, {"high": high, "same": low}, low)
    assert surest(upwards) == "high"
    assert (upwards["same"].value, upwards["same"].low, upwards["same"].standard_error) == (0.0, 0.0, 0.0)
    downwards = gains_over(fitted, {"low": low}, high)
    assert downwards["low"].value == pytest.approx(-upwards["high"].value)
    assert surest(downwards) is None
