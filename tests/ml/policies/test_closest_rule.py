from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ml.policies.closest_rule import AmplitudeRange, closest_rule, usual_rule
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.policies.threshold_rule import RuleError, ThresholdPolicy, ThresholdRule, simulate
from ml.trajectories import ReplayBuffer

CDBS_MA = 3.0
ALLOWED = AmplitudeRange(1.0, CDBS_MA)


class Relay:
    """A policy that is a rule with immediate answers."""

    def __init__(self, threshold, low, high):
        self.threshold, self.low, self.high = threshold, low, high

    def act(self, states):
        return np.where(states[:, -1] > self.threshold, self.high, self.low)


def quantile(buffer, q):
    return float(np.nanquantile(np.concatenate([s.measured_beta for s in buffer.sessions]), q))


def test_a_policy_that_is_a_rule_is_found_again_but_for_the_delay_of_the_device(buffer):
    slow = [dataclasses.replace(s, beta=np.repeat(s.beta[::15], 15)[: s.steps]) for s in buffer.sessions]
    slowly = ReplayBuffer(buffer.settings, tuple(slow), "uV", "table")
    found = closest_rule(Relay(quantile(slowly, 0.5), 0.5, 0.9), slowly, CDBS_MA, ALLOWED)
    rule = found.rule
    assert (rule.lower_ma, rule.upper_ma) == pytest.approx((1.5, 2.7), abs=0.11)
    assert quantile(slowly, 0.4) < rule.upper_threshold < quantile(slowly, 0.6)
    assert found.closeness.rms_ma < 0.25 * 1.2, "of 1.2 mA between both amplitudes"
    assert found.tried > 300


def test_a_constant_has_a_rule_without_a_range(buffer):
    found = closest_rule(ConstantPolicy(0.7), buffer, CDBS_MA, ALLOWED)
    assert (found.rule.lower_ma, found.rule.upper_ma) == (2.1, 2.1)
    assert found.closeness.rms_ma == pytest.approx(0.0, abs=1e-9)
    assert found.closeness.energy_rule == pytest.approx(0.49)


def test_limits_stay_within_what_the_participant_may_get_and_say_what_that_costs(buffer):
    policy = ProportionalPolicy(quantile(buffer, 0.2), quantile(buffer, 0.8), 0.1)
    free = closest_rule(policy, buffer, CDBS_MA, AmplitudeRange(0.0, CDBS_MA))
    bound = closest_rule(policy, buffer, CDBS_MA, AmplitudeRange(1.46, 2.58))
    assert 1.5 <= bound.rule.lower_ma <= bound.rule.upper_ma <= 2.5, "the multiples of 0.1 mA within the limits"
    assert free.rule.lower_ma < 1.5
    assert bound.closeness.rms_ma > free.closeness.rms_ma
    assert free.closeness.steps == bound.closeness.steps == sum(np.isfinite(s.states()[:-1]).all(axis=1).sum() for s in buffer.sessions)


def test_the_difference_is_that_of_the_device_run_update_by_update(buffer):
    policy = ProportionalPolicy(quantile(buffer, 0.2), quantile(buffer, 0.8), 0.3)
    found = closest_rule(policy, buffer, CDBS_MA, ALLOWED)
    apart, squares = [], []
    for s in buffer.sessions:
        power = np.repeat(s.padded_beta[9:-1], round(2.0 / found.rule.update_s))
        amplitude = simulate(found.rule, power, found.rule.upper_ma).amplitude_ma.reshape(s.steps, -1)
        known = np.isfinite(s.states()[:-1]).all(axis=1)
        apart.append((amplitude.mean(axis=1) - CDBS_MA * policy.act(s.states()[:-1]))[known])
        squares.append((amplitude**2).mean(axis=1)[known] / CDBS_MA**2)
    if all(np.isfinite(s.padded_beta).all() for s in buffer.sessions):
        assert found.closeness.rms_ma == pytest.approx(float(np.sqrt(np.mean(np.concatenate(apart) ** 2))))
        assert found.closeness.energy_rule == pytest.approx(float(np.mean(np.concatenate(squares))))
    else:
        pytest.fail("this test needs sessions without gaps")


def test_without_an_amplitude_beta_or_a_window_it_says_so(buffer):
    policy = ConstantPolicy(0.5)
    with pytest.raises(RuleError, match=r"multiple of the device's 0\.1 mA"):
        closest_rule(policy, buffer, CDBS_MA, AmplitudeRange(2.51, 2.59))
    flat = [dataclasses.replace(s, lead_beta=np.full(10, 5.0), beta=np.full(s.steps, 5.0)) for s in buffer.sessions]
    flat_buffer = ReplayBuffer(buffer.settings, tuple(flat), "uV", "table")
    with pytest.raises(ValueError, match="no spread"):
        closest_rule(policy, flat_buffer, CDBS_MA, ALLOWED)
    with pytest.raises(ValueError, match="no spread"):
        usual_rule(flat_buffer, ALLOWED)
    lost = [dataclasses.replace(s, lead_beta=np.full(10, np.nan), beta=np.full(s.steps, np.nan)) for s in buffer.sessions]
    with pytest.raises(ValueError, match="whole window"):
        closest_rule(policy, ReplayBuffer(buffer.settings, tuple(lost), "uV", "table"), CDBS_MA, ALLOWED)


def test_the_usual_rule_has_quartiles_and_the_defaults_of_the_device(buffer):
    dual, single = usual_rule(buffer, ALLOWED), usual_rule(buffer, ALLOWED, "single")
    low, high = quantile(buffer, 0.25), quantile(buffer, 0.75)
    assert dual == ThresholdRule(
        mode="dual", lower_threshold=low, upper_threshold=high, lower_ma=2.4, upper_ma=3.0, ramp_up_s=150.0, ramp_down_s=300.0,
        onset_s=1.2, termination_s=1.2, averaging_s=2.0, blanking_s=2.0,
    )  # fmt: skip
    assert single.lower_threshold == single.upper_threshold == pytest.approx(low + 0.75 * (high - low))
    assert (single.ramp_up_s, single.onset_s, single.blanking_s) == (0.25, 0.2, 0.55)
    assert usual_rule(buffer, AmplitudeRange(2.7, 3.0)).lower_ma == 2.7
    assert ThresholdPolicy(dual, CDBS_MA, 2.0).updates == 10
