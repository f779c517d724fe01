from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ml.formats.rcs.outliers import power_spikes

INTERVAL_S, WINDOW_S = 0.1, 2.0


def band_power(count=3000, seed=0):
    """Draw the power of some bins in overlapping windows: smoothed chi-square, as the device streams it without stimulation."""
    drawn = np.random.default_rng(seed).chisquare(8, count + 19)
    return 25.0 * np.convolve(drawn, np.full(20, 1 / 20), mode="valid")


def test_power_without_stimulation_has_no_spike():
    assert not any(power_spikes(band_power(seed=seed), INTERVAL_S, WINDOW_S).any() for seed in range(10))
    single_bin = np.random.default_rng(1).exponential(200.0, 20_000)
    assert not power_spikes(single_bin, INTERVAL_S, WINDOW_S).any()


@given(begin=st.integers(0, 2900), length=st.integers(1, 30), factor=st.floats(50, 1e5))
def test_a_transient_as_long_as_the_fft_window_is_a_spike_wherever_it_stands(begin, length, factor):
    power = band_power()
    power[begin : begin + length] *= factor
    hit = power_spikes(power, INTERVAL_S, WINDOW_S)
    assert hit[begin : begin + length].all()
    assert hit.sum() == min(length, power.size - begin)


def test_a_plateau_longer_than_any_transient_is_signal():
    power = band_power()
    power[1000:1100] *= 1e4
    assert not power_spikes(power, INTERVAL_S, WINDOW_S).any()


def test_the_shoulders_of_a_spike_go_with_it():
    power = np.full(1000, 200.0) * np.exp(0.1 * np.random.default_rng(0).normal(size=1000))
    power[500:507] *= [3, 10, 1000, 5000, 1000, 10, 3]
    assert np.flatnonzero(power_spikes(power, INTERVAL_S, WINDOW_S)).tolist() == list(range(500, 507))


def test_packets_without_a_value_are_no_spikes_and_hide_none():
    power = band_power()
    power[100:140] = np.nan
    power[150:160] *= 1000
    hit = power_spikes(power, INTERVAL_S, WINDOW_S)
    assert np.flatnonzero(hit).tolist() == list(range(150, 160))
    assert not power_spikes(np.full(5, np.nan), INTERVAL_S, WINDOW_S).any()
