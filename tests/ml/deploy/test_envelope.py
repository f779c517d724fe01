from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.deploy.envelope import BetaSample, EnvelopeLimits, EnvelopeState, Reason, initial_state, step
from ml.rl.policy import ConstantPolicy

LIMITS = EnvelopeLimits(min_ma=0.5, max_ma=3.2, cdbs_ma=3.0, ramp_ma_per_s=0.25, window=3, period_s=2.0)
REASONS = {value for name, value in vars(Reason).items() if name.isupper()}


class Answers:
    """A policy that answers what it is told and remembers what it was asked."""

    def __init__(self, answer):
        self.answer, self.asked = answer, []

    def act(self, states):
        self.asked.append(np.array(states))
        if isinstance(self.answer, Exception):
            raise self.answer
        return np.atleast_1d(np.asarray(self.answer, dtype=float))


def run(policy, betas, limits=LIMITS, state=None):
    """Decisions over a stream with one sample per period; None where no sample came."""
    state, decisions = state or initial_state(limits), []
    for k, beta in enumerate(betas):
        now = limits.period_s * k
        state, decision = step(limits, state, now, None if beta is None else BetaSample(now, beta), policy)
        decisions.append(decision)
    return state, decisions


def whole_window(amplitude_ma=3.0, limits=LIMITS):
    """The state one sample before a whole window."""
    return EnvelopeState(amplitude_ma, tuple(BetaSample(limits.period_s * k, 100.0 + k) for k in range(limits.window - 1)))


def one_step(policy, *, state=None, limits=LIMITS, beta=100.0):
    state = state or whole_window(limits=limits)
    now = limits.period_s * (limits.window - 1)
    return step(limits, state, now, BetaSample(now, beta), policy)[1]


def test_the_policy_is_asked_with_the_window_oldest_first_and_its_fraction_is_of_cdbs():
    policy = Answers(0.9)
    decision = one_step(policy, beta=140.0)
    np.testing.assert_array_equal(policy.asked, [[[100.0, 101.0, 140.0]]])
    assert decision.requested_ma == pytest.approx(2.7)
    assert decision.amplitude_ma == pytest.approx(2.7)
    assert (decision.fallback, decision.reasons, decision.fraction) == (False, (), 0.9)
    assert (decision.beta, decision.beta_age_s) == (140.0, 0.0)


def test_the_amplitude_never_moves_faster_than_the_ramp():
    _, decisions = run(ConstantPolicy(0.0), [100.0] * 10)
    assert [d.amplitude_ma for d in decisions] == pytest.approx([3.0, 3.0, 2.5, 2.0, 1.5, 1.0, 0.5, 0.5, 0.5, 0.5])
    assert [Reason.RAMP in d.reasons for d in decisions] == [False, False, True, True, True, True, False, False, False, False]
    assert decisions[-1].reasons == (Reason.MINIMUM,)


def test_the_clinicians_maximum_holds():
    limits = dataclasses.replace(LIMITS, max_ma=3.0, min_ma=2.9)
    assert one_step(ConstantPolicy(0.5), limits=limits).amplitude_ma == 2.9
    low = dataclasses.replace(LIMITS, cdbs_ma=1.0, max_ma=1.0, min_ma=0.0)
    assert one_step(ConstantPolicy(1.0), limits=low, state=whole_window(2.0)).amplitude_ma == 1.0


def test_until_a_whole_window_has_come_the_amplitude_is_cdbs():
    policy = Answers(0.2)
    _, decisions = run(policy, [100.0, 100.0])
    assert [d.amplitude_ma for d in decisions] == [3.0, 3.0]
    assert all(d.fallback and d.reasons == (Reason.WINDOW_INCOMPLETE,) for d in decisions)
    assert policy.asked == []
    assert run(policy, [None])[1][0].reasons == (Reason.NO_BETA,)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_beta_that_is_no_number_gives_cdbs_in_that_very_period_and_until_it_has_left_the_window(bad):
    policy = Answers(0.2)
    _, decisions = run(policy, [100.0] * 8 + [bad] + [100.0] * 4)
    assert decisions[7].amplitude_ma < 1.0
    assert [d.amplitude_ma for d in decisions[8:11]] == [3.0, 3.0, 3.0]
    assert all(Reason.INVALID_BETA in d.reasons and d.fallback for d in decisions[8:11])
    assert not decisions[11].fallback
    assert all(np.isfinite(asked).all() for asked in policy.asked)


def test_beta_that_stops_coming_gives_cdbs_when_it_is_older_than_one_period():
    _, decisions = run(ConstantPolicy(0.2), [100.0] * 8 + [None, None, None])
    assert not decisions[8].fallback, "one period old: still in time"
    assert [d.amplitude_ma for d in decisions[9:]] == [3.0, 3.0]
    assert decisions[9].reasons == (Reason.STALE_BETA,)
    strict = dataclasses.replace(LIMITS, max_beta_age_s=0.5)
    assert run(ConstantPolicy(0.2), [100.0] * 8 + [None], strict)[1][8].reasons == (Reason.STALE_BETA,)


