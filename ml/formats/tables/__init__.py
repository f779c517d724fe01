"""Tables of steps, raw LFP or an outcome: read by `decode_table`, cut down to known columns by `redact_table`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, UndecodableFile
from ml.formats.source import Source
from ml.formats.tables.cells.delimited import read_headers
from ml.formats.tables.control_log import decode_log, is_log
from ml.formats.tables.mapping import decode_mapped
from ml.formats.tables.outcome_tables import OUTCOME_TABLES
from ml.formats.tables.redact import redact_table
from ml.formats.tables.steps import decode_csv, decode_parquet

__all__ = ["TABLES", "decode_table", "kind_of_text", "redact_table"]

_DECODERS: dict[str, Callable[[Path, DecodeOptions, str | None], DecodedFile]] = {
    "csv": decode_csv,
    "parquet": decode_parquet,
    "control_log": decode_log,
    "mapped": decode_mapped,
    **{one.kind: one.decode for one in OUTCOME_TABLES},
}


TABLES: frozenset[str] = frozenset(_DECODERS)
"""Kinds of tables."""


def decode_table(path: Path, kind: str, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a table; see `ml.formats.decode`. Raises UndecodableFile."""
    return _DECODERS[kind](path, options, name)


def kind_of_text(path: Source) -> str:
    """Detect the kind of a text table, by its first line or its headers."""
    if is_log(path):
        return "control_log"
    try:
        headers = read_headers(path)
    except UndecodableFile:
        return "csv"
    return next((one.kind for one in OUTCOME_TABLES if one.recognises(headers)), "csv")
