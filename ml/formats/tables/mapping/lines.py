"""Tables with unknown columns, as lines of cells: text unchanged, Parquet with its names as the first line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any

from ml.formats.recording import UndecodableFile
from ml.formats.source import Source
from ml.formats.tables.cells.delimited import MOST_TITLES, rows_of, split_line, text_lines
from ml.formats.tables.cells.numbers import column_name
from ml.formats.tables.columns import LOG_COLUMNS

MOST_LINES = MOST_TITLES + 5
"""Lines that are looked at to learn how a table is written."""
MOST_COLUMNS = 64
MARKS = ("\t", ";", "|", ",")
NEEDED = "one line of names and one row per time"
_PARQUET = b"PAR1"


@dataclass(frozen=True, slots=True)
class Top:
    """The first lines of a table: (line number, cells), without blank ones; `delimiter` is None for Parquet."""

    lines: list[tuple[int, list[str]]]
    delimiter: str | None

    @property
    def is_log(self) -> bool:
        """True where it looks like a controller's log without its first line: no mapping may put its amplitudes to the wrong steps."""
        return any(len(LOG_COLUMNS & {column_name(cell)[0] for cell in cells}) >= 2 for _, cells in self.lines)


def read_top(path: Source) -> Top:
    """Read the first lines of a table. Raises UndecodableFile for what is no text and no Parquet."""
    if _is_parquet(path):
        with _parquet(path) as file:
            names = [str(n) for n in file.schema_arrow.names]
            rows = next(file.iter_batches(batch_size=MOST_LINES), None)
            cells = [] if rows is None else _texts(rows, range(len(names)))
            return Top([(1, names), *((i, row) for i, row in enumerate(cells, start=2))], None)
    with text_lines(path, NEEDED) as lines:
        top = list(islice(lines, MOST_LINES))
    delimiter = _delimiter(top)
    split = ((i, split_line(line, delimiter)) for i, line in enumerate(top, start=1))
    return Top([(i, cells) for i, cells in split if any(cells)], delimiter)


def read_rows(path: Source, top: Top, below: int, width: int, used: Sequence[int], most: int) -> tuple[list[int], list[list[str]]]:
    """Read line numbers and cells of the rows below a line; cells of unused columns may be empty.

    Args:
        top: of the same table.
        below: number of the last line that is no row.
        width: cells of a row.
        used: places of the columns that are needed.
        most: rows that the table may have.

    Raises:
        UndecodableFile: a row of another width, or too many; names the line.
    """
    if top.delimiter is not None:
        with text_lines(path, NEEDED) as lines:
            for _ in islice(lines, below):
                pass
            return rows_of(lines, top.delimiter, width, below, most)
    with _parquet(path) as file:
        if file.metadata.num_rows > most:
            raise UndecodableFile(f"more than {most} rows", "file", "Upload one session per table.")
        rows = [row for batch in file.iter_batches() for row in _texts(batch, used)][max(below - 1, 0) :]
    return [below + 1 + i for i in range(len(rows))], rows


def _delimiter(lines: Sequence[str]) -> str:
    """Find the mark that occurs equally often in most of the lines: the mark between cells, not the decimal comma."""

    def agreeing(mark: str) -> int:
        counts = Counter(n for line in lines if (n := line.count(mark)))
        return max(counts.values(), default=0)

    return max(MARKS, key=lambda mark: (agreeing(mark), -MARKS.index(mark)))


def _is_parquet(path: Source) -> bool:
    with path.open("rb") as stream:
        return stream.read(4) == _PARQUET


@contextmanager
def _parquet(path: Source) -> Iterator[Any]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with path.open("rb") as stream:
            yield pq.ParquetFile(stream)
    except (pa.ArrowException, OSError, ValueError) as error:
        hint = "Write the table again, for example with pandas' to_parquet."
        raise UndecodableFile("the Parquet file is damaged or cut", "file", hint) from error


def _texts(batch: Any, used: Sequence[int]) -> list[list[str]]:
    """Convert cells of a batch of a Parquet table to text; empty in columns that are not used."""
    wanted = set(used)
    columns = [[_text(v) for v in batch.column(i).to_pylist()] if i in wanted else [""] * batch.num_rows for i in range(batch.num_columns)]
    return [list(row) for row in zip(*columns, strict=True)]


def _text(value: Any) -> str:
    if value is None:
        return ""
    return str(value.isoformat()) if hasattr(value, "isoformat") else str(value)