def test_a_window_with_a_gap_is_no_window():
    state = EnvelopeState(3.0, (BetaSample(0.0, 1.0), BetaSample(2.0, 1.0)))
    _, late = step(LIMITS, state, 7.0, BetaSample(6.9, 1.0), ConstantPolicy(0.5))
    assert late.reasons == (Reason.WINDOW_GAP,)
    _, jitter = step(LIMITS, state, 4.6, BetaSample(4.6, 1.0), ConstantPolicy(0.5))
    assert not jitter.fallback


@pytest.mark.parametrize("t_s", [2.0, 1.0, 9.0, math.nan])
def test_a_sample_out_of_order_or_from_the_future_is_left_out_and_said(t_s):
    state = EnvelopeState(3.0, (BetaSample(-2.0, 1.0), BetaSample(0.0, 1.0), BetaSample(2.0, 1.0)))
    after, decision = step(LIMITS, state, 4.0, BetaSample(t_s, 50.0), ConstantPolicy(1.0))
    assert after.samples == state.samples
    assert decision.reasons == (Reason.LATE_SAMPLE,)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (math.nan, Reason.POLICY_OUTPUT),
        (1.2, Reason.POLICY_OUTPUT),
        (-0.01, Reason.POLICY_OUTPUT),
        ([0.5, 0.5], Reason.POLICY_OUTPUT),
        (RuntimeError("weights lost"), Reason.POLICY_FAILED),
    ],
)
def test_a_policy_that_fails_or_answers_nonsense_gives_cdbs_and_the_log_says_why(answer, reason):
    decision = one_step(Answers(answer), state=whole_window(1.0))
    assert (decision.amplitude_ma, decision.fallback, decision.reasons) == (3.0, True, (reason,))
    assert decision.requested_ma is None
    assert decision.detail
    if isinstance(answer, Exception):
        assert decision.detail == "RuntimeError: weights lost"


def test_rounding_beyond_the_range_is_no_fault():
    decision = one_step(Answers(1.00005))
    assert (decision.requested_ma, decision.fallback) == (3.0, False)


def test_the_way_back_to_cdbs_can_be_ramped():
    limits = dataclasses.replace(LIMITS, fallback_ramp_ma_per_s=0.5)
    _, decisions = run(Answers(math.nan), [100.0] * 4, limits, EnvelopeState(0.5))
    assert [d.amplitude_ma for d in decisions] == pytest.approx([1.5, 2.5, 3.0, 3.0])
    assert [Reason.RAMP in d.reasons for d in decisions] == [True, True, False, False]


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
    entry = one_step(Answers(0.5), beta=math.nan).to_json()
    assert json.loads(json.dumps(entry, allow_nan=False))["beta"] is None
    assert entry["reasons"] == [Reason.INVALID_BETA]


@st.composite
def limits_of_any_kind(draw):
    low, cdbs, high = sorted(draw(st.lists(st.floats(0.01, 8), min_size=3, max_size=3)))
    return EnvelopeLimits(
        min_ma=low,
        max_ma=high,
        cdbs_ma=cdbs,
        ramp_ma_per_s=draw(st.floats(0.01, 5)),
        window=draw(st.integers(1, 4)),
        fallback_ramp_ma_per_s=draw(st.none() | st.floats(0.01, 5)),
    )


ANSWERS = st.floats(0, 1) | st.sampled_from([math.nan, math.inf, -3.0, 2.0, RuntimeError("broken"), [0.1, 0.2]])
BETAS = st.none() | st.floats(0, 1e4) | st.sampled_from([math.nan, math.inf])


@given(limits=limits_of_any_kind(), stream=st.lists(st.tuples(st.floats(0, 5), BETAS, st.floats(-4, 1), ANSWERS), max_size=25))
def test_whatever_comes_the_limits_hold_and_every_difference_has_its_reason(limits, stream):
    state, now = initial_state(limits), 0.0
    for wait, beta, lag, answer in stream:
        now += wait
        sample = None if beta is None else BetaSample(now + lag, beta)
        before = state
        state, decision = step(limits, before, now, sample, Answers(answer))
        again = step(limits, before, now, sample, Answers(answer))
        assert (again[0].amplitude_ma, again[1].to_json()) == (state.amplitude_ma, decision.to_json()), "a pure function"
        assert state.amplitude_ma == decision.amplitude_ma
        assert limits.min_ma <= decision.amplitude_ma <= limits.max_ma
        assert set(decision.reasons) <= REASONS
        assert len(state.samples) <= limits.window
        change = abs(decision.amplitude_ma - before.amplitude_ma)
        if decision.fallback:
            assert decision.reasons
            if limits.fallback_ramp_ma_per_s is None:
                assert decision.amplitude_ma == limits.cdbs_ma
            else:
                assert change <= limits.fallback_ramp_ma_per_s * limits.period_s + 1e-9
        else:
            assert change <= limits.ramp_ma_per_s * limits.period_s + 1e-9
            assert len(state.samples) == limits.window
            assert isinstance(answer, float)
            assert 0 <= answer <= 1
            if not set(decision.reasons) - {Reason.LATE_SAMPLE}:
                assert decision.amplitude_ma == pytest.approx(answer * limits.cdbs_ma, abs=1e-6)
