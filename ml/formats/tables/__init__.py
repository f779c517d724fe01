"""Tables of steps, raw LFP, tremor or grasps: read by `decode_table`, cut down to known columns by `redact_table`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, cast

from ml.formats.options import DecodeOptions
from ml.formats.recording import DecodedFile, UndecodableFile
from ml.formats.source import Source
from ml.formats.tables.control_log import decode_log, is_log
from ml.formats.tables.delimited import read_headers
from ml.formats.tables.grasps import decode_grasps, looks_like_grasps
from ml.formats.tables.mapping import decode_mapped
from ml.formats.tables.redact import redact_table
from ml.formats.tables.steps import decode_csv, decode_parquet
from ml.formats.tables.strivepd import decode_strivepd, looks_like_tremor

__all__ = ["TABLES", "TableKind", "decode_table", "kind_of_text", "redact_table"]

TableKind = Literal["csv", "parquet", "control_log", "tremor", "grasp", "mapped"]

_DECODERS: dict[TableKind, Callable[[Path, DecodeOptions, str | None], DecodedFile]] = {
    "csv": decode_csv,
    "parquet": decode_parquet,
    "control_log": decode_log,
    "tremor": decode_strivepd,
    "grasp": decode_grasps,
    "mapped": decode_mapped,
}


TABLES: frozenset[str] = frozenset(_DECODERS)
"""Kinds of tables."""


def decode_table(path: Path, kind: str, options: DecodeOptions, name: str | None = None) -> DecodedFile:
    """Decode a table; see `ml.formats.decode`. Raises UndecodableFile."""
    return _DECODERS[cast(TableKind, kind)](path, options, name)


def kind_of_text(path: Source) -> TableKind:
    """Detect the kind of a text table, by its first line or its headers."""
    if is_log(path):
        return "control_log"
    try:
        headers = read_headers(path)
    except UndecodableFile:
        return "csv"
    if looks_like_tremor(headers):
        return "tremor"
    return "grasp" if looks_like_grasps(headers) else "csv"
