"""Tables of the analyses as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence

from app.platform.web.csv_files import safe_cell


def csv_of(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A CSV with its header; what is not there is empty."""
    sink = io.StringIO()
    out = csv.writer(sink, lineterminator="\n")
    out.writerow(columns)
    out.writerows([safe_cell(cell) for cell in row] for row in rows)
    return sink.getvalue()
