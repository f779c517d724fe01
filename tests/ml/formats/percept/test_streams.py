from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats.percept.streams import TURN_MS, TimeDomain, device_powers, place, time_domains

RATE = 250.0


def channel(samples):
    return TimeDomain("ONE_THREE_RIGHT", "right", "BrainSenseTimeDomain", None, RATE, np.arange(samples, dtype=float))


def placed(sizes, ticks, samples=None, sequences=None):
    data = channel(int(sum(sizes)) if samples is None else samples)
    place(data, np.array(sizes, dtype=float), np.array(ticks, dtype=float), sequences)
    return data


def slow_times_ms(sizes, ticks):
    """Compute the time of every sample, packet by packet from the last to the first, as Medtronic's published loop walks."""
    step = 1000.0 / RATE
    times = []
    for k in range(len(sizes) - 1, -1, -1):
        after_a_loss = k == len(sizes) - 1 or ticks[k + 1] - ticks[k] > (1 + sizes[k + 1]) * step
        last = ticks[k] if after_a_loss else times[0] - step
        times = [last - step * i for i in range(sizes[k] - 1, -1, -1)] + times
    return times


def times_ms(data):
    return np.concatenate([start + np.arange(end - first) * 1000.0 / RATE for start, first, end in data.pieces])


def test_a_packets_tick_is_the_time_of_its_last_sample():
    data = placed([125, 125], [1000, 1500])
    assert (data.begin_ms, data.end_ms, data.lost) == (500.0, 1500.0, 0)
    np.testing.assert_allclose(times_ms(data)[[0, -1]], [504.0, 1500.0])


def test_packets_of_62_and_63_samples_in_quarter_seconds_lose_nothing():
    sizes = [62, 63] * 20
    data = placed(sizes, [250 * (k + 1) for k in range(40)])
    assert (data.lost, len(data.pieces)) == (0, 1)


