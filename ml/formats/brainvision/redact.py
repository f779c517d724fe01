"""Take identity out of a BrainVision recording before it is stored: header and markers are written again from what may stay."""

from __future__ import annotations

import re
import shutil
import zipfile
from pathlib import Path

from ml.formats.archive import Files, ZipFiles, told
from ml.formats.brainvision.files import Head, Marker, Parts, find_parts, read_head, read_markers, read_text
from ml.formats.labs.marks import clean_text
from ml.formats.labs.names import clean_label, clean_unit
from ml.formats.options import ArchiveLimits
from ml.formats.recording import UndecodableFile
from ml.formats.redaction_record import Redaction
from ml.formats.source import Source

EPOCH = (1980, 1, 1, 0, 0, 0)
KINDS = ("Stimulus", "Response", "Comment", "New Segment", "SyncStatus", "Event", "Trigger")
_DATE = re.compile(r"\d{20}")
SEGMENT = "New Segment"


def redact_brainvision(source: Source, target: Path, key: bytes, limits: ArchiveLimits | None = None) -> Redaction:
    """Write the recordings of a zip without identity; the same bytes in give the same bytes out.

    Raises:
        UndecodableFile: no whole recording; nothing is written then.
    """
    done = Redaction()
    with ZipFiles(source, limits or ArchiveLimits()) as files:
        parts = find_parts(files)
        if not parts:
            raise UndecodableFile("no BrainVision recording in here", "archive", "Zip its three files and upload that.")
        texts = []
        for part in parts:
            texts.append(clean_texts(files, part, key, done))
        used = {name for p in parts for name in (p.header, p.samples, p.markers)}
        others = [n for n in files.names() if n not in used]
        done.ignored += told(files.left_out) + ([f"{len(others)} other files of the archive"] if others else [])
        with zipfile.ZipFile(target, "w") as archive:
            for number, (part, (header, text)) in enumerate(zip(parts, texts, strict=True), start=1):
                base = f"recording-{number}"
                archive.writestr(archive_entry(f"{base}.vhdr"), header.format(base=base))
                if text is not None:
                    archive.writestr(archive_entry(f"{base}.vmrk"), text.format(base=base))
                with files.open(part.samples) as stream, archive.open(archive_entry(f"{base}.eeg"), "w", force_zip64=True) as sink:
                    shutil.copyfileobj(stream, sink, 1 << 20)
    done.removed.append("names and paths of files, comments, impedances and settings of the amplifier")
    return done


def clean_texts(files: Files, part: Parts, key: bytes, account: Redaction) -> tuple[str, str | None]:
    """Write header and markers of a recording from what may stay; `{base}` is in the place of its name."""
    head = read_head(read_text(files, part.header))
    markers = read_markers(read_text(files, part.markers)) if part.markers else None
    return _header(head, markers is not None, account), None if markers is None else _markers(markers, key, account)


def archive_entry(name: str) -> zipfile.ZipInfo:
    """Make the entry of a file without a date, so that the same bytes give the same archive."""
    info = zipfile.ZipInfo(name, EPOCH)
    info.create_system, info.external_attr = 3, 0o100600 << 16
    return info


def _header(head: Head, marked: bool, account: Redaction) -> str:
    rows, named = [], 0
    for number, (label, scale, unit) in enumerate(head.channels, start=1):
        name, own = clean_label(label, "", number)
        named += not own
        rows.append(f"Ch{number}={name.replace(',', ' ')},,{scale!r},{clean_unit(unit) or '?'}")
    if named:
        account.removed.append(f"names of channels with words that are not on the lists ({named}×)")
    order = "MULTIPLEXED" if head.alternate else "VECTORIZED"
    lines = ["Brain Vision Data Exchange Header File Version 1.0", "[Common Infos]", "DataFile={base}.eeg"]
    lines += ["MarkerFile={base}.vmrk"] if marked else []
    lines += ["DataFormat=BINARY", f"DataOrientation={order}", f"NumberOfChannels={len(rows)}", f"SamplingInterval={1e6 / head.rate_hz!r}"]
    return "\n".join([*lines, "[Binary Infos]", f"BinaryFormat={head.binary}", "[Channel Infos]", *rows, ""])


def _markers(markers: list[Marker], key: bytes, account: Redaction) -> str:
    rows, words = [], 0
    for number, marker in enumerate(markers, start=1):
        kind = marker.kind if marker.kind in KINDS else "Comment"
        text = "" if kind == SEGMENT else clean_text(marker.text, key)
        words += text != marker.text
        date = f",{marker.date}" if kind == SEGMENT and _DATE.fullmatch(marker.date) else ""
        rows.append(f"Mk{number}={kind},{text},{marker.sample + 1},{marker.length},0{date}")
    if words:
        account.removed.append(f"words of markers: amplitude, rate, pulse width, side, on and off, and numbers stay ({words}×)")
    head = ["Brain Vision Data Exchange Marker File, Version 1.0", "[Common Infos]", "DataFile={base}.eeg", "[Marker Infos]"]
    return "\n".join([*head, *rows, ""])
