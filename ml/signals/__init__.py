"""Beta amplitude from local field potentials, and averages per step of streams with gaps. P_beta: Gao et al. 2023, section 3."""

from ml.signals.bands import (
    BRIDGE_S,
    MIN_CYCLES,
    SEGMENTS_AT_ONCE,
    BandRows,
    Stretch,
    band_pass,
    band_rows,
    gap_models,
    one_sample,
    spectrum,
)
from ml.signals.rows import interval_means, row_means, row_of, step_means

__all__ = [
    "BRIDGE_S",
    "MIN_CYCLES",
    "SEGMENTS_AT_ONCE",
    "BandRows",
    "Stretch",
    "band_pass",
    "band_rows",
    "gap_models",
    "interval_means",
    "one_sample",
    "row_means",
    "row_of",
    "spectrum",
    "step_means",
]
