"""Stimulation energy: relative to cDBS, in microwatts where the pulses are known, and what it may mean for a battery.

Source: Gao et al. 2023, section 6.1 (metric). The paper names the metric without a formula. Energy per pulse grows with the square of the
current. So at a fixed rate and pulse width, the energy of a session relative to cDBS is the mean squared amplitude fraction.

That is the energy which reaches the tissue. The battery gives at least that (an output stage without loss). At most it gives current times
a fixed supply voltage, which grows with the current alone. So the share saved of the battery's charge is smaller than that of the tissue's
energy. Battery life is therefore a range. It depends on numbers about the implant that no recording contains; they must be given and are
returned with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


def relative_energy(fraction: ArrayLike) -> float:
    """Compute the mean squared amplitude fraction of one session: 1 is cDBS, 0 is no stimulation; above 1 where amplitudes exceeded cDBS.

    Args:
        fraction: amplitude fraction of the cDBS amplitude per step, shape [T]; NaN where unknown, which is ignored.

    Returns:
        Energy relative to cDBS; NaN when no step is known.

    Raises:
        ValueError: an amplitude below zero or infinite.
    """
    return _mean_square(fraction, "amplitude fraction")


def mean_square_ma(amplitude_ma: ArrayLike) -> float:
    """Compute the mean squared amplitude of one session, mA^2; arguments and errors as in `relative_energy`, in milliamperes."""
    return _mean_square(amplitude_ma, "amplitude in mA")


def mean_power_uw(amplitude_ma: ArrayLike, pulse_width_us: ArrayLike, rate_hz: ArrayLike, impedance_ohm: float) -> float:
    """Compute the mean electrical power into the tissue: I^2 R times the share of the time that a pulse is on (Koss et al. 2005, for
    currents).

    Args:
        amplitude_ma: pulse amplitude per step, mA, shape [T]; steps that are NaN in any of the three are ignored.
        pulse_width_us: width of the active phase, microseconds, shape [T] or a number.
        rate_hz: pulses per second, shape [T] or a number.
        impedance_ohm: of the therapy contacts, ohm, above zero.

    Returns:
        Mean power over the known steps, microwatts; NaN when no step is known.

    Raises:
        ValueError: a negative or infinite input, or an impedance that is not above zero.
    """
    if not (math.isfinite(impedance_ohm) and impedance_ohm > 0):
        raise ValueError(f"impedance must be above 0 ohm, not {impedance_ohm}")
    current, width, rate = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in (amplitude_ma, pulse_width_us, rate_hz)))
    for name, values in (("amplitude in mA", current), ("pulse width", width), ("rate", rate)):
        _check(values, name)
    power = (current * 1e-3) ** 2 * impedance_ohm * (width * 1e-6) * rate * 1e6
    known = power[~np.isnan(power)]
    return float(known.mean()) if known.size else math.nan


@dataclass(frozen=True)
class Pulse:
    """One stimulation pulse: charge of the active phase in microcoulombs, and its energy in microjoules where the impedance is known."""

    charge_uc: float
    energy_uj: float | None


def pulse(amplitude_ma: float, pulse_width_us: float, impedance_ohm: float | None = None) -> Pulse:
    """Charge I w and energy I^2 R w of a rectangular pulse.

    Raises:
        ValueError: a negative or infinite input, or an impedance that is not above zero.
    """
    for name, value in (("amplitude in mA", amplitude_ma), ("pulse width", pulse_width_us)):
        if not (math.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must be 0 or more and finite, not {value}")
    if impedance_ohm is not None and not (math.isfinite(impedance_ohm) and impedance_ohm > 0):
        raise ValueError(f"impedance must be above 0 ohm, not {impedance_ohm}")
    energy = None if impedance_ohm is None else (amplitude_ma * 1e-3) ** 2 * impedance_ohm * pulse_width_us
    return Pulse(amplitude_ma * pulse_width_us * 1e-3, energy)


def supply_power_uw(amplitude_ma: ArrayLike, pulse_width_us: ArrayLike, rate_hz: ArrayLike, supply_v: float) -> float:
    """Compute the mean power that a current source draws from a fixed supply voltage: I V times the share of time with a pulse.

    Args:
        amplitude_ma, pulse_width_us, rate_hz: as in `mean_power_uw`.
        supply_v: compliance voltage of the output stage, V, above zero.

    Returns:
        Mean power over the known steps, microwatts; NaN when no step is known.

    Raises:
        ValueError: a negative or infinite input, or a voltage that is not above zero.
    """
    if not (math.isfinite(supply_v) and supply_v > 0):
        raise ValueError(f"the supply voltage must be above 0 V, not {supply_v}")
    current, width, rate = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in (amplitude_ma, pulse_width_us, rate_hz)))
    for name, values in (("amplitude in mA", current), ("pulse width", width), ("rate", rate)):
        _check(values, name)
    power = current * 1e-3 * supply_v * (width * 1e-6) * rate * 1e6
    known = power[~np.isnan(power)]
    return float(known.mean()) if known.size else math.nan


@dataclass(frozen=True)
class Range:
    """Lower and upper limit that a number is assumed to have.

    Raises:
        ValueError: limits that are not finite, or fall.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise ValueError(f"a range rises from one finite number to another, not from {self.low} to {self.high}")


