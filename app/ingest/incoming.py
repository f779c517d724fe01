"""What arrives with one upload: single files, and loose files of RC+S folders that belong together."""

from __future__ import annotations

import zipfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import BinaryIO

from app.ingest.formats.log import FileReport
from app.ingest.formats.rcs import KNOWN
from app.platform import files

EPOCH = (1980, 1, 1, 0, 0, 0)
LITTER = frozenset({".ds_store", "thumbs.db", "desktop.ini"})
"""Files that operating systems leave in folders; they hold nothing of a recording."""


@dataclass(frozen=True)
class Incoming:
    """One file as it arrives; `name` may be a path relative to the folder that was dropped."""

    name: str
    stream: BinaryIO


@dataclass(frozen=True)
class Arranged:
    """The files of an upload, loose RC+S files bundled; and reports of what is no file of its own."""

    incoming: list[Incoming]
    asides: list[FileReport] = field(default_factory=list)


def arrange(incoming: Sequence[Incoming]) -> Arranged:
    """Bundle loose RC+S files by folder, each folder into one zip; everything else stays as it is.

    Files without a folder are one RC+S folder together. Two files of one name among them could belong to two sessions, and mixing them
    would give a wrong recording: then none of them is bundled, each is kept by itself, and the report says how to send them.
    """
    arranged = Arranged([])
    loose: dict[str, list[tuple[str, Incoming]]] = defaultdict(list)
    for one in incoming:
        path = PurePosixPath(one.name.replace("\\", "/"))
        stem = KNOWN.get(path.stem.lower()) if path.suffix.lower() == ".json" else None
        if path.name.lower() in LITTER or path.name.startswith("._") or "__MACOSX" in path.parts:
            arranged.asides.append(FileReport(path.name, ignored=["left by the operating system, no recording; not kept"]))
        elif stem is not None:
            loose[str(path.parent)].append((stem, one))
        else:
            arranged.incoming.append(one)
    for folder, members in sorted(loose.items()):
        stems = [stem for stem, _ in members]
        twice = sorted({stem for stem in stems if stems.count(stem) > 1})
        if twice:
            arranged.incoming.extend(one for _, one in members)
            what = f"{', '.join(twice)} came more than once, so that nobody can tell which files belong together; none was put together"
            arranged.asides.append(FileReport("loose RC+S files", flagged=[f"{what}. Drop the folders themselves, or zip each of them."]))
        else:
            arranged.incoming.append(_bundle(folder, members))
    return arranged


def _bundle(folder: str, members: Sequence[tuple[str, Incoming]]) -> Incoming:
    """One zip of loose files: the same files give the same bytes, whatever their order, dates and folder."""
    draft = files.draft_path()
    try:
        with zipfile.ZipFile(draft, "w", zipfile.ZIP_STORED) as archive:
            for stem, one in sorted(members, key=lambda m: m[0]):
                info = zipfile.ZipInfo(f"{stem}.json", EPOCH)
                info.create_system, info.external_attr = 3, 0o100600 << 16
                with archive.open(info, "w", force_zip64=True) as out:
                    while chunk := one.stream.read(files.CHUNK):
                        out.write(chunk)
        stream = draft.open("rb")
    finally:
        draft.unlink(missing_ok=True)  # the open stream keeps the bytes until they are received
    name = PurePosixPath(folder).name or "RC+S files"
    return Incoming(f"{name} ({len(members)} file{'s' if len(members) != 1 else ''} together)", stream)
