"""Stated beta of a table: its unit and its source, which the file itself cannot show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

from app.tables.participants import SettingsVersion
from ml.formats import DecodedFile, TraceLog, TraceSource
from ml.formats.tables.cells.numbers import unit_name


@dataclass(frozen=True)
class BetaStated:
    """Statement of the sender about a table: unit and source (as in the settings) of its beta, and the unit of its LFP."""

    unit: str | None = None
    source: str | None = None
    lfp_unit: str | None = None


_UNITS_OF_FILES = {"header": "as the file's header says", "mapping": "as the column mapping says"}


def name_beta(decoded: DecodedFile, beta: BetaStated, settings: SettingsVersion) -> DecodedFile:
    """Put a table's own beta under its source; the report gets a sentence that names who stated unit and source.

    Beta that was computed here, from a table of raw LFP, keeps the source `time_domain` and the unit it was computed in.
    """
    source = cast(TraceSource, beta.source or settings.beta_source or "table")
    named = tuple(
        replace(r, traces=tuple(replace(t, source=source) if _stated_by_a_person(t) else t for t in r.traces)) for r in decoded.recordings
    )
    report = decoded.reports[0]
    source_from = _stated_by(beta.source, settings.beta_source)
    for trace in (t for r in decoded.recordings for t in r.traces if _stated_by_a_person(t)):
        in_header = trace.details["unit_from"] in _UNITS_OF_FILES
        unit_from = _UNITS_OF_FILES.get(trace.details["unit_from"]) or _stated_by(beta.unit, settings.beta_unit)
        report.understood.append(f"beta: unit '{trace.unit}' {unit_from}, source '{source}' {source_from}")
        if in_header and beta.unit and unit_name(beta.unit) != trace.unit:
            stated = unit_name(beta.unit)
            report.flagged.append(f"beta is in '{trace.unit}' {unit_from}, the upload says '{stated}': the former was taken")
    return replace(decoded, recordings=named)


def _stated_by_a_person(trace: TraceLog) -> bool:
    """Decide whether a trace is the beta column of a table, whose source only a person can state."""
    return trace.stream == "beta" and trace.source == "table"


def _stated_by(by_upload: str | None, by_settings: str | None) -> str:
    """Name who stated a unit or a source."""
    if by_upload:
        return "as stated with the upload"
    return "as the participant's settings say" if by_settings else "because nobody stated one"
