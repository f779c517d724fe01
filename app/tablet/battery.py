"""Effect of a session of `betaloop control` on an implant's battery, under assumptions about the implant that a file states."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from app.platform.errors import Invalid
from ml.energy import Implant, Range

_RANGES = ("capacity_mah", "voltage_v", "other_drain_uw", "impedance_ohm", "supply_v", "pulse_width_us", "rate_hz")
_MEND = (
    "State capacity_mah, voltage_v, other_drain_uw (all but this stimulation: sensing, telemetry, the other side), impedance_ohm, "
    "supply_v, pulse_width_us and rate_hz as numbers or [low, high], and source: where they are from."
)


def read_implant(path: Path) -> Implant:
    """Read the assumptions in a JSON file.

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
