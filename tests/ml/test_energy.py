"""Stimulation energy against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ml.energy import (
    BatteryAssumptions,
    Range,
    battery_life,
    mean_power_uw,
    mean_square_ma,
    pulse,
    relative_energy,
    saving_percent,
    supply_power_uw,
)


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


def test_charge_and_energy_of_a_pulse_agree_with_the_hand_calculation() -> None:
    # 3 mA for 60 us is 0.18 uC; through 1000 ohm it is 9 mW for 60 us: 0.54 uJ
    assert pulse(3.0, 60.0).charge_uc == pytest.approx(0.18)
    assert pulse(3.0, 60.0).energy_uj is None
    assert pulse(3.0, 60.0, 1000.0).energy_uj == pytest.approx(0.54)
    assert 130.0 * (pulse(3.0, 60.0, 1000.0).energy_uj or 0) == pytest.approx(mean_power_uw(3.0, 60.0, 130.0, 1000.0))


def test_a_fixed_supply_voltage_draws_in_proportion_to_the_current() -> None:
    # 3 mA from 4 V, on 0.78 % of the time: 93.6 uW
    assert supply_power_uw([3.0], 60.0, 130.0, 4.0) == pytest.approx(93.6)
    half = supply_power_uw([1.5, 1.5, math.nan], 60.0, 130.0, 4.0)
    assert saving_percent(half, 93.6) == pytest.approx(50.0)
    assert saving_percent(mean_power_uw([1.5], 60.0, 130.0, 1000.0), 70.2) == pytest.approx(75.0), "of the tissue's energy more is saved"
    assert math.isnan(supply_power_uw([math.nan], 60.0, 130.0, 4.0))


ASSUMED = BatteryAssumptions(capacity_mah=Range(200, 200), voltage_v=Range(3, 3), other_drain_uw=Range(30, 30), source="an example")


def test_battery_life_is_energy_over_power() -> None:
    # 200 mAh at 3 V are 600 mWh; at 100 uW that is 6000 h, 250 days
    life = battery_life(Range(70.0, 70.0), ASSUMED)
    assert (life.days.low, life.days.high) == (pytest.approx(250.0), pytest.approx(250.0))


def test_ranges_widen_the_answer_and_are_told_with_it() -> None:
    wide = BatteryAssumptions(capacity_mah=Range(100, 200), voltage_v=Range(3, 3), other_drain_uw=Range(30, 130), source="an example")
    life = battery_life(Range(70.0, 70.0), wide)
    assert (life.days.low, life.days.high) == (pytest.approx(62.5), pytest.approx(250.0))
    for part in ("62.5 to 250 days", "100 to 200 mAh", "30 to 130 uW", "an example"):
        assert part in str(life)


def test_saving_stimulation_gains_less_the_more_the_rest_draws() -> None:
    gain = []
    for other in (1.0, 30.0, 300.0):
        assumed = BatteryAssumptions(capacity_mah=Range(200, 200), voltage_v=Range(3, 3), other_drain_uw=Range(other, other), source="x")
        days = [battery_life(Range(uw, uw), assumed).days.low for uw in (35.0, 70.0)]
        gain.append(days[0] / days[1])
    assert gain == [pytest.approx(71 / 36), pytest.approx(100 / 65), pytest.approx(370 / 335)]


def test_no_battery_life_without_its_assumptions() -> None:
    with pytest.raises(TypeError):
        battery_life(Range(1, 1))  # type: ignore[call-arg]
    with pytest.raises(TypeError):
        BatteryAssumptions(capacity_mah=Range(1, 2), voltage_v=Range(3, 4))  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="where the assumptions"):
        BatteryAssumptions(capacity_mah=Range(1, 2), voltage_v=Range(3, 4), other_drain_uw=Range(0, 1), source=" ")
    with pytest.raises(ValueError, match="above 0"):
        BatteryAssumptions(capacity_mah=Range(0, 2), voltage_v=Range(3, 4), other_drain_uw=Range(0, 1), source="x")
    with pytest.raises(ValueError, match="rises"):
        Range(2, 1)
    nothing = BatteryAssumptions(capacity_mah=Range(1, 2), voltage_v=Range(3, 4), other_drain_uw=Range(0, 1), source="x")
    with pytest.raises(ValueError, match="no life to state"):
        battery_life(Range(0, 0), nothing)
    with pytest.raises(ValueError, match="supply voltage"):
        supply_power_uw([1.0], 60.0, 130.0, 0.0)
    with pytest.raises(ValueError, match="pulse width"):
        pulse(1.0, -1.0)
