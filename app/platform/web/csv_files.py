"""Tables as CSV downloads, safe to open in a spreadsheet."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence

from fastapi import Response
from fastapi.responses import StreamingResponse

CSV = "text/csv; charset=utf-8"


def download(content: str, name: str) -> Response:
    """Send a CSV file under a name."""
    return Response(content, media_type=CSV, headers={"Content-Disposition": f'attachment; filename="{name}"'})


def stream(pieces: Iterable[str], name: str) -> Response:
    """Send a CSV file under a name, piece by piece while it is made."""
    return StreamingResponse(iter(pieces), media_type=CSV, headers={"Content-Disposition": f'attachment; filename="{name}"'})


def in_pieces(columns: Sequence[str], batches: Iterable[Iterable[Sequence[object]]]) -> Iterator[str]:
    """Write a table as text: its header, then the rows of each batch; what is not there is empty."""
    yield _write_rows([columns])
    for batch in batches:
        yield _write_rows(batch)


def _write_rows(rows: Iterable[Sequence[object]]) -> str:
    sink = io.StringIO()
    csv.writer(sink, lineterminator="\n").writerows([safe_cell(cell) for cell in row] for row in rows)
    return sink.getvalue()


_BEGINS_FORMULA = frozenset("=+-@\t\n＝＋－＠")
"""Beginnings that some spreadsheet takes for a formula's, the wide forms of East Asian keyboards among them."""


def safe_cell(value: object) -> object:
    """Make a cell safe, so that spreadsheets do not run it as a formula.

    Its line ends are line feeds: a carriage return alone, which the writer leaves without quotes, would begin a row of its own.
    """
    if not isinstance(value, str):
        return value
    text = value.replace("\r\n", "\n").replace("\r", "\n")
    return f"'{text}" if text[:1] in _BEGINS_FORMULA else text
