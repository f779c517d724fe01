"""Stimulation energy: relative to cDBS, and in microwatts where the pulses are known. Source: Gao et al. 2023, section 6.1 (metric).

The paper names the metric without a formula. Energy per pulse grows with the square of the current, so that at a fixed rate and pulse width
the energy of a session relative to cDBS is the mean of the squared amplitude fraction.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike


def relative_energy(fraction: ArrayLike) -> float:
    """Mean squared amplitude fraction of one session: 1 is cDBS, 0 is no stimulation; above 1 where amplitudes exceeded cDBS.

    Args:
        fraction: amplitude fraction of the cDBS amplitude per step, shape [T]; NaN where unknown, which is left out.

    Returns:
        Energy relative to cDBS; NaN when no step is known.

    Raises:
        ValueError: an amplitude below zero or infinite.
    """
    return _mean_square(fraction, "amplitude fraction")


def mean_square_ma(amplitude_ma: ArrayLike) -> float:
    """Mean squared amplitude of one session, mA^2; arguments and errors as in `relative_energy`, in milliamperes."""
    return _mean_square(amplitude_ma, "amplitude in mA")


def mean_power_uw(amplitude_ma: ArrayLike, pulse_width_us: ArrayLike, rate_hz: ArrayLike, impedance_ohm: float) -> float:
    """Mean electrical power into the tissue: I^2 R times the share of the time that a pulse is on (Koss et al. 2005, for currents).

    Args:
        amplitude_ma: pulse amplitude per step, mA, shape [T]; steps that are NaN in any of the three are left out.
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


def saving_percent(energy: float, reference: float) -> float:
    """What a controller saves against a reference (cDBS), per cent; negative when it uses more.

    Raises:
        ValueError: a reference that is not above zero, against which nothing can be saved.
    """
    if not reference > 0:
        raise ValueError(f"the reference energy must be above 0, not {reference}")
    return 100.0 * (1.0 - energy / reference)


def _mean_square(values: ArrayLike, name: str) -> float:
    array = np.asarray(values, dtype=np.float64)
    _check(array, name)
    known = array[~np.isnan(array)]
    return float(np.mean(known**2)) if known.size else math.nan


def _check(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]], name: str) -> None:
    if np.any(values < 0) or np.any(np.isinf(values)):
        raise ValueError(f"{name} must be 0 or more and finite")
