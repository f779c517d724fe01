"""Clocks, counters and sentinels that all formats share."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats.facts import clocks
from ml.formats.facts.clocks import Moment, Offset, OtherClock, estimate
from ml.formats.facts.counters import shift_by_turns, unwrap
from ml.formats.facts.sentinels import reading, readings
from ml.formats.percept.facts import FACTS as PERCEPT
from ml.formats.rcs.packets.facts import FACTS as RCS

COUNTERS = {**PERCEPT.counters, **RCS.counters}
FIELDS = {**PERCEPT.fields, **RCS.fields}
NOON = datetime(2026, 3, 5, 12, 0, tzinfo=UTC)


def seconds(number: float) -> timedelta:
    return timedelta(seconds=number)


@pytest.mark.parametrize("name", COUNTERS)
@given(steps=st.lists(st.integers(0, 40), min_size=1, max_size=80), first=st.integers(0, 255))
def test_every_counter_of_the_formats_runs_on_where_it_restarts(name, steps, first):
    counter = COUNTERS[name]
    true = counter.turn / 256 * (first + np.concatenate(([0], np.cumsum(steps))))
    np.testing.assert_allclose(unwrap(true % counter.turn, counter.turn), true)


def test_a_value_out_of_order_is_no_turn():
    assert unwrap(np.array([10.0, 5.0, 20.0]), 256).tolist() == [10, 5, 20]


@given(value=st.integers(0, 255), turns=st.integers(-3, 9), distance=st.integers(-100, 100))
def test_two_series_meet_after_whole_turns(value, turns, distance):
    result = value + shift_by_turns(value, value + 256 * turns + distance, 256)
    assert result == value + 256 * turns


@pytest.mark.parametrize("name", FIELDS)
def test_no_sentinel_and_nothing_beyond_the_bounds_is_a_reading(name):
    field = FIELDS[name]
    values = np.array([field.low, np.nextafter(field.high, 0), *field.sentinels, field.low - 1, field.high * 2 + 1, np.inf, np.nan])
    kept, wrong = readings(values, field)
    assert np.isfinite(kept).tolist() == [True, True] + [False] * (values.size - 2)
    assert wrong == values.size - 3
    assert [reading(s, field) for s in (*field.sentinels, None)] == [None] * (len(field.sentinels) + 1)
    assert reading(field.low, field) == field.low


@pytest.mark.parametrize("ahead", [2254.0, 956.0, 0.0, -401.0, -5 * 3600.0, 23 * 3600.0])
def test_a_clock_ahead_or_behind_comes_to_utc(ahead):
    offset = estimate("implant", [(NOON + seconds(ahead), NOON), (NOON + seconds(1800 + ahead), NOON + seconds(1800))])
    assert offset.known
    assert offset.ahead_s == ahead
    assert offset.utc(Moment("implant", NOON + seconds(600 + ahead))) == NOON + seconds(600)


def test_a_clock_that_drifts_is_right_in_between_and_its_uncertainty_says_so():
    offset = estimate("implant", [(NOON + seconds(900), NOON), (NOON + seconds(1800 + 940), NOON + seconds(1800))])
    assert abs((offset.utc(Moment("implant", NOON + seconds(900 + 920))) - (NOON + seconds(900))).total_seconds()) < 1
    assert offset.uncertainty_s == 40


@pytest.mark.parametrize(
    ("pairs", "why"),
    [
        ([], "does not show it beside"),
        ([(NOON, None), (None, NOON)], "does not show it beside"),
        ([(NOON + timedelta(days=453), NOON)], "453 d ahead of UTC, which is no clock but a wrong date"),
        ([(NOON, NOON), (NOON + seconds(1800), NOON)], "so one of the dates is wrong"),
    ],
)
def test_a_clock_that_cannot_be_believed_is_unknown_and_says_why(pairs, why):
    offset = estimate("implant", pairs)
    assert (offset.known, offset.ahead_s, offset.uncertainty_s) == (False, None, None)
    assert why in offset.why
    assert offset.utc(Moment("implant", NOON)) == NOON


def test_one_believable_pair_of_two_counts_and_is_doubtful():
    offset = estimate("implant", [(NOON + timedelta(days=800), NOON), (NOON + seconds(60), NOON)])
    assert (offset.ahead_s, offset.doubtful) == (60.0, True)


def test_moments_of_two_clocks_are_never_joined():
    implant, other = Moment("implant", NOON), Moment("computer", NOON + seconds(5))
    assert Moment("computer", NOON).seconds_after(other) == -5
    with pytest.raises(OtherClock, match="cannot be compared"):
        implant.seconds_after(other)
    with pytest.raises(OtherClock, match="says nothing of"):
        Offset("implant", (), None, "x").utc(other)


def test_an_offset_is_told_in_words():
    assert clocks.lead_in_words(2254) == "37 min 34 s ahead of"
    assert clocks.lead_in_words(-86_401) == "1 d 1 s behind"
