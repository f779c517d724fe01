"""P_beta in time against P_beta as computed afterwards."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ml.deploy.streaming import CONTEXT_S, StreamingBeta, split_by_period
from ml.signals import band_rows

RATE, PERIOD = 250.0, 2.0


def streamed(stretches, periods, min_valid=0.7):
    beta = StreamingBeta(PERIOD, 13.0, 35.0, min_valid)
    values = []
    for k, pieces in enumerate(split_by_period(stretches, PERIOD, periods)):
        for piece in pieces:
            beta.add(*piece)
        values.append(beta.value((k + 1) * PERIOD))
    return np.array(values)


def bursts(seconds, seed=0):
    """Draw a 20 Hz rhythm that waxes and wanes, in noise with a drift."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * RATE)) / RATE
    size = 1.0 + 0.8 * np.sin(2 * np.pi * t / 17) + 0.3 * np.repeat(rng.normal(size=seconds), int(RATE))
    return size * np.sin(2 * np.pi * 20 * t) + 1.5 * rng.normal(size=t.size) + 0.05 * np.cumsum(rng.normal(size=t.size))


def test_a_steady_rhythm_has_its_root_mean_square_in_every_period():
    t = np.arange(int(60 * RATE)) / RATE
    values = streamed([(0.0, RATE, 3.0 * np.sin(2 * np.pi * 20 * t))], 30)
    np.testing.assert_allclose(values[1:], 3.0 / math.sqrt(2), rtol=0.02)


def test_bursts_are_followed_closely_and_the_difference_is_that_of_the_right_edge():
    x = bursts(600)
    later = band_rows([(0.0, RATE, x)], 300, PERIOD, 13.0, 35.0).rms
    now = streamed([(0.0, RATE, x)], 300)
    assert np.corrcoef(now, later)[0, 1] > 0.999
    assert np.mean(np.abs(now / later - 1)) < 0.01
    shortened = [band_rows([(0.0, RATE, x[: int((k + 1) * PERIOD * RATE) + 1])], k + 1, PERIOD, 13.0, 35.0).rms[k] for k in range(5, 40)]
    np.testing.assert_allclose(now[5:40], shortened, rtol=0.005)  # the batch definition on what had come: only the context is left


def test_no_value_depends_on_samples_that_are_yet_to_come():
    x = bursts(40)
    changed = x.copy()
    changed[int(20 * RATE) + 1 :] = 1e3
    np.testing.assert_array_equal(streamed([(0.0, RATE, x)], 20)[:10], streamed([(0.0, RATE, changed)], 20)[:10])


def test_the_past_is_forgotten_after_the_context():
    x = bursts(40)
    changed = x.copy()
    changed[: int(10 * RATE)] += 50.0
    first = int((10 + CONTEXT_S) / PERIOD) + 1
    np.testing.assert_allclose(streamed([(0.0, RATE, x)], 20)[first:], streamed([(0.0, RATE, changed)], 20)[first:], rtol=1e-9)


def test_a_period_lost_for_the_most_part_has_no_value():
    x = bursts(40)
    kept = [(0.0, RATE, x[: int(9 * RATE)]), (11.0, RATE, x[int(11 * RATE) :])]
    values = streamed(kept, 20)
    later = band_rows(kept, 20, PERIOD, 13.0, 35.0)
    assert np.isnan(values).tolist() == (later.covered < 0.7 - 1e-9).tolist()
    assert np.isnan(values[4:6]).all()
    assert np.isfinite(values[6:]).all()


def test_short_gaps_are_bridged_in_time_as_they_are_afterwards():
    x = bursts(200)
    there = np.arange(x.size) % 50 < 38  # 152 ms of every 200 ms: none of it could be filtered alone
    edges = np.flatnonzero(np.diff(np.concatenate(([0], there.astype(np.int8), [0]))))
    kept = [(a / RATE, RATE, x[a:b]) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    values, later = streamed(kept, 100), band_rows(kept, 100, PERIOD, 13.0, 35.0)
    assert np.isfinite(values).all()
    assert np.corrcoef(values, later.rms)[0, 1] > 0.99
    np.testing.assert_allclose(values.mean(), later.rms.mean(), rtol=0.01)


def test_samples_that_come_in_small_packets_give_the_same():
    x = bursts(20)
    packets = [(i / RATE, RATE, x[i : i + 25]) for i in range(0, x.size, 25)]
    np.testing.assert_allclose(streamed(packets, 10), streamed([(0.0, RATE, x)], 10), rtol=1e-9)


def test_nothing_has_no_value_and_settings_are_checked():
    assert math.isnan(StreamingBeta(PERIOD, 13.0, 35.0, 0.7).value(2.0))
    assert all(pieces == [] for pieces in split_by_period([], PERIOD, 3))
    with pytest.raises(ValueError, match="no P_beta"):
        StreamingBeta(PERIOD, 35.0, 13.0, 0.7)
