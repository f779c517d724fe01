"""No cell of a download runs as a formula in a spreadsheet, and numbers stay numbers."""

from __future__ import annotations

import csv
import io

import pytest

from app.analysis.figures import csv_of
from app.platform.web.csv_files import safe_cell


def read(row: list[object]) -> list[list[str]]:
    """Return the rows that a spreadsheet finds in a table of one row."""
    return list(csv.reader(io.StringIO(csv_of(["note", "n"], [row]), newline="")))[1:]


@pytest.mark.parametrize("begin", ["=", "+", "-", "@", "\t", "\n", "＝", "＋", "－", "＠"])
def test_a_text_that_begins_like_a_formula_is_marked_as_text(begin: str) -> None:
    assert read([f"{begin}1+1|cmd"]) == [[f"'{begin}1+1|cmd"]]


@pytest.mark.parametrize("end", ["\r", "\r\n", "\n"])
def test_no_line_end_in_a_text_begins_a_row(end: str) -> None:
    assert read([f"tired{end}=1+1|cmd", 3]) == [["tired\n=1+1|cmd", "3"]]
    assert read([f"{end}=1+1|cmd", 3]) == [["'\n=1+1|cmd", "3"]]


@pytest.mark.parametrize("value", [-1.5, "1.5", "", None, "note = 3", "a-b"])
def test_all_else_stays_as_it_is(value: object) -> None:
    assert safe_cell(value) == value
