"""Samples of a window as API types."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.overview.signals.schemas import SignalChannelOut, SignalOut, SpectrogramOut
from app.overview.signals.service import Signals, SignalWindow


def signal_out(signals: Signals, window: SignalWindow) -> SignalOut:
    """A window, and what other channels there are."""
    power = window.power
    return SignalOut(
        channels=[SignalChannelOut.model_validate(c) for c in signals.channels],
        channel=window.channel.number,
        begin_s=window.begin_s,
        end_s=window.end_s,
        resolution_s=window.resolution_s,
        t_s=np.round(window.t_s, 6).tolist(),
        low=_listed(window.low),
        high=_listed(window.high),
        spectrogram=SpectrogramOut(
            first_s=power.first_s,
            width_s=power.width_s,
            hz=power.hz.tolist(),
            decibel=[_listed(column) for column in decibel(power.density)],
        ),
    )


def decibel(density: NDArray[np.float32]) -> NDArray[np.float64]:
    """10 log10 of a density, to a tenth; NaN where it is 0 or not known."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.round(10 * np.log10(density.astype(np.float64)), 1)
    return np.where(np.isfinite(found), found, np.nan)


def _listed(values: NDArray[Any]) -> list[float | None]:
    return [None if v != v else float(f"{v:.6g}") for v in values.tolist()]
