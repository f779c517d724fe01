"""The safety envelope: examples by hand, and whatever sequence comes."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ml.deploy.runtime.controller import BoundedController
from ml.deploy.runtime.envelope import BetaSample, EnvelopeLimits, Reason, Signal, reason_names
from ml.deploy.windows import PolicyWindow
from ml.policies.policy import ConstantPolicy

LIMITS = EnvelopeLimits(min_ma=0.5, max_ma=3.2, cdbs_ma=3.0, ramp_ma_per_s=0.25, window=3, period_s=2.0)
UV = Signal("uV", "time_domain")


class Answers:
    """A network with given answers that remembers its inputs."""

    def __init__(self, answer, window=3):
        self.answer, self.asked, self.window = answer, [], [0.0] * window

    def push(self, beta):
        self.window = [*self.window[1:], beta]

    def fraction(self):
        self.asked.append(list(self.window))
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def constant(fraction, window=3):
    return PolicyWindow(ConstantPolicy(fraction), window)


def run(network, betas, limits=LIMITS):
    """Run decisions over a stream with one sample per period; None where no sample came."""
    controller = BoundedController(network, limits, UV)
    times = [limits.period_s * k for k in range(len(betas))]
    return [controller.decide(t, None if b is None else BetaSample(t, b, UV)) for t, b in zip(times, betas, strict=True)]


def names(decision):
    return set(reason_names(decision.reasons))


def test_the_network_is_asked_with_the_window_oldest_first_and_its_fraction_is_of_cdbs():
    network = Answers(0.9)
    decision = run(network, [100.0, 101.0, 140.0])[-1]
    assert network.asked == [[100.0, 101.0, 140.0]]
    assert decision.requested_ma == pytest.approx(2.7)
    assert decision.amplitude_ma == pytest.approx(2.7)
    assert (decision.fallback, decision.reasons, decision.fraction, decision.valid) == (False, 0, 0.9, 3)
    assert decision.beta_age_s == 0.0


@pytest.mark.hazard("H06")
def test_the_amplitude_never_moves_faster_than_the_ramp():
    decisions = run(constant(0.0), [100.0] * 10)
    assert [d.amplitude_ma for d in decisions] == pytest.approx([3.0, 3.0, 2.5, 2.0, 1.5, 1.0, 0.5, 0.5, 0.5, 0.5])
    assert ["ramp" in names(d) for d in decisions] == [False, False, True, True, True, True, False, False, False, False]
    assert names(decisions[-1]) == {"minimum"}


def test_decisions_in_quick_succession_share_one_periods_ramp():
    controller = BoundedController(constant(0.0), LIMITS, UV)
    for k in range(3):
        controller.decide(2.0 * k, BetaSample(2.0 * k, 1.0, UV))
    moved = [controller.decide(4.0 + 0.1 * i, None).amplitude_ma for i in range(1, 18)]
    assert moved[-1] == pytest.approx(2.5 - 0.25 * 1.7)
    assert np.max(np.abs(np.diff(moved))) <= 0.25 * 0.1 + 1e-9
    assert controller.decide(5.0, None).amplitude_ma == moved[-1], "a clock that runs back moves nothing"


@pytest.mark.hazard("H12")
def test_a_clock_that_is_set_back_does_not_lock_the_network_out():
    controller = BoundedController(constant(1.0), LIMITS, UV)
    times = [*np.arange(1e6, 1e6 + 10, 2.0), *np.arange(0.0, 10, 2.0)]
    decisions = [controller.decide(t, BetaSample(t, 1.0, UV)) for t in times]
    assert [d.fallback for d in decisions] == [True, True, False, False, False] * 2


@pytest.mark.hazard("H06")
def test_a_late_decision_moves_no_farther_than_one_period():
    controller = BoundedController(constant(0.0), dataclasses.replace(LIMITS, window=1), UV)
    controller.decide(0.0, BetaSample(0.0, 1.0, UV))
    assert controller.decide(60.0, BetaSample(60.0, 1.0, UV)).amplitude_ma == pytest.approx(2.0)


@pytest.mark.hazard("H05")
def test_the_clinicians_limits_hold():
    assert run(constant(0.5), [1.0] * 9, dataclasses.replace(LIMITS, max_ma=3.0, min_ma=2.9))[-1].amplitude_ma == 2.9
    assert run(constant(1.0), [1.0] * 9)[-1].amplitude_ma == 3.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -0.001, 1e39])
def test_beta_that_is_no_amplitude_gives_cdbs_in_that_very_decision_and_until_a_whole_window_has_come(bad):
    network = Answers(0.2)
    decisions = run(network, [100.0] * 8 + [bad] + [100.0] * 4)
    assert decisions[7].amplitude_ma < 1.0
    assert [d.amplitude_ma for d in decisions[8:11]] == [3.0, 3.0, 3.0], "at once, not ramped"
    assert [names(d) for d in decisions[8:11]] == [{"invalid_beta", "window_incomplete"}, {"window_incomplete"}, {"window_incomplete"}]
    assert not decisions[11].fallback
    assert decisions[11].amplitude_ma == pytest.approx(2.5), "and from cDBS at the ramp limit"
    assert all(np.isfinite(asked).all() for asked in network.asked)


@pytest.mark.parametrize("signal", [Signal("mV", "time_domain"), Signal("uV", "device_power"), Signal("", "")])
def test_beta_of_another_unit_or_source_gives_cdbs_at_once(signal):
    controller = BoundedController(constant(0.2), LIMITS, UV)
    for k in range(6):
        controller.decide(2.0 * k, BetaSample(2.0 * k, 1.0, UV))
    decision = controller.decide(12.0, BetaSample(12.0, 1.0, signal))
    assert (decision.amplitude_ma, names(decision)) == (3.0, {"wrong_signal", "window_incomplete"})


@pytest.mark.hazard("H07")
def test_beta_that_stops_coming_gives_cdbs_one_period_after_the_last_one():
    decisions = run(constant(0.2), [100.0] * 8 + [None, None, None])
    assert [d.amplitude_ma for d in decisions[8:]] == [3.0, 3.0, 3.0]
    assert decisions[8].t_s - 7 * 2.0 == LIMITS.period_s
    assert all(names(d) == {"stale_beta"} for d in decisions[8:])
    controller = BoundedController(constant(0.2), LIMITS, UV)
    for k in range(8):
        controller.decide(2.0 * k + 0.1, BetaSample(2.0 * k, 1.0, UV))
    assert not controller.decide(15.7, None).fallback, "1.7 s old: still in time"
    strict = dataclasses.replace(LIMITS, max_beta_age_s=0.5)
    assert names(run(constant(0.2), [100.0] * 8 + [None], strict)[8]) == {"stale_beta"}
    for age in (2.0, 2.5):
        with pytest.raises(ValueError, match="stale before one period"):
            dataclasses.replace(LIMITS, max_beta_age_s=age)


def test_one_beta_that_comes_late_costs_one_decision_and_not_the_window():
    controller = BoundedController(constant(1.0), LIMITS, UV)
    for k in range(5):
        controller.decide(2.0 * k, BetaSample(2.0 * k, 1.0, UV))
    assert names(controller.decide(10.0, None)) == {"stale_beta"}
    assert not controller.decide(10.3, BetaSample(10.0, 1.0, UV)).fallback


def test_before_any_beta_the_amplitude_is_cdbs():
    assert names(run(constant(0.2), [None])[0]) == {"no_beta", "window_incomplete"}
    network = Answers(0.2)
    assert [d.amplitude_ma for d in run(network, [1.0, 1.0])] == [3.0, 3.0]
    assert network.asked == []


def test_a_window_with_a_gap_begins_anew_and_jitter_is_no_gap():
    controller = BoundedController(constant(0.5), LIMITS, UV)
    times = [0.0, 2.0, 3.4, 6.2, 9.3]
    decisions = [controller.decide(t, BetaSample(t, 1.0, UV)) for t in times]
    assert [d.fallback for d in decisions] == [True, True, False, False, True]
    assert names(decisions[-1]) == {"window_gap", "window_incomplete"}
    assert decisions[-1].valid == 1


@pytest.mark.parametrize("t_s", [2.0, 1.0, 9.0, math.nan, -math.inf, math.inf])
def test_a_sample_out_of_order_or_from_the_future_is_left_out_and_said(t_s):
    controller = BoundedController(constant(1.0, 2), dataclasses.replace(LIMITS, window=2), UV)
    controller.decide(0.0, BetaSample(0.0, 1.0, UV))
    controller.decide(2.0, BetaSample(2.0, 1.0, UV))
    decision = controller.decide(4.0, BetaSample(t_s, 50.0, UV))
    assert (names(decision), decision.fallback, decision.valid) == ({"late_sample", "stale_beta"}, True, 2)
    assert names(controller.decide(4.1, BetaSample(4.0, 1.0, UV))) == set(), "and the window is still whole"


@pytest.mark.hazard("H08")
@pytest.mark.parametrize(
    ("answer", "reason"),
    [(math.nan, "policy_output"), (1.2, "policy_output"), (-0.01, "policy_output"), (RuntimeError("weights lost"), "policy_failed")],
)
def test_a_network_that_fails_or_answers_nonsense_gives_cdbs_and_the_log_says_why(answer, reason):
    network = Answers(0.2)
    controller = BoundedController(network, LIMITS, UV)
    for k in range(6):
        controller.decide(2.0 * k, BetaSample(2.0 * k, 1.0, UV))
    network.answer = answer
    decision = controller.decide(12.0, BetaSample(12.0, 1.0, UV))
    assert (decision.amplitude_ma, decision.fallback, names(decision), decision.requested_ma) == (3.0, True, {reason}, None)
    assert decision.detail
    network.answer = 1.0
    assert not controller.decide(14.0, BetaSample(14.0, 1.0, UV)).fallback, "a failure of one decision is of that decision"


def test_rounding_beyond_the_range_is_no_fault():
    decision = run(Answers(1.00005), [1.0] * 3)[-1]
    assert (decision.requested_ma, decision.fallback) == (3.0, False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"min_ma": 3.1}, "cDBS amplitude"),
        ({"min_ma": -0.1}, "rise from 0"),
        ({"max_ma": 0.1}, "rise from 0"),
        ({"max_ma": math.nan}, "max_ma must be a finite number"),
        ({"ramp_ma_per_s": 0}, "ramp_ma_per_s must be positive"),
        ({"period_s": -2}, "period_s must be positive"),
        ({"window": 0}, "window must be at least 1"),
        ({"min_ma": 0, "cdbs_ma": 0}, "and above 0"),
    ],
)
def test_limits_that_contradict_each_other_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(LIMITS, **change)


def test_a_log_entry_is_json_even_for_numbers_that_json_does_not_have():
    entry = run(Answers(math.nan), [1.0] * 3)[-1].to_json()
    assert json.loads(json.dumps(entry, allow_nan=False))["fraction"] is None
    assert entry["reasons"] == ["policy_output"]


def whole(limits, taken, now):
    """Decide by the rule: the newest is valid and of this period, and each of the W periods since the last fault has one.

    As many may be lost as may be imputed, but not the oldest of all."""
    if not taken or not 0 <= now - taken[-1].t_s < limits.period_s:
        return False
    at = {round(s.t_s / limits.period_s): s for s in taken}
    newest = round(taken[-1].t_s / limits.period_s)
    lost = [k not in at or (math.isnan(at[k].beta) and at[k].signal == UV) for k in range(newest - limits.window + 1, newest + 1)]
    wrong = [k for k, s in at.items() if s.signal != UV or s.beta < 0 or (math.isnan(s.beta) and not limits.most_imputed)]
    begun = [k for k, s in at.items() if s.signal == UV and s.beta >= 0 and k > max(wrong, default=-math.inf)]
    for a, b in itertools.pairwise(list(begun)):
        if b - a - 1 > limits.most_imputed:
            begun = [k for k in begun if k >= b]
    oldest = min(begun, default=math.inf)
    return not lost[-1] and oldest <= newest - limits.window + 1 and sum(lost) <= limits.most_imputed


KINDS = ("good", "nan", "negative", "missing", "unit", "again")


@pytest.mark.hazard("H07")
@pytest.mark.parametrize(("window", "most"), [(1, 0), (2, 0), (3, 0), (2, 1), (3, 1), (3, 2)])
def test_every_sequence_of_five_periods_falls_back_exactly_when_the_rule_says(window, most):
    limits = dataclasses.replace(LIMITS, window=window, most_imputed=most)
    for kinds in itertools.product(KINDS, repeat=5):
        controller, taken = BoundedController(constant(0.1, window), limits, UV), []
        before = limits.cdbs_ma
        for k, kind in enumerate(kinds):
            now = 2.0 * k
            sample = {
                "good": BetaSample(now, 5.0, UV),
                "nan": BetaSample(now, math.nan, UV),
                "negative": BetaSample(now, -5.0, UV),
                "missing": None,
                "unit": BetaSample(now, 5.0, Signal("mV", "time_domain")),
                "again": BetaSample(now - 2.0, 5.0, UV),
            }[kind]
            if sample is not None and (not taken or sample.t_s > taken[-1].t_s):
                taken.append(sample)
            decision = controller.decide(now, sample)
            assert decision.fallback == (not whole(limits, taken, now)), (kinds, k)
            assert limits.min_ma <= decision.amplitude_ma <= limits.max_ma
            if decision.fallback:
                assert decision.amplitude_ma == limits.cdbs_ma
                assert decision.reasons & ~Reason.LATE_SAMPLE
            else:
                assert abs(decision.amplitude_ma - before) <= limits.ramp_ma_per_s * limits.period_s + 1e-9
            before = decision.amplitude_ma


@pytest.mark.hazard("H07")
def test_a_lost_beta_is_imputed_in_older_places_and_never_as_the_newest():
    network = Answers(0.2)
    limits = dataclasses.replace(LIMITS, most_imputed=1, carried_over=0.5)
    decisions = run(network, [100.0, 100.0, 100.0, None, 110.0, 100.0, 100.0], limits)
    assert [d.fallback for d in decisions] == [True, True, False, True, False, False, False]
    assert (decisions[3].amplitude_ma, names(decisions[3])) == (3.0, {"stale_beta"})
    assert network.asked[1] == [100.0, pytest.approx(100.0 + 0.5 * 5.0), 110.0], "half of the line, and half of the window's mean"
    assert [("imputed_beta" in names(d)) for d in decisions] == [False, False, False, False, True, True, False]
    assert all(math.isfinite(beta) for asked in network.asked for beta in asked)


@pytest.mark.hazard("H10")
def test_lost_values_between_do_not_hide_that_beta_is_frozen():
    limits = dataclasses.replace(LIMITS, most_imputed=2, frozen_after=4)
    decisions = run(constant(0.2), [100.0, 101.0, 102.0, *[103.0, math.nan, 103.0] * 4], limits)
    assert not any(not d.fallback for d in decisions[9:])
    assert any("frozen_beta" in names(d) for d in decisions)


@pytest.mark.hazard("H08")
@pytest.mark.parametrize("bad", [-1.0, math.inf, 1e39])
def test_what_came_and_is_wrong_is_never_imputed(bad):
    limits = dataclasses.replace(LIMITS, most_imputed=2)
    decisions = run(constant(0.2), [100.0] * 5 + [bad] + [100.0] * 4, limits)
    assert [d.fallback for d in decisions[5:]] == [True, True, True, False, False]


@pytest.mark.parametrize("change", [{"most_imputed": 3}, {"most_imputed": -1}, {"carried_over": 1.1}, {"carried_over": -0.1}])
def test_a_rule_that_would_impute_a_whole_window_is_refused(change):
    with pytest.raises(ValueError, match="are no rule"):
        dataclasses.replace(LIMITS, **change)


@st.composite
def limits_of_any_kind(draw):
    low, cdbs, high = sorted(draw(st.lists(st.floats(0.01, 8), min_size=3, max_size=3)))
    ramp, window = draw(st.floats(0.01, 5)), draw(st.integers(1, 4))
    most, weight = draw(st.integers(0, window - 1)), draw(st.floats(0, 1))
    return EnvelopeLimits(min_ma=low, max_ma=high, cdbs_ma=cdbs, ramp_ma_per_s=ramp, window=window, most_imputed=most, carried_over=weight)


ANYTHING = st.floats(allow_nan=True, allow_infinity=True)
ANSWERS = st.floats(0, 1) | ANYTHING | st.just(RuntimeError("broken"))
SAMPLES = st.none() | st.tuples(st.floats(-4, 1) | ANYTHING, st.floats(0, 1e4) | ANYTHING, st.sampled_from([UV, UV, Signal("mV", "x")]))


@pytest.mark.hazard("H05")
@settings(deadline=None)
@given(limits=limits_of_any_kind(), stream=st.lists(st.tuples(st.floats(0, 5) | ANYTHING, SAMPLES, ANSWERS), max_size=25))
def test_whatever_comes_the_limits_hold_and_no_number_is_missing(limits, stream):
    network = Answers(0.0, limits.window)
    controller, now, before, last = BoundedController(network, limits, UV), 0.0, limits.cdbs_ma, None
    newest = -math.inf  # time of the last beta amplitude that could have been used
    for wait, came, answer in stream:
        now = now + wait if math.isfinite(wait) else wait
        network.answer = answer
        decision = controller.decide(now, None if came is None else BetaSample(now + came[0], came[1], came[2]))
        assert math.isfinite(decision.amplitude_ma)
        assert limits.min_ma <= decision.amplitude_ma <= limits.max_ma
        assert decision.amplitude_ma == controller.envelope.amplitude_ma
        if came is not None and came[2] == UV and 0 <= came[1] < 3e38 and newest < now + came[0] <= now + 1e-9:
            newest = now + came[0]
        if not now - newest < limits.period_s:
            assert decision.fallback, "one period after the last valid beta at the latest"
        if decision.fallback:
            assert decision.amplitude_ma == limits.cdbs_ma
            assert decision.reasons
        else:
            elapsed = limits.period_s if last is None else min(max(now - last, 0.0), limits.period_s)
            assert abs(decision.amplitude_ma - before) <= limits.ramp_ma_per_s * elapsed + 1e-9
            assert decision.valid == limits.window
            assert -1e-4 <= answer <= 1 + 1e-4
        before = decision.amplitude_ma
        last = last if math.isnan(now) else now
        now = now if math.isfinite(now) else 0.0
