from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.qoc import (
    TREMOR_CLASSES,
    Qoc,
    grasp_frequency,
    read_tremor,
    tremor_by_class,
    tremor_by_duration,
    tremor_percent,
)


def minute(**shares):
    return [shares.get(name, 0.0) for name in TREMOR_CLASSES]


def tremor(rows, session, first=0.0):
    n = len(rows)
    start = first + 60.0 * np.arange(n)
    begin, end = session
    return read_tremor(start, np.full(n, 60.0), np.array(rows, dtype=float).reshape(n, 6), begin, end - begin)


TWO_MINUTES = [minute(none=0.6, mild=0.4), minute(mild=0.3, moderate=0.3, strong=0.3, unknown=0.1)]


def test_grasp_frequency_is_one_over_the_mean_interval():
    assert grasp_frequency(np.array([0.0, 0.4, 1.0, 1.5])) == pytest.approx(3 / 1.5)


@pytest.mark.parametrize("times", [[], [1.0], [1.0, 1.0], [2.0, 1.0]])
def test_too_few_or_falling_open_fists_have_no_frequency(times):
    with pytest.raises(ValueError):
        grasp_frequency(np.array(times))


@pytest.mark.parametrize("wrong", [{"grasp_hz": -1.0}, {"rating": 11}, {"rating": 0}, {"tremor_percent": 101.0}])
def test_a_qoc_outside_its_range_is_refused(wrong):
    with pytest.raises(ValueError, match=str(next(iter(wrong.values())))):
        Qoc(**wrong)


def test_the_paper_counts_mild_moderate_and_strong_over_the_whole_session():
    seconds = {"mild": 30.0, "moderate": 20.0, "strong": 10.0, "slight": 60.0, "unknown": 120.0, "none": 360.0}
    assert tremor_percent(seconds, 600.0) == pytest.approx(10.0)


def test_the_two_readings_of_a_minute_differ():
    found = tremor(TWO_MINUTES, (0, 120))
    assert found.duration_weighted == pytest.approx(100 * (0.4 + 0.9) / 2)
    assert found.arg_max == pytest.approx(50.0)


def test_unknown_and_uncovered_time_is_part_of_the_session_and_told():
    found = tremor([minute(unknown=1.0), minute(mild=1.0)], (0, 240))
    assert found.duration_weighted == found.arg_max == pytest.approx(25.0)
    assert (found.unknown_s, found.covered_s, found.session_s) == (60.0, 120.0, 240.0)


def test_minutes_at_the_ends_of_a_session_count_by_their_overlap():
    found = tremor([minute(strong=1.0), minute(none=1.0), minute(mild=0.5, none=0.5)], (45.0, 150.0))
    assert found.class_seconds["strong"] == pytest.approx(15.0)
    assert found.class_seconds["mild"] == pytest.approx(15.0)
    assert found.duration_weighted == pytest.approx(100 * 30 / 105)
    assert found.arg_max == pytest.approx(100 * 15 / 105)
    assert found.covered_s == pytest.approx(105.0)


def test_minutes_outside_the_session_do_not_count():
    found = tremor([minute(strong=1.0)], (60.0, 120.0))
    assert (found.duration_weighted, found.covered_s) == (0.0, 0.0)


def test_minutes_that_tell_only_all_tremor_cover_nothing():
    found = tremor([minute(none=1.0), [float("nan")] * 6], (0, 120))
    assert (found.covered_s, found.undivided_s) == (60.0, 60.0)


def test_a_minute_known_to_be_without_tremor_needs_no_more_detail():
    found = tremor([[float("nan"), float("nan"), 0.0, 0.0, 0.0, 0.0]], (0, 60))
    assert (found.duration_weighted, found.arg_max, found.covered_s) == (0.0, 0.0, 60.0)


def test_of_equal_shares_the_minute_is_never_given_to_the_stronger_tremor():
    whole = tremor_by_class(np.array([minute(none=0.5, mild=0.5), minute(mild=0.5, strong=0.5)]))
    assert [TREMOR_CLASSES[i] for i in whole.argmax(axis=1)] == ["none", "mild"]


def test_time_given_to_no_class_is_unknown_and_rounding_is_not():
    rows = np.array([minute(moderate=0.6), minute(moderate=0.4), minute(moderate=0.495, none=0.49)])
    rows[:, 1] = [np.nan, np.nan, 0.49]
    assert [TREMOR_CLASSES[i] for i in tremor_by_class(rows).argmax(axis=1)] == ["moderate", "unknown", "moderate"]


def test_minutes_that_claim_the_same_time_are_refused_and_a_second_of_rounding_is_not():
    shares = np.array([minute(mild=1.0), minute(mild=1.0)])
    lengths = np.full(2, 60.0)
    with pytest.raises(ValueError, match="twice"):
        read_tremor(np.array([0.0, 30.0]), lengths, shares, 0.0, 120.0)
    assert read_tremor(np.array([0.0, 59.2]), lengths, shares, 0.0, 119.2).duration_weighted == pytest.approx(100.0)


@pytest.mark.parametrize(("rows", "length"), [(1, 0.0), (1, -10.0), (1, float("nan")), (2, 10.0)])
def test_sessions_without_length_and_shapes_that_do_not_fit_are_refused(rows, length):
    with pytest.raises(ValueError):
        read_tremor(np.zeros(1), np.full(1, 60.0), np.zeros((rows, 6)), 0.0, length)


@given(
    shares=st.lists(st.lists(st.floats(0.0, 1.0), min_size=6, max_size=6).filter(lambda s: sum(s) > 0.1), min_size=1, max_size=12),
    begin=st.floats(-100, 300),
    length=st.floats(1.0, 900.0),
)
def test_both_readings_agree_with_a_sum_over_the_minutes(shares, begin, length):
    rows = [list(np.array(s) / sum(s)) for s in shares]
    found = tremor(rows, (begin, begin + length))
    assert sum(found.class_seconds.values()) == pytest.approx(found.covered_s, abs=1e-6)
    overlaps = [max(0.0, min(60.0 * (i + 1), begin + length) - max(60.0 * i, begin)) for i in range(len(rows))]
    assert found.covered_s == pytest.approx(sum(overlaps), abs=1e-6)
    slow = sum(o * (row[3] + row[4] + row[5]) for o, row in zip(overlaps, rows, strict=True))
    whole = sum(o for o, row in zip(overlaps, rows, strict=True) if np.argmax(row) in (3, 4, 5))
    assert found.duration_weighted == pytest.approx(100 * slow / length, abs=1e-6)
    assert found.arg_max == pytest.approx(100 * whole / length, abs=1e-6)


def test_minutes_of_one_class_each_read_the_same_both_ways():
    rows = np.eye(6)
    np.testing.assert_array_equal(tremor_by_class(rows), tremor_by_duration(rows))


def test_a_session_of_tremor_alone_is_100_per_cent_although_its_shares_were_rounded() -> None:
    shares = np.zeros((3, 6), dtype=np.float32)
    shares[:, 3:] = np.array([0.1, 0.2, 0.7], dtype=np.float32)
    shares[:, 5] = np.nextafter(shares[:, 5], np.float32(1))
    found = read_tremor(60.0 * np.arange(3), np.full(3, 60.0), shares.astype(np.float64), 10.0, 150.0)
    assert found.duration_weighted == 100.0
