from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.signals import BRIDGE_S, SEGMENTS_AT_ONCE, band_pass, band_rows, interval_means, row_means, row_of, spectrum, step_means

RATE = 500.0
LOW, HIGH = 13.0, 35.0


def sine(hz: float, seconds: float, amplitude: float = 1.0) -> np.ndarray:
    return amplitude * np.sin(2 * np.pi * hz * np.arange(int(seconds * RATE)) / RATE)


def test_a_sine_inside_the_band_has_an_rms_of_its_amplitude_over_root_two():
    rows = band_rows([(1 / RATE, RATE, sine(22.0, 20.0, 3.0))], 10, 2.0, LOW, HIGH)
    np.testing.assert_allclose(rows.rms, 3.0 / np.sqrt(2), rtol=0.01)
    np.testing.assert_allclose(rows.power, 4.5, rtol=0.02)
    np.testing.assert_allclose(rows.covered, 1.0)


@pytest.mark.parametrize("hz", [1.0, 5.0, 70.0, 130.0])
def test_a_sine_outside_the_band_leaves_less_than_two_per_cent(hz):
    rows = band_rows([(1 / RATE, RATE, sine(hz, 20.0))], 10, 2.0, LOW, HIGH)
    assert np.all(rows.rms[1:-1] < 0.02)


def test_white_noise_gives_its_density_times_the_bandwidth():
    noise = np.random.default_rng(4).normal(0.0, 2.0, int(400 * RATE))
    rows = band_rows([(1 / RATE, RATE, noise)], 200, 2.0, LOW, HIGH)
    density = 4.0 / (RATE / 2)
    assert rows.power.mean() == pytest.approx(density * (HIGH - LOW), rel=0.03)


@pytest.mark.parametrize("hz", [LOW, HIGH])
def test_a_sine_at_an_edge_of_the_band_keeps_half_its_power(hz):
    rows = band_rows([(1 / RATE, RATE, sine(hz, 20.0))], 10, 2.0, LOW, HIGH)
    np.testing.assert_allclose(rows.power[1:-1], 0.25, rtol=0.02)


def test_the_filter_shifts_nothing_in_time():
    x = sine(22.0, 4.0)
    y = band_pass(x, RATE, LOW, HIGH)
    lags = np.arange(-10, 11)
    assert lags[np.argmax([np.dot(x[500:1500], np.roll(y, lag)[500:1500]) for lag in lags])] == 0


def test_gaps_take_coverage_but_not_amplitude():
    x = sine(22.0, 4.0, 2.0)
    kept = [(1 / RATE, RATE, x[:700]), (1 / RATE + 1200 / RATE, RATE, x[1200:])]
    rows = band_rows(kept, 2, 2.0, LOW, HIGH)
    np.testing.assert_allclose(rows.covered, [0.7, 0.8], atol=1e-9)
    np.testing.assert_allclose(rows.rms, np.sqrt(2.0), rtol=0.03)


def test_a_stretch_too_short_for_the_band_is_not_counted():
    rows = band_rows([(1 / RATE, RATE, sine(22.0, 0.2))], 1, 2.0, LOW, HIGH)
    assert rows.covered[0] == 0
    assert np.isnan(rows.rms[0])


