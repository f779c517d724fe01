"""Data queries as API types."""

from __future__ import annotations

from app.study.data_queries.schemas import DataQueryEntryOut, DataQueryOut
from app.tables.data_queries import DataQuery


def query_out(row: DataQuery) -> DataQueryOut:
    """A query with all that was said."""
    return DataQueryOut(
        id=row.id,
        participant=row.participant.code,
        session_id=row.session_id,
        upload_id=row.upload_id,
        visit_id=row.visit_id,
        dose_id=row.dose_id,
        event_id=row.event_id,
        record=row.record,
        field=row.field,
        state=row.state,
        entries=[DataQueryEntryOut.model_validate(entry) for entry in row.entries],
    )
