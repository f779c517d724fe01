"""What a session of `betaloop control` means for an implant's battery, under assumptions about the implant that a file states."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from app.platform.errors import Invalid
from ml.energy import BatteryAssumptions, BatteryLife, Range, battery_life, mean_power_uw, supply_power_uw

_RANGES = ("capacity_mah", "voltage_v", "other_drain_uw", "impedance_ohm", "supply_v", "pulse_width_us", "rate_hz")
_MEND = (
    "State capacity_mah, voltage_v, other_drain_uw (all but this stimulation: sensing, telemetry, the other side), impedance_ohm, "
    "supply_v, pulse_width_us and rate_hz as numbers or [low, high], and source: where they are from."
)


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
        """From full to empty at these amplitudes, mA [T]: between an output stage without loss (I^2 R) and a fixed supply (I V).

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


def read_implant(path: Path) -> Implant:
    """The assumptions in a JSON file.

    Raises:
        Invalid: no such file, or an assumption is missing or no number.
    """
    try:
        stated = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise Invalid(f"The assumptions about the battery in {path} cannot be read: {error}.", _MEND) from error
    if not isinstance(stated, dict) or set(stated) != {*_RANGES, "source"} or not isinstance(stated["source"], str):
        raise Invalid(f"{path} does not hold the assumptions about the battery.", _MEND)
    try:
        implant = Implant(**{name: _range(stated[name]) for name in _RANGES}, source=stated["source"])
        implant.life([1.0])
    except (ValueError, TypeError) as error:
        raise Invalid(f"The assumptions about the battery in {path} make no sense: {error}.", _MEND) from error
    return implant


def _range(value: Any) -> Range:
    ends = value if isinstance(value, list) else [value, value]
    numbers = all(isinstance(end, (int, float)) and not isinstance(end, bool) and math.isfinite(end) for end in ends)
    if len(ends) != 2 or not numbers:
        raise ValueError(f"{value} is neither a number nor [low, high]")
    return Range(float(ends[0]), float(ends[1]))