def lossy(x, lost, start_s=1 / RATE, packet=25):
    """Return the packets of x that are left without those numbered in `lost`, as stretches; and which samples they hold."""
    there = np.repeat(~np.isin(np.arange(x.size // packet), lost), packet)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], there.astype(np.int8), [0]))))
    return [(start_s + a / RATE, RATE, x[a:b]) for a, b in zip(edges[::2], edges[1::2], strict=True)], there


def random_losses(seconds, share, seed=0):
    return np.flatnonzero(np.random.default_rng(seed).random(int(seconds * RATE / 25)) < share)


def test_packets_too_short_to_be_filtered_alone_count_when_only_short_gaps_part_them():
    pieces, there = lossy(sine(22.0, 20.0, 3.0), np.arange(3, 400, 4))  # 150 ms of every 200 ms
    rows = band_rows(pieces, 10, 2.0, LOW, HIGH)
    np.testing.assert_allclose(rows.covered, there.reshape(10, -1).mean(axis=1))
    np.testing.assert_allclose(rows.rms, 3.0 / np.sqrt(2), rtol=0.06)


def test_gaps_leave_the_mean_power_of_noise_unbiased():
    noise = np.random.default_rng(8).normal(size=int(800 * RATE))
    pieces, there = lossy(noise, random_losses(800.0, 0.3))
    rows = band_rows(pieces, 400, 2.0, LOW, HIGH)
    whole = band_rows([(1 / RATE, RATE, noise)], 400, 2.0, LOW, HIGH)
    assert there.mean() == pytest.approx(0.7, abs=0.02)
    assert rows.power.mean() == pytest.approx(whole.power.mean(), rel=0.025)


def test_interpolated_samples_are_never_scored():
    x = sine(22.0, 4.0)
    rows = band_rows([(1 / RATE, RATE, x[:750]), (1 / RATE + 2.4, RATE, x[1200:])], 8, 0.5, LOW, HIGH)
    np.testing.assert_allclose(rows.covered, [1, 1, 1, 0, 0.2, 1, 1, 1], atol=1e-9)
    assert np.isnan(rows.rms[3])
    assert np.isnan(rows.rms_error[3])


def test_the_filter_begins_anew_after_a_long_gap():
    x = np.random.default_rng(9).normal(size=4000)
    first, second = (1 / RATE, RATE, x[:2000]), (4.0 + BRIDGE_S + 2 / RATE, RATE, x[2000:])
    both = band_rows([second, first], 5, 2.0, LOW, HIGH)
    np.testing.assert_array_equal(both.rms[:2], band_rows([first], 5, 2.0, LOW, HIGH).rms[:2])
    np.testing.assert_array_equal(both.rms[3:], band_rows([second], 5, 2.0, LOW, HIGH).rms[3:])


def test_stretches_between_the_ticks_of_the_grid_keep_all_their_samples():
    x = sine(22.0, 4.0)
    early = band_rows([(1 / RATE, RATE, x[:1000]), (1 / RATE + 2.0 - 0.4 / RATE, RATE, x[1000:])], 2, 2.0, LOW, HIGH)
    np.testing.assert_allclose(early.covered, 1.0, atol=1e-3)
    np.testing.assert_allclose(early.rms, np.sqrt(0.5), rtol=0.02)


def test_a_whole_row_has_no_error_and_a_partial_one_has_that_of_what_is_missing():
    noise = np.random.default_rng(10).normal(size=int(800 * RATE))
    whole = band_rows([(1 / RATE, RATE, noise)], 400, 2.0, LOW, HIGH)
    assert np.all(whole.rms_error == 0)
    pieces, there = lossy(noise, random_losses(800.0, 0.3, seed=1))
    rows = band_rows(pieces, 400, 2.0, LOW, HIGH)
    partly = ~there.reshape(400, -1).all(axis=1)
    assert 0.9 < np.std((rows.rms - whole.rms)[partly] / rows.rms_error[partly]) < 1.25
    np.testing.assert_allclose(rows.power_error, 2 * rows.rms * rows.rms_error)


def test_less_coverage_is_a_larger_error():
    x = np.random.default_rng(11).normal(size=1000)
    errors = [band_rows([(1 / RATE, RATE, x[:n])], 1, 2.0, LOW, HIGH).rms_error[0] for n in (1000, 900, 700, 400)]
    assert errors[0] == 0
    assert np.all(np.diff(errors) > 0)


def test_stretches_of_different_rates_may_share_a_row():
    fast = np.sin(2 * np.pi * 22 * np.arange(1000) / 1000.0)
    rows = band_rows([(1 / RATE, RATE, sine(22.0, 1.0)), (1.001, 1000.0, fast)], 1, 2.0, LOW, HIGH)
    assert rows.covered[0] == pytest.approx(1.0)
    assert rows.rms[0] == pytest.approx(1 / np.sqrt(2), rel=0.03)


def test_a_band_beyond_half_the_rate_is_refused():
    with pytest.raises(ValueError, match="does not fit"):
        band_pass(np.zeros(100), 60.0, LOW, HIGH)


def test_rows_are_closed_on_the_right_and_zero_belongs_to_the_first():
    np.testing.assert_array_equal(row_of(np.array([-0.5, 0.0, 0.1, 2.0, 2.001, 4.0]), 2.0), [-1, 0, 0, 0, 1, 1])


def test_row_means_of_packets_count_only_what_is_there():
    t = np.array([0.5, 1.0, 1.5, 2.0, 2.5])
    means, covered = row_means(t, np.array([1.0, 3.0, np.nan, 5.0, 7.0]), np.full(5, 0.5), 3, 2.0)
    np.testing.assert_allclose(means, [3.0, 7.0, np.nan])
    np.testing.assert_allclose(covered, [0.75, 0.25, 0.0])


def test_a_step_inside_a_row_is_weighted_by_time():
    means, known = step_means(np.array([-5.0, 0.5, 3.0]), np.array([1.0, 3.0, np.nan]), 4.0, 2, 2.0)
    np.testing.assert_allclose(means, [(0.5 * 1 + 1.5 * 3) / 2, 3.0])
    np.testing.assert_allclose(known, [1.0, 0.5])


def test_no_steps_means_nothing_is_known():
    means, known = step_means(np.array([]), np.array([]), 4.0, 2, 2.0)
    assert np.isnan(means).all()
    assert not known.any()


@given(
    steps=st.lists(st.tuples(st.floats(-3, 9), st.one_of(st.just(float("nan")), st.floats(0, 5))), min_size=1, max_size=6),
    end=st.floats(9, 12),
)
def test_step_means_agree_with_a_fine_sum(steps, end):
    steps = sorted(steps, key=lambda s: s[0])
    t = np.array([s[0] for s in steps])
    v = np.array([s[1] for s in steps])
    means, known = step_means(t, v, end, 5, 2.0)
    fine = np.arange(10_000) * 1e-3 + 5e-4
    held = np.searchsorted(t, fine, side="right") - 1
    at = np.where((held >= 0) & (fine < end), v[np.maximum(held, 0)], np.nan).reshape(5, 2000)
    share = np.isfinite(at).mean(axis=1)
    np.testing.assert_allclose(known, share, atol=5e-3)
    some = share > 0.2
    np.testing.assert_allclose(means[some], np.nanmean(at[some], axis=1) if some.any() else [], atol=0.1)


def test_the_spectrum_of_white_noise_is_flat_and_adds_up_to_its_variance():
    noise = np.random.default_rng(5).normal(0.0, 3.0, int(200 * RATE))
    hz, density, seconds = spectrum([(0.0, RATE, noise)], max_hz=RATE / 2)
    assert seconds == pytest.approx(200.0)
    np.testing.assert_allclose(density[2:-2], 9.0 / (RATE / 2), rtol=0.35)
    assert density.sum() * (hz[1] - hz[0]) == pytest.approx(9.0, rel=0.03)


def test_a_sine_stands_at_its_frequency_with_half_its_squared_amplitude():
    hz, density, _ = spectrum([(0.0, RATE, sine(22.0, 20.0, 3.0))])
    assert hz[np.argmax(density)] == 22.0
    assert density[20:25].sum() == pytest.approx(4.5, rel=0.01)
    assert hz[-1] == 100.0


def test_gaps_add_nothing_to_the_spectrum():
    x = sine(22.0, 30.0, 2.0)
    whole = spectrum([(0.0, RATE, x)])
    lossy = spectrum([(0.0, RATE, x[:4000]), (9.0, RATE, x[4500:4900]), (11.0, RATE, x[5500:])])
    assert lossy[2] == pytest.approx(8.0 + 19.0)
    np.testing.assert_allclose(lossy[1], whole[1], rtol=0.02, atol=1e-4)


def test_a_spectrum_needs_one_stretch_as_long_as_a_segment():
    hz, density, seconds = spectrum([(0.0, RATE, np.ones(100)), (1.0, RATE, np.ones(0))])
    assert hz.size == density.size == 0
    assert seconds == 0.0


def test_a_long_stretch_is_cut_into_blocks_without_losing_a_segment():
    noise = np.random.default_rng(6).normal(size=(SEGMENTS_AT_ONCE + 40) * 32 + 32)
    hz, density, seconds = spectrum([(0.0, 64.0, noise)])
    windows = np.lib.stride_tricks.sliding_window_view(noise, 64)[::32]
    taper = np.hanning(65)[:-1]
    slow = np.abs(np.fft.rfft((windows - windows.mean(axis=1, keepdims=True)) * taper)) ** 2 / (64.0 * np.sum(taper**2))
    slow[:, 1:-1] *= 2
    np.testing.assert_allclose(density, slow.mean(axis=0), rtol=1e-9, atol=1e-15)
    assert len(windows) > SEGMENTS_AT_ONCE
    assert hz[-1] == 32.0
    assert seconds == pytest.approx(noise.size / 64.0)


def test_above_half_of_the_lower_rate_the_spectrum_rests_on_the_faster_stretches():
    rng = np.random.default_rng(7)
    slow, fast = rng.normal(size=50 * 100), rng.normal(size=250 * 100)
    hz, density, seconds = spectrum([(0.0, 50.0, slow), (100.0, 250.0, fast)])
    assert seconds == pytest.approx(200.0)
    alone = spectrum([(0.0, 250.0, fast)])[1]
    np.testing.assert_allclose(density[hz > 25], alone[hz > 25])
    assert density[5:20].mean() == pytest.approx((1 / 25 + 1 / 125) / 2, rel=0.15)


@pytest.mark.parametrize("rate_hz", [249.9, 65.104])
def test_a_rate_that_is_no_whole_number_keeps_the_grid(rate_hz):
    t = np.arange(int(40 * rate_hz)) / rate_hz
    hz, density, _ = spectrum([(0.0, rate_hz, np.sin(2 * np.pi * 20.0 * t))])
    assert hz[np.argmax(density)] == 20.0
    assert density[17:24].sum() == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize("rate", [250.0, 500.0, 1000.0])
def test_a_row_that_lacks_one_sample_of_a_limit_reaches_it_and_one_that_lacks_two_does_not(rate):
    x = np.sin(2 * np.pi * 20 * np.arange(round(8 * rate)) / rate)
    for lacking in (0, 1, 2):
        held = round(0.7 * 2 * rate) - lacking
        begin = round(2 * rate)
        pieces = [(1 / rate, rate, x[: begin + held]), ((2 * begin + 1) / rate, rate, x[2 * begin :])]
        rows = band_rows(pieces, 4, 2.0, 13.0, 35.0)
        assert rows.covered[1] == pytest.approx(held / (2 * rate))
        assert (rows.reached[1] >= 0.7 - 1e-9) == (lacking < 2)
        assert rows.reached[0] == 1.0


@given(
    ends=st.lists(st.integers(1, 400), min_size=1, max_size=60, unique=True).map(sorted),
    data=st.data(),
)
def test_interval_means_are_those_of_each_moment(ends, data):
    end_s = np.array(ends) / 20.0
    values = np.array(data.draw(st.lists(st.sampled_from([0.0, 1.0, 5.0, np.nan]), min_size=len(ends), max_size=len(ends))))
    means, covered = interval_means(end_s, values, 0.5, 11, 2.0)
    fine = np.full(440, np.nan)  # twentieths of a second, one by one
    for k in range(440):
        after = np.flatnonzero(end_s >= (k + 1) / 20 - 1e-9)
        if after.size and end_s[after[0]] - 0.5 <= k / 20 + 1e-9:
            fine[k] = values[after[0]]
    by_row = fine.reshape(11, 40)
    np.testing.assert_allclose(covered, np.isfinite(by_row).mean(axis=1), atol=1e-9)
    has = np.isfinite(by_row).any(axis=1)
    np.testing.assert_allclose(means[has], [np.nanmean(row) for row in by_row[has]])
    assert np.isnan(means[~has]).all()
