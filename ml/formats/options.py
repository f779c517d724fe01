"""Options of decoding, and limits of what a file may use of the machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

BetaMeasure = Literal["rms", "power"]


@dataclass(frozen=True, slots=True)
class ArchiveLimits:
    """Bounds checked against an archive's directory before anything is unpacked, and again while reading."""

    total_bytes: int = 2 * 1024**3
    member_bytes: int = 1024**3
    ratio: float = 200.0
    ratio_applies_above_bytes: int = 20 * 1024**2
    members: int = 2_000


@dataclass(frozen=True, slots=True)
class DecodeOptions:
    """Choices that change the decoded numbers; they belong to the participant's settings and are stored with the traces.

    Attributes:
        period_s: length of one step, s.
        beta_low_hz, beta_high_hz: edges of the beta band, Hz.
        beta_measure: what the stream `beta` is where samples give it: the RMS amplitude in the band (uV) or its power (uV2).
        min_valid_fraction: coverage: share of a window's samples that must have been measured for it to be valid, 0..1; one sample
            less will do.
        table_beta_unit: unit of `beta` in a table whose header states none.
        table_lfp_unit: unit of `lfp` in a table whose header states none; without it such a table is refused.
        max_table_rows: rows a table of steps may have.
        max_lfp_rows: rows a table of raw LFP may have.
        meanings: meanings that a lab has stated of its markers and channels, as JSON, by their keys (`ml.formats.labs.meanings`).
        keep_samples: keep the samples of each recording (`RecordingLog.samples`), which changes no other number.
        archive: bounds for archives.
    """

    period_s: float = 2.0
    beta_low_hz: float = 13.0
    beta_high_hz: float = 35.0
    beta_measure: BetaMeasure = "rms"
    min_valid_fraction: float = 0.7
    table_beta_unit: str = "unstated"
    table_lfp_unit: str | None = None
    max_table_rows: int = 500_000
    max_lfp_rows: int = 1_500_000
    meanings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    keep_samples: bool = False
    archive: ArchiveLimits = field(default_factory=ArchiveLimits)

    def __post_init__(self) -> None:
        if not self.period_s > 0:
            raise ValueError(f"period_s must be positive, not {self.period_s}")
        if not 0 < self.beta_low_hz < self.beta_high_hz:
            raise ValueError(f"beta band must rise from above 0 Hz, not {self.beta_low_hz} to {self.beta_high_hz} Hz")
        if not 0 < self.min_valid_fraction <= 1:
            raise ValueError(f"min_valid_fraction must lie in (0, 1], not {self.min_valid_fraction}")
        if self.beta_measure not in ("rms", "power"):
            raise ValueError(f"beta_measure must be rms or power, not {self.beta_measure!r}")

    @property
    def beta_streams(self) -> tuple[tuple[str, str, BetaMeasure], tuple[str, str, BetaMeasure]]:
        """(stream, unit, measure) of the two traces that time-domain samples in uV give: `beta`, and the other measure."""
        if self.beta_measure == "rms":
            return ("beta", "uV", "rms"), ("beta_power", "uV2", "power")
        return ("beta", "uV2", "power"), ("beta_rms", "uV", "rms")
