"""Stated beta of a table: its unit and its source, which the file itself cannot show; and the choices of decoders that rest on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

from sqlalchemy.orm import Session

from app.ingest import repository
from app.tables.participants import Participant, SettingsVersion
from app.tables.uploads import Upload, UploadFile
from ml.formats import BetaMeasure, DecodedFile, DecodeOptions, TraceLog, TraceSource
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


def decode_options(db: Session, participant: Participant, beta: BetaStated) -> DecodeOptions:
    """Combine the participant's choices for decoders with what the sender stated of a table, and the study of markers."""
    settings = participant.current_settings
    return DecodeOptions(
        period_s=settings.period_s,
        beta_low_hz=settings.beta_low_hz,
        beta_high_hz=settings.beta_high_hz,
        beta_measure=cast(BetaMeasure, settings.beta_measure),
        min_valid_fraction=settings.min_valid_fraction,
        table_beta_unit=beta.unit or settings.beta_unit or "unstated",
        table_lfp_unit=beta.lfp_unit,
        meanings=repository.meanings_in_force(db, participant.site.study_id),
    )


def options_of_file(db: Session, file: UploadFile, participant: Participant) -> DecodeOptions:
    """Build the options for a stored file, with what its sender had stated of it."""
    return decode_options(db, participant, stated_beta(db, file))


def stated_beta(db: Session, file: UploadFile) -> BetaStated:
    """Read what the sender of a stored file had stated of its beta."""
    said = db.get_one(Upload, file.upload_id).stated
    return BetaStated(said.get("unit"), said.get("source"), said.get("lfp_unit"))
