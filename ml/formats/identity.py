"""Identity out of uploaded files: each kind by its own rules, before anything is decoded or stored. No database and no network in here."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ml.formats.options import DecodeOptions
from ml.formats.percept import redact_percept
from ml.formats.rcs import redact_rcs_zip
from ml.formats.redaction_record import Redaction
from ml.formats.source import Source
from ml.formats.tables import redact_table

if TYPE_CHECKING:
    from ml.formats import FileKind


def redact(source: Source, target: Path, kind: FileKind, key: bytes, options: DecodeOptions | None = None) -> Redaction:
    """Write a file without identity; the same bytes in give the same bytes out, and they decode to the same content.

    Args:
        source: the uploaded file.
        target: where the redacted file is written.
        kind: what it is, from `sniff`.
        key: secret of the installation for pseudonyms of devices, at least 16 bytes.
        options: choices of the decoder, which checks tables as the sender wrote them.

    Raises:
        UndecodableFile: it cannot be parsed, and so not be cleaned; nothing is written then.
        ValueError: a table that a column mapping reads; `tables.mapping.redact_mapped` cleans it.
    """
    if kind == "mapped":
        raise ValueError("a table that a column mapping reads is cleaned by that mapping")
    options = options or DecodeOptions()
    if kind == "rcs":
        return redact_rcs_zip(source, target, key, options.archive)
    if kind == "percept":
        return redact_percept(source, target, key, options.archive)
    return redact_table(source, target, kind, options)
