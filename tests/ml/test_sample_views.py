"""Samples at the resolution of a screen, against signals whose extremes and spectrum are known."""

from __future__ import annotations

import numpy as np
import pytest

from ml.sample_views import FACTOR, FIRST, Level, fewer_columns, level_for, pyramid, spectrogram
from ml.signals import spectrum

RATE = 250.0


def test_every_level_keeps_the_one_spike_at_its_place_and_gaps_stay_gaps() -> None:
    t = np.arange(100_000) / RATE
    x = np.sin(t).astype(np.float32)
    x[54_321] = 40.0
    there = (t < 100) | (t > 160)
    levels = pyramid(t[there], x[there], RATE)
    assert levels[0].low.size == -(-100_000 // FIRST)
    assert levels[-1].low.size == 1
    for level in levels:
        peak = int(np.nanargmax(level.high))
        assert level.high[peak] == 40.0
        assert level.first_s + peak * level.width_s <= t[54_321] < level.first_s + (peak + 1) * level.width_s
        inside_gap = level.first_s + level.width_s * np.arange(level.low.size)
        empty = (inside_gap > 100.01) & (inside_gap + level.width_s < 160)
        assert np.isnan(level.low[empty]).all()
        assert np.array_equal(np.isnan(level.low), np.isnan(level.high))


def test_a_level_has_the_extremes_of_its_samples_whatever_their_order_and_rates() -> None:
    rng = np.random.default_rng(3)
    t = np.r_[np.arange(1000) / 250, 5 + np.arange(1000) / 500]
    x = rng.standard_normal(t.size).astype(np.float32)
    shuffled = rng.permutation(t.size)
    for level in pyramid(t[shuffled], x[shuffled], 500.0):
        bins = np.floor((t - level.first_s) / level.width_s + 1e-6).astype(int)
        for i in np.unique(bins):
            assert (level.low[i], level.high[i]) == (x[bins == i].min(), x[bins == i].max())


def test_no_sample_has_no_level() -> None:
    assert pyramid(np.empty(0), np.empty(0, np.float32), RATE) == []


def test_a_window_takes_the_coarsest_level_that_fills_it_and_a_short_one_the_samples() -> None:
    nothing = np.zeros(1, np.float32)
    levels = [Level(0.0, 0.032 * FACTOR**k, nothing, nothing) for k in range(6)]
    assert level_for(levels, 0.0, 600.0, 1000) == 2  # 0.512 s x 1000 = 512 s
    assert level_for(levels, 0.0, 32.0, 1000) == 0
    assert level_for(levels, 0.0, 31.0, 1000) is None
    assert level_for([], 0.0, 1.0, 10) is None


@pytest.mark.parametrize("rate", [250.0, 422.3])
def test_a_tone_that_begins_half_way_stands_at_its_frequency_and_time_with_its_power(rate: float) -> None:
    t = np.arange(int(60 * rate)) / rate
    x = np.where(t >= 30, 3 * np.sin(2 * np.pi * 20 * t), 0.0) + 0.01 * np.random.default_rng(0).standard_normal(t.size)
    found = spectrogram([(0.0, rate, x)], 0.0, 60.0)
    assert found.density.shape == (60, 101)
    assert found.hz[np.argmax(found.density[45])] == 20.0
    assert found.density[45].sum() == pytest.approx(4.5, rel=0.02)  # half of the squared amplitude, 1 Hz apart
    assert found.density[10].sum() < 0.01


def test_the_mean_of_the_columns_is_the_spectrum_of_the_recording() -> None:
    x = np.random.default_rng(1).standard_normal(int(40 * RATE))
    hz, density, _ = spectrum([(0.0, RATE, x)])
    found = spectrogram([(0.0, RATE, x)], 0.0, 40.0, width_s=40.0)
    np.testing.assert_allclose(found.density[0], density, rtol=1e-4)
    np.testing.assert_array_equal(found.hz, hz)


def test_no_segment_reaches_over_a_gap_and_columns_without_one_are_empty() -> None:
    rng = np.random.default_rng(2)
    pieces = [(0.0, RATE, rng.standard_normal(int(10.4 * RATE))), (20.0, RATE, rng.standard_normal(int(10 * RATE)))]
    found = spectrogram(pieces, 0.0, 30.0)
    empty = np.isnan(found.density).all(axis=1)
    assert empty.tolist() == [False] * 10 + [True] * 10 + [False] * 10
    few = fewer_columns(found, 0.0, 30.0, 6)
    assert few.width_s == 5.0
    assert np.isnan(few.density).all(axis=1).tolist() == [False, False, True, True, False, False]
    np.testing.assert_allclose(few.density[0], found.density[:5].mean(axis=0), rtol=1e-5)
    part = fewer_columns(found, 22.5, 25.0, 100)
    assert (part.first_s, part.density.shape[0]) == (22.0, 3)


def test_a_rate_that_does_not_reach_the_highest_frequency_leaves_it_out() -> None:
    found = spectrogram([(0.0, 50.0, np.random.default_rng(4).standard_normal(500))], 0.0, 10.0)
    assert found.hz[-1] == 25.0
