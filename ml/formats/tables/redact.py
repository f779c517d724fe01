"""Take identity out of tables before they are stored: known columns stay, as the numbers and classes that were read from them.

The result decodes to the same recording or outcomes; texts of the file do not survive at all.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ml.formats.options import DecodeOptions
from ml.formats.redaction_record import Redaction
from ml.formats.source import Source
from ml.formats.tables.columns import Columns, read_csv, read_parquet
from ml.formats.tables.control_log import redact_log
from ml.formats.tables.outcome_table import OutcomeTable, cell
from ml.formats.tables.outcome_tables import BY_KIND
from ml.formats.tables.removed import removed_columns
from ml.formats.tables.steps import decode_columns


def redact_table(source: Source, target: Path, kind: str, options: DecodeOptions) -> Redaction:
    """Write a table of the known columns alone; the same bytes in give the same bytes out.

    Headers become the column's role with its unit in brackets, cells the numbers that were read. A table of steps or of raw LFP keeps its
    line numbers; a table of an outcome becomes the lines of its kind.

    Args:
        source: the uploaded table.
        target: where the redacted table is written.
        kind: what the table is.
        options: choices of the decoder, which checks the table as the sender wrote it.

    Raises:
        UndecodableFile: the table cannot be decoded; nothing is written then.
        ValueError: no kind of table, or one that a column mapping reads.
    """
    if kind not in ("csv", "parquet", "control_log", *BY_KIND):
        raise ValueError(f"a file of kind {kind} is not cleaned here; a column mapping cleans the tables that it reads")
    if kind in BY_KIND:
        return redact_outcomes(source, target, BY_KIND[kind], options)
    if kind == "control_log":
        return redact_log(source, target, options)
    columns = read_csv(source, options) if kind == "csv" else read_parquet(source, options)
    decode_columns(columns, options, "table")
    if kind == "csv":
        _write_csv(columns, target)
    else:
        _write_parquet(columns, target)
    return Redaction(removed=removed_columns(columns.ignored), repaired=list(columns.notes))


def redact_outcomes(source: Source, target: Path, table: OutcomeTable, options: DecodeOptions) -> Redaction:
    """Write a table of an outcome as the measurements that were read from it; see `redact_table`."""
    decoded = table.decode(source, options, None)
    report = decoded.reports[0]
    target.write_text("\n".join(table.lines(decoded.outcomes)) + "\n", encoding="utf-8")
    assumed = [text for text in report.flagged if "read as UTC" in text]
    return Redaction(removed=list(report.removed), repaired=[*report.repaired, *assumed], ignored=list(report.ignored))


def _write_csv(columns: Columns, target: Path) -> None:
    with target.open("w", encoding="utf-8", newline="") as out:
        out.write(",".join(columns.label(role) for role in columns.values) + "\n")
        at = 2
        columns_of_cells = [list(map(cell, v.tolist())) for v in columns.values.values()]
        for line, row in zip(columns.lines.tolist(), map(",".join, zip(*columns_of_cells, strict=True)), strict=True):
            # blank lines keep every row on its line, so that later reports name the line that the sender sees
            out.write("\n" * (line - at) + row + "\n" if line > at else row + "\n")
            at = line + 1


def _write_parquet(columns: Columns, target: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {columns.label(role): pa.array(v, type=pa.float64(), mask=np.isnan(v)) for role, v in columns.values.items()}
    pq.write_table(pa.table(arrays), target, store_schema=False)