def test_a_sequence_step_of_two_is_no_loss():
    sequences = ",".join(str((3 * k + 1) // 2) for k in range(8))
    assert placed([125] * 8, [500 * (k + 1) for k in range(8)], sequences=sequences).lost == 0


def test_a_jump_of_the_ticks_is_loss_of_as_many_samples():
    data = placed([125, 125, 125], [500, 1000, 3000])
    assert data.lost == 375
    assert [(first, end) for _, first, end in data.pieces] == [(0, 250), (250, 375)]
    starts = [s for s, _, _ in data.stretches(0.0)]
    np.testing.assert_allclose(starts, [0.004, 2.504])


def test_an_oversized_packet_that_makes_up_for_a_late_one_loses_nothing():
    data = placed([63, 125, 62], [252, 750, 1000])
    assert (data.lost, len(data.pieces)) == (0, 1)


def test_ticks_that_begin_anew_run_on():
    ticks = [TURN_MS - 1000, TURN_MS - 500, 0.0, 500.0]
    data = placed([125] * 4, ticks)
    assert (data.lost, data.end_ms - data.begin_ms) == (0, 2000.0)


def test_a_packet_that_comes_twice_counts_once():
    data = placed([125, 125, 125, 125], [500, 1000, 1000, 1500], sequences=[0, 1, 1, 3])
    assert sum(end - first for _, first, end in data.pieces) == 375
    assert data.lost == 0
    assert "came twice" in data.notes[0]


def test_samples_that_the_list_of_packets_forgets_follow_the_last_packet():
    data = placed([125, 125], [500, 1000], samples=288)
    assert data.end_ms == pytest.approx(1000 + 38 * 4)
    assert "38 samples of the end" in data.notes[0]


def test_a_list_of_packets_longer_than_the_samples_is_cut():
    data = placed([125, 125, 125], [500, 1000, 1500], samples=200)
    assert [(first, end) for _, first, end in data.pieces] == [(0, 200)]
    assert "200 are there" in data.notes[0]


def test_without_ticks_samples_follow_each_other_from_zero():
    (data,) = time_domains("LfpMontageTimeDomain", {"TimeDomainData": [1.0] * 100, "GlobalPacketSizes": "[25, 38]", "TicksInMses": ""})
    assert not data.ticked
    assert (data.begin_ms, data.end_ms) == (0.0, 400.0)


def test_samples_without_a_number_cut_a_stretch():
    data = channel(100)
    data.values[40:45] = np.nan
    place(data, np.array([100.0]), np.array([400.0]))
    assert [(round(t, 3), x.size) for t, _, x in data.stretches(0.0)] == [(0.004, 40), (0.184, 55)]


def test_power_that_does_not_come_later_is_left_out():
    rows = [{"TicksInMs": t, "Left": {"LFP": 1, "mA": 1}} for t in (500, 1000, 1000, 800, 1500)]
    (data,) = device_powers([{"LfpData": rows, "Channel": "ZERO_TWO_LEFT"}])
    assert data.ticks_ms.tolist() == [500, 1000, 1500]
    assert "2 power values" in data.void[0]


@given(
    packets=st.lists(st.tuples(st.integers(20, 130), st.sampled_from([0, 0, 0, 0, 1, 3, 7])), min_size=1, max_size=25),
    first=st.integers(0, 3_000_000),
)
def test_placing_agrees_with_the_published_loop(packets, first):
    sizes = [size for size, _ in packets]
    ticks, now = [], float(first)
    for size, gone in packets:
        now += 4.0 * size + 600.0 * gone
        ticks.append(now)
    data = placed(sizes, ticks)
    np.testing.assert_allclose(times_ms(data), slow_times_ms(sizes, ticks), atol=1e-6)
    assert data.lost == sum(150 * gone for _, gone in packets[1:])


@given(
    sizes=st.one_of(
        st.none(), st.text(max_size=40), st.lists(st.one_of(st.integers(-5, 300), st.floats(), st.text(max_size=3)), max_size=30)
    ),
    ticks=st.one_of(st.none(), st.text(max_size=40), st.lists(st.one_of(st.integers(-(10**7), 10**7), st.floats()), max_size=30)),
    samples=st.integers(0, 500),
)
def test_whatever_the_lists_hold_every_sample_is_placed_once_and_forward(sizes, ticks, samples):
    found = time_domains("x", [{"TimeDomainData": [0.5] * samples, "GlobalPacketSizes": sizes, "TicksInMses": ticks}])
    for data in found:
        used = sum(end - first for _, first, end in data.pieces)
        assert used <= samples
        assert np.all(np.diff(times_ms(data)) > 0)
        assert data.end_ms - data.begin_ms < 4 * 24 * 3600e3


def test_packets_in_pairs_under_one_tick_are_one_stretch():
    data = placed([62, 63] * 20, np.repeat(1000.0 + 500.0 * np.arange(20), 2))
    assert (len(data.pieces), data.lost, data.notes) == (1, 0, [])
    assert (data.begin_ms, data.end_ms) == (500.0, 10_500.0)


def test_a_pair_that_is_missing_is_lost_once():
    ticks = np.repeat(1000.0 + 500.0 * np.delete(np.arange(20), 7), 2)
    data = placed([62, 63] * 19, ticks)
    assert (len(data.pieces), data.lost) == (2, 125)


def test_a_power_rate_that_the_ticks_contradict_is_that_of_the_ticks():
    rows = [{"TicksInMs": 1000 + 500 * k, "Left": {"LFP": 10 + k, "mA": 2.0}, "Right": {"LFP": 0, "mA": 0.0}} for k in range(40)]
    (stated,) = device_powers([{"Channel": "ZERO_TWO_LEFT", "SampleRateInHz": 2, "LfpData": rows}])
    (wrong,) = device_powers([{"Channel": "ZERO_TWO_LEFT", "SampleRateInHz": 250, "LfpData": rows}])
    assert (stated.interval_ms, stated.notes) == (500.0, [])
    assert wrong.interval_ms == 500.0
    assert wrong.notes == ["a power value every 4 ms is stated, the ticks say every 500 ms: the ticks count"]


@pytest.mark.parametrize(("stated", "notes"), [(250, 0), (125, 1), (1000, 1)])
def test_a_sampling_rate_that_the_ticks_contradict_is_that_of_the_ticks(stated, notes):
    kept = np.delete(np.arange(40), [10, 11, 25])
    entry = {
        "Channel": "ONE_THREE_RIGHT",
        "SampleRateInHz": stated,
        "TimeDomainData": [1.0] * (125 * kept.size),
        "GlobalPacketSizes": [125] * kept.size,
        "TicksInMses": (1000 + 500 * kept).tolist(),
        "GlobalSequences": kept.tolist(),
    }
    (data,) = time_domains("BrainSenseTimeDomain", [entry])
    assert (data.rate_hz, data.lost, len(data.notes)) == (250.0, 375, notes)
