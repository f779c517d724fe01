"""Previews and column mappings as API types."""

from __future__ import annotations

from collections.abc import Sequence

from app.ingest.mappings.schemas import MappedColumnIn, MappedOut, MappingOut, PreviewLineOut, PreviewOut
from app.ingest.mappings.service import Applied, WaitingTable
from app.ingest.quarantine.serializers import problem_of
from app.ingest.schemas import FileReportOut
from app.tables.uploads import ColumnMapping


def mapping_out(row: ColumnMapping, current: bool) -> MappingOut:
    """Convert a version of a mapping for the API."""
    stored = row.as_mapping
    return MappingOut(
        id=row.id,
        name=row.name,
        version=row.version,
        current=current,
        removed=row.removed,
        unit_lines=stored.unit_lines,
        holds=stored.holds,
        time_format=stored.time_format,
        zone=stored.zone,
        rate_hz=stored.rate_hz,
        time_at=("begin" if stored.row_begins else "end") if stored.holds == "steps" else None,
        columns=[MappedColumnIn.model_validate(c) for c in stored.columns],
        labels=row.labels,
        created_at=row.created_at,
        created_by=row.created_by,
        reason=row.reason,
    )


def mappings_out(rows: Sequence[ColumnMapping], present: Sequence[ColumnMapping]) -> list[MappingOut]:
    """Convert versions of mappings for the API; `present` are those in force."""
    in_force = {row.id for row in present}
    return [mapping_out(row, row.id in in_force) for row in rows]


def preview_out(table: WaitingTable) -> PreviewOut:
    """Convert a waiting table for the API."""
    shown = table.preview
    return PreviewOut(
        file_id=table.file.id,
        participant=table.participant.code,
        problem=problem_of(table.file),
        width=shown["width"],
        lines=[PreviewLineOut(number=x["number"], cells=x["cells"], may_be_header=x["header"] is not None) for x in shown["lines"]],
        header_line=shown["header_line"],
        unit_lines=shown["unit_lines"],
        mapping=mapping_out(table.known, True) if table.known else None,
    )


def applied_out(applied: Applied) -> MappedOut:
    """Convert the result of a mapping for the API."""
    return MappedOut(
        mapping=mapping_out(applied.mapping, True),
        report=[FileReportOut.model_validate(r) for f in applied.outcomes for r in f.reports],
        session_ids=sorted({i for f in applied.outcomes for i in f.session_ids}),
        waiting=applied.waiting,
    )
