"""Primary results as a table for other programs."""

from __future__ import annotations

from fastapi import Response

from app.analysis.primary.serializers import CSV_COLUMNS, csv_rows
from app.analysis.primary.service import Primary
from app.analysis.tables import csv_of
from app.platform.web.csv_files import download


def primary_csv(found: Primary) -> Response:
    """One row per controller or policy and metric."""
    return download(csv_of(CSV_COLUMNS, csv_rows(found)), f"{found.evidence.participant}-primary.csv")
