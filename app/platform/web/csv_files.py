"""Tables as CSV downloads, safe to open in a spreadsheet."""

from __future__ import annotations

from fastapi import Response

CSV = "text/csv; charset=utf-8"


def download(content: str, name: str) -> Response:
    """A CSV file under a name."""
    return Response(content, media_type=CSV, headers={"Content-Disposition": f'attachment; filename="{name}"'})


def safe_cell(value: object) -> object:
    """A cell that spreadsheets do not run as a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in set("=+-@\t\r") else value
