"""Compute steps on the bytes of an uploaded file: identity out, and decoding. They run in a limited child, never in the web process.

The children know no settings and no database: their params have what they need. `reading` in the same folder is their caller's side.
"""

from __future__ import annotations

import tempfile
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from app.platform.jobs import StepReport
from app.platform.raw_bytes import RawFile
from app.settings import stored_secret
from ml import formats
from ml.formats import transfer
from ml.formats.archive import ZipFiles, reading_of_members
from ml.formats.options import ArchiveLimits, DecodeOptions
from ml.formats.rcs import find_sessions
from ml.formats.recording import FileReport, UndecodableFile
from ml.formats.tables.mapping import TableMapping, find_mapping, preview_of, redact_mapped

EXAMPLE = """[{"RecordInfo":{"DeviceId":"E","HostUnixTime":1700000000000,"SessionId":"1700000000000"},"TimeDomainData":[%s]}]"""
PACKET = (
    '{"Header":{"dataSize":100,"dataType":1,"dataTypeSequence":%d,"globalSequence":%d,"info":0,"systemTick":%d,"timestamp":{"seconds":%d},'
    '"user1":1,"user2":1},"PacketGenTime":%d,"PacketRxUnixTime":%d,"ChannelSamples":[{"Key":0,"Value":[%s]}],"DebugInfo":0,'
    '"EvokedMarker":[],"IncludedChannels":1,"SampleRate":1,"Units":"millivolts"}'
)


MAPPABLE = ("csv", "parquet", "tremor", "grasp")
"""Kinds of files that a column mapping may read."""


def clean(params: dict[str, Any], workdir: Path, report: StepReport) -> dict[str, Any]:
    """Take identity out of a file.

    Args:
        params: `source` and `key` (paths of a `RawFile`), `target` (path), `secrets` (the folder of keys), `options`, `mappings` (the
            study's column mappings).
        workdir: not used.
        report: takes the share that was read.

    Returns:
        `kind`, `redaction`, and `mapping`, the place of the column mapping that read it; or the `problem` that keeps it from being cleaned,
        what was `left_out` of its archive, if it is one, and the `preview` of a table.
    """
    source, target = RawFile(Path(params["source"]), Path(params["key"])), Path(params["target"])
    options = options_of(params["options"])
    key = stored_secret(Path(params["secrets"]), "pseudonyms")
    mappings = [TableMapping.from_json(m) for m in params["mappings"]]
    kind: formats.FileKind | None = None
    mapping: int | None = None
    try:
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
        return {"problem": error.args_of(), "left_out": _left_out(source, options.archive), "preview": preview}
    return {"kind": kind, "redaction": asdict(redaction), "mapping": mapping}


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
    """Decode an example, so that the process whose forks decode files has loaded all that they need."""
    packets = ",".join(
        PACKET % (i, i, 1000 * i, 700_000_000 + i // 10, 1_700_000_000_000 + 100 * i, 1_700_000_000_000 + 100 * i, ",".join(["0.5"] * 50))
        for i in range(80)
    )
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "example.zip", Path(folder) / "clean.zip"
        with zipfile.ZipFile(source, "w") as archive:
            archive.writestr("RawDataTD.json", EXAMPLE % packets)
        formats.redact(source, target, "rcs", bytes(32))
        transfer.write(formats.decode(target, "rcs"), Path(folder))
        table = Path(folder) / "example.csv"
        table.write_text("t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,1\n" for k in range(5)))
        formats.redact(table, Path(folder) / "clean.csv", formats.sniff(table), bytes(32))


def options_of(stated: dict[str, Any]) -> DecodeOptions:
    """Read the options that params have as JSON."""
    return DecodeOptions(**{**stated, "archive": ArchiveLimits(**stated["archive"])})


def _told(report: StepReport, doing: str) -> Callable[[float], None]:
    return lambda share: report.progress(share, doing)


def _left_out(source: RawFile, limits: ArchiveLimits) -> list[str]:
    """Count the reasons why members of an archive of no use were ignored, without their names, which may identify a person."""
    with source.open() as stream:
        if not zipfile.is_zipfile(stream):
            return []
    listing = FileReport("archive")
    try:
        with ZipFiles(source, limits) as members:
            find_sessions(members, listing)
            reasons = Counter(member.reason for member in members.left_out)
    except UndecodableFile:
        return []  # the problem itself says what is wrong with the archive
    return [*listing.ignored, *(f"{n} file{'s' if n > 1 else ''}: {reason}" for reason, n in sorted(reasons.items()))]
