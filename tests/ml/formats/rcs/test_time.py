from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats.rcs.packets.clock import fit_clock
from ml.formats.rcs.packets.headers import PacketHeaders
from ml.formats.rcs.packets.ticks import device_ms
from ml.formats.rcs.packets.time import reconstruct
from ml.formats.rejection import Rejected

RATE = 500.0
PER_PACKET = 50
START_MS = 1.7e12


def packets(count=200, lost=(), first_s=3.0, noise_ms=0.0, seed=0):
    """Build a stream of 100 ms packets whose true times are known, and those times in ms."""
    index = np.array([i for i in range(count) if i not in set(lost)])
    t = (index + 1) * PER_PACKET / RATE
    ticks = np.rint((first_s + t) * 10_000).astype(np.int64)
    gen = START_MS + 1000 * t + np.random.default_rng(seed).normal(0, noise_ms, t.size) if noise_ms else START_MS + 1000 * t
    headers = PacketHeaders(
        seconds=(700_000_000 + ticks // 10_000).astype(np.int64),
        tick=ticks % 65_536,
        gen_ms=gen,
        rx_ms=gen + 40.0,
        sequence=index % 256,
        samples=np.full(t.size, PER_PACKET),
        rate_hz=np.full(t.size, RATE),
    )
    return headers, START_MS + 1000 * t


def with_gen(headers, gen):
    return dataclasses.replace(headers, gen_ms=gen)


def test_a_whole_stream_is_one_chunk_with_true_times_over_many_rollovers():
    headers, true = packets(count=600)
    times = reconstruct(headers)
    assert (times.chunks, times.missing, times.loss) == (1, 0, 0.0)
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def test_noise_of_the_pc_clock_does_not_move_packets_against_each_other():
    headers, true = packets(count=600, noise_ms=20.0)
    times = reconstruct(headers)
    np.testing.assert_allclose(np.diff(times.last_ms), 100.0, atol=1e-3)
    assert abs(times.last_ms[0] - true[0]) < 4.0


def test_lost_packets_are_counted_and_split_the_stream():
    headers, true = packets(lost=(50, 51, 52, 120))
    times = reconstruct(headers)
    assert (times.chunks, times.missing) == (3, 4)
    assert times.loss == pytest.approx(4 / 200)
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def test_a_long_silence_is_signal_that_is_missing():
    headers, _ = packets(lost=range(50, 150))
    times = reconstruct(headers)
    assert (times.chunks, times.missing, times.loss) == (2, 100, 0.5)


def test_a_pause_of_whole_sequence_and_tick_turns_is_still_seen():
    headers, true = packets(count=900, lost=range(100, 100 + 256))
    times = reconstruct(headers)
    assert times.chunks == 2
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def test_packets_without_a_generation_time_are_placed_with_their_chunk():
    headers, true = packets()
    gen = headers.gen_ms.copy()
    gen[:15] = -62135568000000
    gen[90] = 0
    times = reconstruct(with_gen(headers, gen))
    assert times.chunks == 1
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def test_a_chunk_without_any_generation_time_is_placed_by_the_device_clock():
    headers, true = packets(lost=(20, 21))
    gen = headers.gen_ms.copy()
    gen[:20] = -62135568000000
    times = reconstruct(with_gen(headers, gen))
    assert times.chunks == 2
    assert not times.device_clock
    np.testing.assert_allclose(times.last_ms, true, atol=2.0)


def test_a_file_without_any_generation_time_keeps_relative_times():
    headers, true = packets(lost=(50, 51))
    times = reconstruct(with_gen(headers, np.full(headers.size, -62135568000000.0)))
    assert times.device_clock
    np.testing.assert_allclose(np.diff(times.last_ms), np.diff(true), atol=2.0)
    np.testing.assert_allclose(times.last_ms, headers.rx_ms, atol=2.0)


def test_the_second_of_two_equal_packets_is_rejected():
    headers, true = packets()
    order = np.insert(np.arange(200), 101, 100)
    doubled = PacketHeaders(*(getattr(headers, f.name)[order] for f in dataclasses.fields(headers)))
    times = reconstruct(doubled)
    assert times.rejected == {Rejected.DUPLICATE: 1}
    assert np.isnan(times.last_ms[101])
    np.testing.assert_allclose(np.delete(times.last_ms, 101), true, atol=1e-3)


@pytest.mark.parametrize(
    ("field", "places", "by"),
    [
        ("gen_ms", slice(120, 121), 10_000.0),
        ("gen_ms", slice(100, 103), -900.0),
        ("gen_ms", slice(197, 200), 4_000.0),
        ("seconds", slice(40, 41), 400_000),
        ("seconds", slice(0, 2), -30),
    ],
)
def test_a_wrong_time_in_a_few_packets_drops_none_and_moves_none(field, places, by):
    headers, true = packets()
    values = getattr(headers, field).copy()
    values[places] += by
    times = reconstruct(dataclasses.replace(headers, **{field: values}))
    assert times.rejected == {}
    assert (times.chunks, times.missing) == (1, 0)
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def test_a_packet_whose_ticks_both_clocks_contradict_is_left_out():
    headers, true = packets()
    tick = headers.tick.copy()
    tick[90] = (tick[90] + 31_234) % 65_536
    times = reconstruct(dataclasses.replace(headers, tick=tick))
    assert times.rejected == {Rejected.UNPLACEABLE: 1}
    assert times.missing == 1
    np.testing.assert_allclose(np.delete(times.last_ms, 90), np.delete(true, 90), atol=1e-3)


def test_a_change_of_rate_starts_a_chunk():
    headers, _ = packets()
    rate = headers.rate_hz.copy()
    rate[100:] = 1000.0
    samples = headers.samples.copy()
    samples[100:] = 100
    times = reconstruct(dataclasses.replace(headers, rate_hz=rate, samples=samples))
    assert times.chunks == 2


def in_order(headers, order):
    return headers.take(np.asarray(order))


def test_packets_that_arrived_out_of_order_are_placed_where_they_were_measured():
    headers, true = packets(count=400, lost=(300,))
    order = np.arange(399)
    order[[100, 101]], order[[200, 201, 202]], order[[65, 66]] = [101, 100], [202, 201, 200], [66, 65]
    times = reconstruct(in_order(headers, order))
    assert (times.chunks, times.missing, times.reordered) == (2, 1, 4)
    np.testing.assert_allclose(times.last_ms, true[order], atol=1e-3)


def test_a_packet_that_comes_again_later_counts_once():
    headers, _ = packets()
    order = np.insert(np.arange(200), 104, 100)
    times = reconstruct(in_order(headers, order))
    assert times.rejected == {Rejected.DUPLICATE: 1}
    assert np.flatnonzero(np.isnan(times.last_ms)).tolist() == [104]
    assert (times.chunks, times.missing) == (1, 0)


def test_a_counter_that_starts_anew_is_no_loss():
    headers, true = packets()
    sequence = headers.sequence.copy()
    sequence[90:] = np.arange(110)
    times = reconstruct(dataclasses.replace(headers, sequence=sequence))
    assert (times.chunks, times.missing) == (1, 0)
    np.testing.assert_allclose(times.last_ms, true, atol=1e-3)


def test_drift_is_told_in_parts_and_only_over_a_stream_long_enough():
    headers, true = packets(count=3000, noise_ms=20.0)
    slow = with_gen(headers, headers.gen_ms + 1e-4 * (true - true[0]))
    assert fit_clock(device_ms(slow), slow.made_ms).drift == pytest.approx(-1e-4, abs=2e-5)
    short = in_order(slow, np.arange(200))
    assert fit_clock(device_ms(short), short.made_ms).drift is None
    assert fit_clock(device_ms(slow), np.full(3000, np.nan)).drift is None


def test_no_packets_give_no_times():
    headers, _ = packets(count=0)
    assert reconstruct(headers).chunks == 0


@given(lost=st.sets(st.integers(1, 148), max_size=40), first_s=st.floats(0, 6.5))
def test_whatever_is_lost_the_rest_stays_where_it_was(lost, first_s):
    runs = sorted(lost)
    headers, true = packets(count=150, lost=runs, first_s=round(first_s, 3))
    times = reconstruct(headers)
    np.testing.assert_allclose(times.last_ms, true, atol=1.01)
    assert times.missing == len(lost)
    assert times.chunks == 1 + sum(1 for i in runs if i - 1 not in lost)
