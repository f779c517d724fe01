"""Stimulation energy against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ml.energy import mean_power_uw, mean_square_ma, relative_energy, saving_percent


@pytest.mark.parametrize(("fraction", "energy"), [([1.0] * 7, 1.0), ([0.0] * 7, 0.0), ([0.5] * 4, 0.25), ([1.0, 0.0], 0.5), ([1.2], 1.44)])
def test_relative_energy_is_the_mean_square_of_the_fraction(fraction: list[float], energy: float) -> None:
    assert relative_energy(fraction) == pytest.approx(energy)


def test_a_linear_ramp_from_off_to_cdbs_uses_a_third_of_the_energy() -> None:
    midpoints = (np.arange(10_000) + 0.5) / 10_000  # the integral of a^2 over [0, 1] is 1/3
    assert relative_energy(midpoints) == pytest.approx(1 / 3, abs=1e-8)


def test_unknown_steps_are_left_out_and_no_known_step_gives_nan() -> None:
    assert relative_energy([1.0, math.nan, 0.0]) == pytest.approx(0.5)
    assert math.isnan(relative_energy([math.nan, math.nan]))
    assert math.isnan(relative_energy([]))


def test_milliamperes_and_fractions_save_the_same_share() -> None:
    fraction = np.array([0.2, 0.7, 1.0, 0.4])
    in_ma = saving_percent(mean_square_ma(3.2 * fraction), mean_square_ma(np.full(4, 3.2)))
    assert in_ma == pytest.approx(saving_percent(relative_energy(fraction), 1.0))


def test_power_of_a_usual_setting_agrees_with_the_hand_calculation() -> None:
    # (3 mA)^2 x 1000 ohm = 9 mW while a pulse is on; 60 us x 130 Hz is on 0.78 % of the time: 70.2 uW
    assert mean_power_uw([3.0, 3.0], 60.0, 130.0, 1000.0) == pytest.approx(70.2)


def test_power_follows_pulses_that_change_within_the_session() -> None:
    assert mean_power_uw([2.0, 2.0], [60.0, 90.0], [130.0, 130.0], 500.0) == pytest.approx((15.6 + 23.4) / 2)
    assert mean_power_uw([2.0, math.nan], [60.0, 90.0], 130.0, 500.0) == pytest.approx(15.6)
    assert math.isnan(mean_power_uw([math.nan], 60.0, 130.0, 500.0))


@pytest.mark.parametrize(("energy", "saving"), [(1.0, 0.0), (0.45, 55.0), (0.0, 100.0), (1.5, -50.0)])
def test_saving_is_per_cent_of_the_reference(energy: float, saving: float) -> None:
    assert saving_percent(energy, 1.0) == pytest.approx(saving)


def test_impossible_values_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="amplitude fraction"):
        relative_energy([-0.1])
    with pytest.raises(ValueError, match="amplitude in mA"):
        mean_square_ma([math.inf])
    with pytest.raises(ValueError, match="impedance"):
        mean_power_uw([1.0], 60.0, 130.0, 0.0)
    with pytest.raises(ValueError, match="pulse width"):
        mean_power_uw([1.0], -60.0, 130.0, 100.0)
    with pytest.raises(ValueError, match="reference"):
        saving_percent(0.5, 0.0)
