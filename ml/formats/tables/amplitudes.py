"""Amplitudes of a table: what a stimulator can give, and whether two columns agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ml.formats.recording import FileReport, UndecodableFile
from ml.formats.tables.columns import PER_UNIT, Columns

LARGEST = {"amplitude_ma": 25.5, "amplitude_fraction": 10.0}
"""25.5 mA is the largest amplitude that a stimulator like RC+S or Percept can be set to; a fraction above 10 was meant as percent."""
RATIO_SPREAD = 0.05
"""mA per fraction may vary by this share, for rounded cells, and still be one cDBS amplitude."""
LEAST_FRACTION = 0.05
"""Below this fraction rounding alone moves the ratio."""


def checked_amplitude(role: str, columns: Columns, report: FileReport) -> NDArray[np.float64]:
    """Check an amplitude column's numbers [rows] in mA or as a fraction, NaN where there is none.

    Raises:
        UndecodableFile: an amplitude that no stimulator gives; names line and column.
    """
    values = columns.values[role]
    if lost := int(np.sum(np.isnan(values))):
        report.flagged.append(f"{lost} rows without a number in {role}: kept as gaps")
    values = values / PER_UNIT[role][columns.units[role]]
    if role == "amplitude_ma" and (hold := values == LARGEST[role]).any():
        report.flagged.append(f"{int(hold.sum())} rows of {LARGEST[role]:g} mA, which is a stimulator's sign for no amplitude: unknown")
        values = np.where(hold, np.nan, values)
    if (negative := np.flatnonzero(values < 0)).size:
        hint = "Amplitudes are 0 or more; leave the cell empty if unknown."
        raise columns.error(f"negative amplitude {values[negative[0]]:g}", role, hint, int(negative[0]))
    if (absurd := np.flatnonzero(values > LARGEST[role] * (1 + 1e-9))).size:
        raise _absurd(role, float(values[absurd[0]]), columns, int(absurd[0]))
    if role == "amplitude_fraction" and (above := int(np.sum(values > 1))):
        report.flagged.append(f"{above} rows have an amplitude above the cDBS amplitude (fraction > 1); kept as they are")
    return values


def _absurd(role: str, value: float, columns: Columns, row: int) -> UndecodableFile:
    largest = LARGEST[role]
    if role == "amplitude_ma":
        what = f"amplitude {value:g} mA, more than the {largest:g} mA that a stimulator can give"
        hint = "Give mA; if the numbers are in uA, name the column amplitude (uA)."
    else:
        what = f"amplitude fraction {value:g}, more than {largest:g} times the cDBS amplitude"
        hint = "Give 1 for the cDBS amplitude; name the column amplitude_fraction (%) for percent or amplitude_ma for mA."
    return columns.error(what, role, hint, row)


def compare_amplitudes(milliamps: NDArray[np.float64], fraction: NDArray[np.float64], report: FileReport) -> NDArray[np.bool_]:
    """Say which of two amplitude columns is used, and find the rows, [n], in which both cannot be true for one cDBS amplitude."""
    report.ignored.append("amplitude_fraction: amplitude_ma is given too and is what is stored")
    both = np.isfinite(milliamps) & np.isfinite(fraction) & (fraction > LEAST_FRACTION)
    differ = np.zeros(milliamps.size, dtype=bool)
    if not both.any():
        return differ
    ratio = milliamps[both] / fraction[both]
    if ratio.max() > (1 + RATIO_SPREAD) * ratio.min():
        differ[both] = np.abs(ratio - np.median(ratio)) > RATIO_SPREAD * np.median(ratio)
        runs = f"runs from {ratio.min():.4g} to {ratio.max():.4g} mA"
        unknown = f"{int(differ.sum())} rows are unknown until a person chooses"
        report.flagged.append(f"amplitude_ma and amplitude_fraction disagree: their ratio, the cDBS amplitude, {runs}; {unknown}")
    return differ
