"""Methods by seed as a table and as a figure."""

from __future__ import annotations

from fastapi import Response

from app.analysis.evaluations.charts import panels
from app.analysis.evaluations.serializers import CSV_COLUMNS, csv_rows, missing
from app.analysis.evaluations.service import BySeed
from app.analysis.figures import boxes_svg
from app.analysis.tables import csv_of
from app.platform.web.csv_files import download


def table_of(found: BySeed) -> Response:
    """One row per method and seed."""
    return download(csv_of(CSV_COLUMNS, csv_rows(found)), f"{found.participant}-methods-by-seed.csv")


def figure_of(found: BySeed) -> Response:
    """A panel per metric, a point per seed."""
    note = f"Snapshot {found.snapshot_id}, seeds {', '.join(map(str, found.seeds))}; against sessions recorded after the snapshot."
    shown = panels(found) if found.rows else []
    content = boxes_svg(shown, f"Methods of evaluation, {found.participant}", note if shown else missing(found))
    return Response(content, media_type="image/svg+xml")
