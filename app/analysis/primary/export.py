"""Primary results as a table for other programs."""

from __future__ import annotations

from collections.abc import Mapping

from fastapi import Response

from app.analysis.primary.serializers import CSV_COLUMNS, csv_rows
from app.analysis.primary.service import Primary
from app.analysis.tables import csv_of
from app.platform.web.csv_files import download

_POLICY = CSV_COLUMNS.index("policy_id")


def primary_csv(found: Primary, standings: Mapping[int, str]) -> Response:
    """Write one row per controller or policy and metric; `standings` has a sentence by policy."""
    rows = [(*row, standings.get(row[_POLICY])) for row in csv_rows(found)]  # type: ignore[call-overload]
    return download(csv_of((*CSV_COLUMNS, "standing"), rows), f"{found.evidence.participant}-primary.csv")
