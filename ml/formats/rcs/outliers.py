"""Spikes in the device's band power that no brain makes: transients of the amplifier around a change of stimulation.

In a recording with amplitude steps the band power jumps by up to four decades for two to three seconds at every step. This is the step's
transient, seen for as long as it is within the FFT window. The device does not mark it (`IsPowerChannelOverrange` stays false). The log of
the step may be more than a second late, so the power itself decides. A packet is a spike where log power leaves its running median by far,
for no longer than a transient can last. Longer plateaus move the median and are signal.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

SPIKE_MADS: Final = 6.0
"""Robust standard deviations (1.4826 MAD of the residuals) of log power above the running median that make a spike."""

SHOULDER_MADS: Final = 2.0
"""Down to this the packets right before and after a spike count as its shoulders."""

LEAST_FACTOR: Final = 10.0
"""Least factor of a spike over the running median, however quiet the recording. Power of one bin is exponentially distributed, and passes
10 times its median once in a thousand independent windows."""

TRANSIENT_S: Final = 1.0
"""How long the amplifier takes to settle; the FFT window is added to it."""

MEDIAN_SPANS: Final = 4.0
"""Width of the running median in longest transients, so that one transient, and even two in a row, cannot move it."""


def _running_median(x: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Compute the median of the odd number of values around each, [n]; near an end that of the first or last whole window."""
    out = np.asarray(scipy.ndimage.median_filter(x, size=width, mode="nearest"), dtype=np.float64)
    half = width // 2
    out[:half], out[x.size - half :] = out[half], out[x.size - 1 - half]
    return out


def power_spikes(power: NDArray[np.float64], interval_s: float, window_s: float) -> NDArray[np.bool_]:
    """Mark packets that are spikes.

    Args:
        power: one band in device units, [n], in time order; NaN where there is no value.
        interval_s: time between packets, s.
        window_s: length of the FFT window, s.

    Returns:
        True at spikes, [n].
    """
    out = np.zeros(power.size, dtype=bool)
    known = np.flatnonzero(np.isfinite(power))
    if known.size < 3:
        return out
    level = np.log(np.maximum(power[known], 0.0) + 1.0)  # one device unit is the resolution
    longest = (TRANSIENT_S + window_s) / interval_s
    width = 2 * round(MEDIAN_SPANS * longest / 2.0) + 1
    above = level - _running_median(level, min(width, known.size - (known.size + 1) % 2))
    sigma = 1.4826 * float(np.median(np.abs(above - np.median(above))))
    seeds = above > max(SPIKE_MADS * sigma, np.log(LEAST_FACTOR))
    raised = above > max(SHOULDER_MADS * sigma, np.log(2.0))
    begins = np.flatnonzero(raised & ~np.concatenate(([False], raised[:-1])))
    ends = np.flatnonzero(raised & ~np.concatenate((raised[1:], [False]))) + 1
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        if seeds[begin:end].any():
            out[known[begin:end]] = True
    return out
