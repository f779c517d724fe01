"""Compute steps on the bytes of an uploaded file: identity out, and decoding. They run in a limited child, never in the web process.

The children know no settings and no database: their params have what they need. `reading` in the same folder is their caller's side.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from app.platform.jobs import StepReport
from app.platform.raw_bytes import RawFile
from app.settings import stored_secret
from ml import formats
from ml.formats import OUTCOME_TABLES, ArchiveLimits, DecodeOptions, UndecodableFile, transfer
from ml.formats.archive import reading_of_members
from ml.formats.studies.parts import find_parts
from ml.formats.tables.mapping import TableMapping, find_mapping, preview_of, redact_mapped
from ml.formats.unpacking import is_packed, unpack

MAPPABLE = ("csv", "parquet", *(one.kind for one in OUTCOME_TABLES))
"""Kinds of files that a column mapping may read."""


def clean(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Take identity out of a file.

    Args:
        params: `source` and an empty `room` to unpack it into, each as the two paths of a `RawFile`. Also `target` (path), `secrets` (the
            folder of keys), `options`, and `mappings`, the study's column mappings.
        workdir: not used.
        report: takes the share that was read.

    Returns:
        `kind`, `redaction`, and `mapping`, the place of the column mapping that read it; or the `problem` that keeps it from being cleaned,
        what was `left_out` of its archive, if it is one, and the `preview` of a table.
    """
    source, room = (RawFile(Path(params[name][0]), Path(params[name][1])) for name in ("source", "room"))
    target = Path(params["target"])
    options = options_of(params["options"])
    key = stored_secret(Path(params["secrets"]), "pseudonyms")
    mappings = [TableMapping.from_json(m) for m in params["mappings"]]
    kind: formats.FileKind | None = None
    mapping: int | None = None
    unpacked: list[str] = []
    ignored: list[str] = []
    try:
        if is_packed(source):
            with room.open_for_writing() as sink:
                what, ignored = unpack(source, sink, options.archive)
            source, unpacked = room, [f"{what} was unpacked"]
        kind = formats.sniff(source)
        mapping = find_mapping(source, mappings, key) if kind in MAPPABLE else None
        with reading_of_members(_told(report, "taking identity out")):
            if mapping is None:
                redaction = formats.redact(source, target, kind, key, options)
            else:
                kind = mappings[mapping].kind
                redaction = redact_mapped(source, target, mappings[mapping], key, options)
    except UndecodableFile as error:
        preview = preview_of(source, key) if mapping is not None or kind in MAPPABLE else None
        return {"problem": error.args_of(), "left_out": formats.left_out_of(source, options.archive), "preview": preview}
    redaction.repaired[:0], redaction.ignored[:0] = unpacked, ignored
    return {"kind": kind, "redaction": asdict(redaction), "mapping": mapping}


def parts(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Take a file apart that holds several.

    Args:
        params: `source` and an empty `room`, each as the two paths of a `RawFile`; `archive`, bounds of an archive.
        workdir: not used.
        report: takes the share that was read.

    Returns:
        `names` of the members of the zip in the room, and what was `ignored`; or the `problem` that keeps it from being taken apart.
    """
    source, room = (RawFile(Path(params[name][0]), Path(params[name][1])) for name in ("source", "room"))
    try:
        with reading_of_members(_told(report, "taking files apart")), room.open_for_writing() as sink:
            return asdict(find_parts(source, sink, ArchiveLimits(**params["archive"])))
    except UndecodableFile as error:
        return {"problem": error.args_of()}


def decode(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Decode a file without identity.

    Args:
        params: `source` (path), `kind`, `name`, `options`, and `target`, the folder into which `transfer` writes what came of it.
        workdir: not used.
        report: takes the share that was read.

    Returns:
        Nothing, or the `problem` that keeps it from being decoded.
    """
    try:
        with reading_of_members(_told(report, "decoding")):
            decoded = formats.decode(Path(params["source"]), params["kind"], options_of(params["options"]), name=params["name"])
        transfer.write(decoded, Path(params["target"]))
    except UndecodableFile as error:
        return {"problem": error.args_of()}
    return {}


def prepare() -> None:
    """Decode an example of each kind, so that the process whose forks decode files has loaded all that they need."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "example", Path(folder) / "clean"
        for one in formats.DEVICES:
            if one.code.example is not None:
                one.code.example(source)
                formats.redact(source, target, one.kind, bytes(32))
                transfer.write(formats.decode(target, one.kind), Path(folder))
        source.write_text("t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,1\n" for k in range(5)))
        formats.redact(source, target, formats.sniff(source), bytes(32))


def options_of(stated: dict[str, Any]) -> DecodeOptions:
    """Read the options that params have as JSON."""
    return DecodeOptions(**{**stated, "archive": ArchiveLimits(**stated["archive"])})


def _told(report: StepReport, doing: str) -> Callable[[float], None]:
    return lambda share: report.progress(share, doing)
