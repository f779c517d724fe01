"""Answers of a target to the port vectors, as a table. Each error names the line at fault, and how to correct it."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ml.deploy.ports.vectors import HASH, PORT_VECTORS, ROW, PortVectors
from ml.deploy.ports.windows import COUNT

ANSWER, DECIDED = "answer", "answer_ma"
MAX_BYTES = 64 * 2**20
_MISSING = {"", "nan", "-nan", "none", "null", "na"}
_DECIMAL_COMMA = re.compile(r"\s*[-+]?\d+,\d+\s*")


class AnswersError(ValueError):
    """A table of answers that cannot be used.

    Attributes:
        line: of the file, from 1. hint: how to correct it.
    """

    def __init__(self, line: int, what: str, hint: str) -> None:
        super().__init__(f"line {line}: {what}")
        self.line, self.hint = line, hint


class Answers(NamedTuple):
    """Answers of a target, NaN where it gave no number.

    Attributes:
        fraction: of the network, [400]; None where the table has none.
        decided_ma: of the whole decision, mA, [400]; None where the table has none.
    """

    fraction: NDArray[np.float64] | None
    decided_ma: NDArray[np.float64] | None


def read_answers(content: bytes, vectors: PortVectors) -> Answers:
    """Read a table with the columns `row`, `hash`, and `answer` (fraction), `answer_ma` (whole decision, mA) or both.

    Other columns are ignored, so that a target may add its column to `port-vectors.csv`.

    Raises:
        AnswersError: the table is cut, of another bundle, in another order, or holds something that is no number.
    """
    if len(content) > MAX_BYTES:
        raise AnswersError(1, f"the file has {len(content)} bytes", "Send the table alone.")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise AnswersError(line, "it is no text in UTF-8", "Save the table as CSV in UTF-8, not as a spreadsheet.") from error
    reader = csv.reader(io.StringIO(text, newline=""))
    try:
        header = [name.strip().lower() for name in next(reader, [])]
        places = _places(header)
        rows = []
        for fields in reader:
            if fields and any(field.strip() for field in fields):
                rows.append((reader.line_num, fields))
    except csv.Error as error:
        raise AnswersError(reader.line_num, f"it cannot be read as CSV: {error}", "Write plain CSV, a row per line.") from error
    found = [_row(line, fields, header, places, due, vectors) for due, (line, fields) in enumerate(rows, 1)]
    if len(found) < COUNT:
        last = rows[-1][0] if rows else 1
        raise AnswersError(
            last, f"the file ends here, after {len(found)} of {COUNT} rows", f"Write every row of {PORT_VECTORS}: the file was cut."
        )
    numbers = np.array(found)
    columns = [name for name in (ANSWER, DECIDED) if name in places]
    by_name = {name: numbers[:, i] for i, name in enumerate(columns)}
    return Answers(by_name.get(ANSWER), by_name.get(DECIDED))


def _places(header: Sequence[str]) -> dict[str, int]:
    """Find the columns. Raises AnswersError for a header without them."""
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        raise AnswersError(1, "the columns are not separated by commas", "Save with commas between columns and points in numbers.")
    for name in (ROW, HASH):
        if header.count(name) != 1:
            raise AnswersError(1, f"the header needs one column '{name}'", f"Copy '{ROW}' and '{HASH}' from {PORT_VECTORS}.")
    if not {ANSWER, DECIDED} & set(header):
        hint = f"Add '{ANSWER}' with the network's fraction, or '{DECIDED}' with the whole decision in mA."
        raise AnswersError(1, "the header names no column of answers", hint)
    for name in (ANSWER, DECIDED):
        if header.count(name) > 1:
            raise AnswersError(1, f"the header names '{name}' twice", "Keep one column of each name.")
    return {name: header.index(name) for name in (ROW, HASH, ANSWER, DECIDED) if name in header}


def _row(line: int, fields: Sequence[str], header: Sequence[str], places: dict[str, int], due: int, vectors: PortVectors) -> list[float]:
    """Read one row. Raises AnswersError naming its line."""
    if len(fields) > len(header):
        hint = "Write numbers with a point, as 0.5: a decimal comma starts a new column."
        raise AnswersError(line, f"{len(fields)} values where the header has {len(header)}", hint)
    if len(fields) < len(header):
        hint = f"Write every column in every row. If the file was cut here, write all rows of {PORT_VECTORS}."
        raise AnswersError(line, f"{len(fields)} values where the header has {len(header)}", hint)
    if due > COUNT:
        raise AnswersError(line, f"there are more rows than the {COUNT} of {PORT_VECTORS}", "Write each row once.")
    row, digest = fields[places[ROW]].strip(), fields[places[HASH]].strip().lower()
    if row != str(due):
        hint = f"Keep the rows in the order of {PORT_VECTORS}, each once."
        raise AnswersError(line, f"row {row or 'without a number'} is where row {due} is due", hint)
    if digest != vectors.hashes[due - 1]:
        hint = "Run the port on the vectors of this bundle, and copy the column 'hash' as text."
        raise AnswersError(line, f"hash '{digest}' is not that of row {due} of this bundle, {vectors.hashes[due - 1]}", hint)
    return [_number(line, name, fields[places[name]]) for name in (ANSWER, DECIDED) if name in places]


def _number(line: int, name: str, text: str) -> float:
    """Read a number; NaN where none was answered. Raises AnswersError for other text."""
    stripped = text.strip().lower()
    if stripped in _MISSING:
        return math.nan
    if _DECIMAL_COMMA.fullmatch(stripped):
        raise AnswersError(line, f"'{text}' in '{name}' has a decimal comma", f"Write it with a point, as {stripped.replace(',', '.')}.")
    try:
        return float(stripped)
    except ValueError as error:
        hint = "Write a number, or leave it empty where the port gives no number."
        raise AnswersError(line, f"'{text[:40]}' in '{name}' is no number", hint) from error


def write_answers(vectors: PortVectors, answers: Answers) -> bytes:
    """Write answers as the table that `read_answers` reads."""
    sink = io.StringIO()
    writer = csv.writer(sink, lineterminator="\n")
    columns = [(name, values) for name, values in ((ANSWER, answers.fraction), (DECIDED, answers.decided_ma)) if values is not None]
    writer.writerow([ROW, HASH, *(name for name, _ in columns)])
    for i, digest in enumerate(vectors.hashes):
        writer.writerow([i + 1, digest, *(f"{float(values[i])!r}" for _, values in columns)])
    return sink.getvalue().encode()
