"""Threshold rules against traces computed by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.energy import relative_energy
from ml.ope.linear.estimator import LinearConfig, LinearModel
from ml.policies.policy import ConstantPolicy, start_sessions
from ml.policies.threshold_rule import RuleError, RuleRun, ThresholdPolicy, ThresholdRule, simulate
from ml.population.virtual import world
from ml.population.virtual.sessions import new_days

DUAL = ThresholdRule(
    mode="dual", lower_threshold=20.0, upper_threshold=30.0, lower_ma=2.0, upper_ma=3.0, ramp_up_s=10.0, ramp_down_s=20.0,
    onset_s=1.2, termination_s=2.0, averaging_s=0.2, blanking_s=0.0,
)  # fmt: skip
SINGLE = ThresholdRule(
    mode="single", lower_threshold=25.0, upper_threshold=25.0, lower_ma=2.0, upper_ma=3.0, ramp_up_s=0.25, ramp_down_s=0.5,
    onset_s=0.2, termination_s=0.2, averaging_s=0.1, blanking_s=0.55,
)  # fmt: skip


def powers(*stretches):
    return np.concatenate([np.full(count, float(power)) for power, count in stretches])


def test_the_amplitude_rises_after_the_onset_in_steps_of_the_device():
    trace = simulate(DUAL, powers((40, 60)), 2.0).amplitude_ma
    # the sixth update ends the onset of 1.2 s and adds 0.02 of the way; a step of 0.1 mA is due from half of it on
    expected = [2.0 if n < 6 else min(2.0 + 0.1 * np.floor(0.2 * (n - 5) + 0.5 + 1e-9), 3.0) for n in range(1, 61)]
    np.testing.assert_allclose(trace, expected)
    assert np.flatnonzero(trace > 2.0)[0] == 7, "0.06 of the way, after 1.6 s"
    assert np.flatnonzero(trace == 3.0)[0] == 52, "0.96 of the way, after 10.6 s"
    assert (DUAL.up_ma_per_s, DUAL.down_ma_per_s) == (0.1, 0.05)


def test_a_dual_rule_keeps_the_amplitude_between_the_thresholds_and_a_crossing_shorter_than_its_onset_does_nothing():
    trace = simulate(DUAL, powers((40, 30), (25, 100), (40, 5), (25, 5), (10, 9), (25, 5)), 2.0).amplitude_ma
    assert trace[29] == pytest.approx(2.5), "24 updates on the way after the sixth: 0.5 of it"
    assert (trace[29:] == trace[29]).all()


def test_it_falls_by_its_own_ramp_after_the_termination_and_never_below_the_lower_limit():
    trace = simulate(DUAL, powers((10, 200)), 3.0).amplitude_ma
    # the tenth update ends the termination of 2 s and takes 0.01 of the way
    expected = [3.0 if n < 10 else max(2.0 + 0.1 * np.floor(10 * (1 - 0.01 * (n - 9)) + 0.5 + 1e-9), 2.0) for n in range(1, 201)]
    np.testing.assert_allclose(trace, expected)
    assert trace.min() == 2.0
    assert simulate(DUAL, powers((90, 2000)), 2.0).amplitude_ma.max() == 3.0


def test_a_single_rule_always_moves_to_a_limit_and_blanking_keeps_a_new_direction():
    trace = simulate(SINGLE, powers((40, 10), (25, 10)), 2.0).amplitude_ma
    # fourth update of 50 ms: onset over; five updates of 0.2 of the way each
    np.testing.assert_allclose(trace[:9], [2, 2, 2, 2.2, 2.4, 2.6, 2.8, 3, 3])
    assert (trace[8:] == 3).all(), "a power at the threshold is not beyond it: the direction stays"
    down = replace(SINGLE, averaging_s=0.05)
    trace = simulate(down, powers((40, 4), (10, 30)), 2.0).amplitude_ma
    # power is low from the fifth update on, but eleven updates of blanking follow the fourth
    assert np.flatnonzero(np.diff(trace) < 0)[0] + 1 == 15
    assert simulate(replace(down, blanking_s=0.0), powers((40, 4), (10, 30)), 2.0).amplitude_ma[8] < 3.0


def test_averaging_delays_a_crossing_by_the_updates_that_the_mean_needs():
    rule = replace(DUAL, averaging_s=2.0, onset_s=0.0, ramp_up_s=0.25)
    trace = simulate(rule, powers((20, 10), (40, 10)), 2.0).amplitude_ma
    # mean of ten: 20 + 2 j after j high ones, above 30 from the sixth
    assert np.flatnonzero(trace > 2.0)[0] == 15


def test_a_lost_power_leaves_open_what_any_power_could_have_led_to_and_nothing_else():
    rule = replace(DUAL, onset_s=0.0, termination_s=0.0, ramp_up_s=10.0, ramp_down_s=10.0)
    lost = powers((25, 5), (np.nan, 10), (25, 5), (40, 60))
    trace = simulate(rule, lost, 2.5)
    assert (trace.amplitude_ma[:5] == 2.5).all()
    # ten updates of 0.02 of the way, in either direction
    np.testing.assert_allclose(trace.low_ma[15:20], 2.3)
    np.testing.assert_allclose(trace.high_ma[15:20], 2.7)
    assert np.isnan(trace.amplitude_ma[15:20]).all()
    assert (trace.amplitude_ma[-15:] == 3.0).all(), "at the limit it is known again"
    for power in (0.0, 25.0, 99.0):
        filled = simulate(rule, np.where(np.isnan(lost), power, lost), 2.5).amplitude_ma
        assert ((trace.low_ma <= filled) & (filled <= trace.high_ma)).all()


@pytest.mark.parametrize(
    ("change", "field", "words"),
    [
        ({"lower_threshold": 30.0}, "lower_threshold", "exchange them"),
        ({"lower_threshold": -1.0}, "lower_threshold", "below 0"),
        ({"lower_threshold": float("nan")}, "lower_threshold", "not a number"),
        ({"lower_ma": 3.1}, "lower_ma", "above the upper one"),
        ({"upper_ma": 2.55}, "upper_ma", "multiple of 0.1 mA"),
        ({"upper_ma": 25.6}, "upper_ma", "0 to 25.5 mA"),
        ({"ramp_up_s": 0.2}, "ramp_up_s", "0.25 to 1800 s"),
        ({"ramp_down_s": 1801.0}, "ramp_down_s", "0.25 to 1800 s"),
        ({"onset_s": 361.0}, "onset_s", "0 to 360 s"),
        ({"termination_s": -0.1}, "termination_s", "0 to 360 s"),
        ({"averaging_s": 31.0}, "averaging_s", "0 to 30 s"),
        ({"mode": "single"}, "upper_threshold", "one threshold"),
        ({"mode": "single", "lower_threshold": 30.0, "onset_s": 31.0}, "onset_s", "0 to 30 s"),
        ({"mode": "triple"}, "mode", "dual or single"),
    ],
)
def test_settings_that_the_device_does_not_take_are_refused_with_what_to_do(change, field, words):
    with pytest.raises(RuleError, match=words) as refused:
        replace(DUAL, **change)
    assert refused.value.field == field


def test_limits_outside_the_participants_are_refused_and_never_cut():
    DUAL.require_within(2.0, 3.0)
    with pytest.raises(RuleError, match=r"above 2\.9 mA"):
        DUAL.require_within(2.0, 2.9)
    with pytest.raises(RuleError, match=r"below 2\.1 mA"):
        DUAL.require_within(2.1, 3.0)
    with pytest.raises(RuleError, match=r"above 2\.9 mA"):
        ThresholdPolicy(DUAL, 2.9, 2.0)
    with pytest.raises(RuleError, match="outside the limits"):
        simulate(DUAL, powers((40, 3)), 1.9)


def test_as_a_policy_it_gives_the_same_amplitudes_step_by_step_as_the_device_update_by_update():
    rng = np.random.default_rng(0)
    beta = rng.uniform(5, 45, size=(4, 40))
    policy = ThresholdPolicy(DUAL, 3.2, 2.0)
    running = start_sessions(policy)
    asked = np.stack([running.act(beta[:, k - 10 : k]) for k in range(10, 40)], axis=1)
    for row in range(4):
        trace = simulate(DUAL, np.repeat(beta[row, 9:39], 10), 3.0).amplitude_ma.reshape(-1, 10)
        np.testing.assert_allclose(asked[row], trace.mean(axis=1) / 3.2)
    assert float(running.mean_square[0]) >= asked[0, -1] ** 2, "the energy of a step is that of its updates"
    with pytest.raises(ValueError, match="4 sessions and got 3"):
        running.act(beta[:3, :10])
    assert start_sessions(policy) is not running
    assert start_sessions(ConstantPolicy(0.5)).act(beta) == pytest.approx([0.5] * 4)


def test_energy_of_a_rule_at_its_limits_is_exact():
    half = replace(DUAL, onset_s=0.0, termination_s=0.0, ramp_up_s=0.25, ramp_down_s=0.25)
    trace = simulate(half, powers((40, 100), (10, 100)), 3.0).amplitude_ma
    # one update of 0.8 of the way is between both limits
    assert relative_energy(trace / 3.0) == pytest.approx((100 * 1 + (2.2 / 3) ** 2 + 99 * (2 / 3) ** 2) / 200)


def test_it_begins_anew_with_every_replay_of_an_estimator_and_every_simulated_day(buffer):
    scale = np.nanquantile(np.concatenate([s.measured_beta for s in buffer.sessions]), [0.3, 0.7])
    rule = replace(DUAL, lower_threshold=float(scale[0]), upper_threshold=float(scale[1]), onset_s=0.0, ramp_up_s=2.0, ramp_down_s=2.0)
    policy = ThresholdPolicy(rule, 3.0, 2.0)
    fitted = LinearModel(LinearConfig(draws=20)).fit(buffer)
    first, again = (fitted.evaluate({"rule": policy, "cdbs": ConstantPolicy(1.0)})["rule"] for _ in range(2))
    assert first.value == again.value
    energy = first.predicted["energy"]
    assert (2 / 3) ** 2 < energy < 0.95
    slow = ThresholdPolicy(replace(rule, ramp_down_s=1800.0), 3.0, 2.0)
    assert fitted.evaluate({"rule": slow})["rule"].predicted["energy"] > 0.95, "it has hardly begun to fall"
    w = world("A", 0)
    xi = w.settings.xi_beta
    policy = ThresholdPolicy(replace(rule, lower_threshold=0.95 * xi, upper_threshold=1.05 * xi), 3.0, 2.0)
    days = new_days(w.key, 0, 5)
    run = w.run(policy, days, 0)
    np.testing.assert_array_equal(run.amplitude, w.run(policy, days, 0).amplitude)
    w_beta = np.concatenate([run.lead, run.beta], axis=1)
    for i in range(5):
        trace = simulate(policy.rule, np.repeat(w_beta[i, 9:-1], 10), 3.0).amplitude_ma.reshape(-1, 10).mean(axis=1)
        np.testing.assert_allclose(run.amplitude[i], trace / 3.0)


def test_rules_that_run_together_have_one_mode_and_one_averaging():
    with pytest.raises(ValueError, match="one mode"):
        RuleRun([DUAL, SINGLE], 2, np.ones(2))
    with pytest.raises(ValueError, match="whole number"):
        ThresholdPolicy(DUAL, 3.0, 0.3)


def test_the_settled_answer_is_the_limit_of_the_newest_crossing():
    policy = ThresholdPolicy(DUAL, 4.0, 2.0)
    windows = np.array([[25.0, 10.0, 25.0], [10.0, 40.0, 25.0], [25.0, 25.0, 25.0]])
    np.testing.assert_allclose(policy.act(windows), [0.5, 0.75, 0.75])


def test_a_rule_is_read_as_it_was_written():
    assert ThresholdRule.from_json(DUAL.to_json() | {"window": 10}) == DUAL
