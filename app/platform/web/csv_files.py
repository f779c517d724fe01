"""Tables as CSV downloads, safe to open in a spreadsheet."""

from __future__ import annotations

from fastapi import Response

CSV = "text/csv; charset=utf-8"


def download(content: str, name: str) -> Response:
    """A CSV file under a name."""
    return Response(content, media_type=CSV, headers={"Content-Disposition": f'attachment; filename="{name}"'})


_BEGINS_FORMULA = frozenset("=+-@\t\n＝＋－＠")
"""Beginnings that some spreadsheet takes for a formula's, the wide forms of East Asian keyboards among them."""


def safe_cell(value: object) -> object:
    """A cell that spreadsheets do not run as a formula.

    Its line ends are line feeds: a carriage return alone, which the writer leaves without quotes, would begin a row of its own.
    """
    if not isinstance(value, str):
        return value
    text = value.replace("\r\n", "\n").replace("\r", "\n")
    return f"'{text}" if text[:1] in _BEGINS_FORMULA else text