@dataclass(frozen=True, kw_only=True)
class BatteryAssumptions:
    """Assumptions about an implant; none has a default, since no recording contains it.

    Attributes:
        capacity_mah: usable charge of the battery, mAh.
        voltage_v: of the battery, V.
        other_drain_uw: everything but stimulation (sensing, telemetry, electronics), microwatts.
        source: where the numbers are from.

    Raises:
        ValueError: a capacity or voltage that is not above zero, a negative drain, or no source.
    """

    capacity_mah: Range
    voltage_v: Range
    other_drain_uw: Range
    source: str

    def __post_init__(self) -> None:
        if self.capacity_mah.low <= 0 or self.voltage_v.low <= 0:
            raise ValueError("capacity and voltage of a battery must be above 0")
        if self.other_drain_uw.low < 0:
            raise ValueError("the other drain must be 0 or more")
        if not self.source.strip():
            raise ValueError("say where the assumptions about the battery are from")


@dataclass(frozen=True)
class BatteryLife:
    """Time that one charge (or a primary cell) may last, days, under assumptions that belong to it. There is no single number."""

    days: Range
    assumptions: BatteryAssumptions

    def __str__(self) -> str:
        a = self.assumptions
        held = f"{a.capacity_mah.low:g} to {a.capacity_mah.high:g} mAh at {a.voltage_v.low:g} to {a.voltage_v.high:g} V"
        drawn = f"{a.other_drain_uw.low:g} to {a.other_drain_uw.high:g} uW"
        return f"{self.days.low:.3g} to {self.days.high:.3g} days, if the battery holds {held} and all else draws {drawn} ({a.source})"


def battery_life(stimulation_uw: Range, assumptions: BatteryAssumptions) -> BatteryLife:
    """Compute the time from full to empty.

    Args:
        stimulation_uw: what stimulation draws from the battery, from `mean_power_uw` (no loss) to `supply_power_uw` (fixed supply).
        assumptions: about the implant.

    Raises:
        ValueError: a negative draw, or one of zero with no other drain.
    """
    if stimulation_uw.low < 0:
        raise ValueError("stimulation cannot draw less than nothing")
    least = stimulation_uw.low + assumptions.other_drain_uw.low
    if least <= 0:
        raise ValueError("a battery from which nothing draws has no life to state")
    most = stimulation_uw.high + assumptions.other_drain_uw.high
    energy_uwh = [1000.0 * c * v for c, v in zip(_ends(assumptions.capacity_mah), _ends(assumptions.voltage_v), strict=True)]
    return BatteryLife(Range(energy_uwh[0] / most / 24.0, energy_uwh[1] / least / 24.0), assumptions)


def _ends(values: Range) -> tuple[float, float]:
    return values.low, values.high


@dataclass(frozen=True)
class Implant:
    """Assumptions about one implant and its stimulation, each a range, with their source."""

    capacity_mah: Range
    voltage_v: Range
    other_drain_uw: Range
    impedance_ohm: Range
    supply_v: Range
    pulse_width_us: Range
    rate_hz: Range
    source: str

    def life(self, amplitude_ma: ArrayLike) -> BatteryLife:
        """Compute the time from full to empty at these amplitudes, mA [T]: between an output stage without loss (I^2 R) and a fixed supply
        (I V).

        Raises:
            ValueError: numbers from which no life follows.
        """
        least = mean_power_uw(amplitude_ma, self.pulse_width_us.low, self.rate_hz.low, self.impedance_ohm.low)
        most = max(
            supply_power_uw(amplitude_ma, self.pulse_width_us.high, self.rate_hz.high, self.supply_v.high),
            mean_power_uw(amplitude_ma, self.pulse_width_us.high, self.rate_hz.high, self.impedance_ohm.high),
        )
        stated = BatteryAssumptions(
            capacity_mah=self.capacity_mah, voltage_v=self.voltage_v, other_drain_uw=self.other_drain_uw, source=self.source
        )
        return battery_life(Range(least, most), stated)


def saving_percent(energy: float, reference: float) -> float:
    """Compute what a controller saves against a reference (cDBS), per cent; negative when it uses more.

    Raises:
        ValueError: a reference that is not above zero, against which nothing can be saved.
    """
    if not reference > 0:
        raise ValueError(f"the reference energy must be above 0, not {reference}")
    return 100.0 * (1.0 - energy / reference)


def _mean_square(values: ArrayLike, name: str) -> float:
    array = np.asarray(values, dtype=np.float64)
    known = array[~np.isnan(array)]
    if not known.size:
        return math.nan
    _check(known, name)
    return float(np.square(known).mean())


def _check(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]], name: str) -> None:
    if (values < 0).any() or np.isinf(values).any():
        raise ValueError(f"{name} must be 0 or more and finite")
