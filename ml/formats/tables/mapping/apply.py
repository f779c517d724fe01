"""Reading of a table by a column mapping, and writing of what may be stored of it: named columns alone, as numbers.

Steps and LFP are written as a table of their own kind (`stored`), outcomes as those that every decoder of theirs reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from ml.formats.options import DecodeOptions
from ml.formats.recording import UndecodableFile
from ml.formats.redaction_record import Redaction
from ml.formats.source import InMemory, Source
from ml.formats.tables.cells.delimited import MOST_TITLES, TextTable
from ml.formats.tables.mapping.lines import Top, read_rows, read_top
from ml.formats.tables.mapping.model import AMPLITUDES, SIGNALS, TableMapping, header_hash
from ml.formats.tables.mapping.preview import is_row
from ml.formats.tables.mapping.stored import MappedTable, decode_table_of, write
from ml.formats.tables.mapping.times import is_absolute, read_times
from ml.formats.tables.outcome_tables import BY_KIND
from ml.formats.tables.redact import redact_outcomes
from ml.formats.tables.removed import removed_columns


def find_mapping(path: Source, mappings: Sequence[TableMapping], key: bytes) -> int | None:
    """Find the mapping that was made for this table's header, by its place; None where there is none.

    Args:
        path: the uploaded bytes.
        mappings: those of the study.
        key: secret of the installation.
    """
    if not mappings:
        return None
    try:
        top = read_top(path)
    except UndecodableFile:
        return None
    places = {m.header: i for i, m in enumerate(mappings)}
    found = (places[h] for _, cells in _may_be_header(top) if (h := header_hash(cells, key)) in places)
    return next(found, None)


def _may_be_header(top: Top) -> list[tuple[int, list[str]]]:
    return [(number, cells) for number, cells in top.lines if number <= MOST_TITLES + 1]


def redact_mapped(source: Source, target: Path, mapping: TableMapping, key: bytes, options: DecodeOptions) -> Redaction:
    """Write a table that a mapping reads, without identity; the same bytes in give the same bytes out.

    Args:
        source: the uploaded bytes, with a line of names that `mapping` was made for.
        target: where the cleaned table is written.
        mapping: which column is what.
        key: secret of the installation, as for the mapping.
        options: choices of the decoder, which checks the table as the sender wrote it.

    Raises:
        UndecodableFile: the table cannot be read so; nothing is written then.
    """
    top = read_top(source)
    number, names = next((n, cells) for n, cells in _may_be_header(top) if header_hash(cells, key) == mapping.header)
    _check_passed_over(top, number, mapping)
    used = [c.number - 1 for c in mapping.columns]
    most = options.max_lfp_rows if mapping.holds == "lfp" else options.max_table_rows
    lines, rows = read_rows(source, top, number + mapping.unit_lines, mapping.width, used, most)
    if not rows:
        raise UndecodableFile("the table has a header but no rows", f"after line {number}", "Upload a table with rows.")
    safe = [f"column {i + 1}" for i in range(mapping.width)]
    table = TextTable(safe, lines, rows, top.delimiter or "", [])
    removed = removed_columns(name for i, name in enumerate(names) if i not in used)
    if mapping.kind == "mapped":
        found = _signals(table, mapping, options)
        decode_table_of(found, options, "table")
        write(found, target)
        return Redaction(removed=removed, repaired=list(table.notes))
    # in memory: cells of text are not screened yet
    redaction = redact_outcomes(InMemory(_outcomes(table, mapping).encode()), target, BY_KIND[mapping.kind], options)
    redaction.removed.extend(removed)
    return redaction


def _check_passed_over(top: Top, names: int, mapping: TableMapping) -> None:
    """Raise UndecodableFile where the line of names or a line of units is a row, which would be lost without a word."""
    for number, cells in top.lines:
        if names <= number <= names + mapping.unit_lines and is_row(cells, mapping.width):
            what = f"holds measurements, and the column mapping takes it for a line of {'names' if number == names else 'units'}"
            hint = "State which line names the columns and how many lines of units follow, or put the line of units there."
            raise UndecodableFile(f"the line {what}", f"line {number}", hint)


def _signals(table: TextTable, mapping: TableMapping, options: DecodeOptions) -> MappedTable:
    """Read numbers of the named columns, and times in seconds from the start of the session."""
    (time,) = mapping.of_role("time")
    t_s = read_times(table, time.number - 1, mapping)
    columns = mapping.of_role(*SIGNALS, *AMPLITUDES)
    places = [c.number - 1 for c in columns]
    decimal = table.decimal_mark(places)
    values = [table.numbers(place, decimal, columns[i].role) for i, place in enumerate(places)]
    started_at: datetime | None = None
    # a row's time is the end of its step, everywhere in here; a sample has no length
    length = options.period_s if mapping.holds == "steps" else 0.0
    if is_absolute(mapping.time_format):
        known = t_s[np.isfinite(t_s)]
        begin = float(known[0] if known.size else 0.0) - (0.0 if mapping.row_begins else length)
        started_at = datetime.fromtimestamp(begin, UTC)
        t_s = t_s - begin
    if mapping.row_begins:
        t_s = t_s + length
    return MappedTable(started_at, tuple(columns), np.array(table.lines, dtype=np.int64), np.round(t_s, 6), tuple(values))


def _outcomes(table: TextTable, mapping: TableMapping) -> str:
    """Write a table of an outcome with the names that its decoder knows, each row on its original line."""
    (time,) = mapping.of_role("time")
    places = {c.role: c.number - 1 for c in mapping.columns if c.role != "time"}
    t_s = read_times(table, time.number - 1, mapping)
    names, cells = BY_KIND[mapping.kind].mapped_cells(table, places, t_s, is_absolute(mapping.time_format))
    out, at = [",".join(names)], 1
    for line, row in zip(table.lines, cells, strict=True):
        out += [""] * (line - at - 1) + [",".join(f'"{cell}"' if "," in cell else cell for cell in row)]
        at = line
    return "\n".join(out) + "\n"
