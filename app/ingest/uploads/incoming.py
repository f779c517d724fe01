"""Files that arrive with one upload: single files, and loose files of a device's folder that belong together."""

from __future__ import annotations

import hashlib
import zipfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import BinaryIO

from app.platform import files
from app.platform.raw_bytes import raw_file
from ml.formats import DEVICES, FileReport
from ml.formats.loose import MIXED, LooseFiles, Opening, group

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


@dataclass(frozen=True)
class _Loose:
    """A loose file of a recording: which one, as the format names it."""

    stem: str
    one: Incoming
    opening: Opening

    @property
    def shown(self) -> str:
        """Its name without folders."""
        return PurePosixPath(self.one.name.replace("\\", "/")).name


def arrange(incoming: Sequence[Incoming]) -> Arranged:
    """Bundle loose files of a device by folder, implant and session, each recording into one zip; everything else stays as it is.

    Files without a folder are one folder together. A file is known by its name, else by its content. Two different files of one kind in one
    recording could belong to two, and mixing them would give a wrong recording. Then none of them is bundled, each is stored alone, and the
    report explains how to send them.
    """
    arranged = Arranged([])
    formats = [one.code.loose for one in DEVICES if one.code.loose is not None]
    folders: dict[tuple[int, str], list[_Loose]] = defaultdict(list)
    for one in incoming:
        path = PurePosixPath(one.name.replace("\\", "/"))
        if path.name.lower() in LITTER or path.name.startswith("._") or "__MACOSX" in path.parts:
            arranged.asides.append(FileReport(path.name, ignored=["left by the operating system, no recording; not kept"]))
            continue
        for number, loose in enumerate(formats):
            opening = loose.read(path.name, one.stream.read(loose.head))
            one.stream.seek(0)
            if opening.stem is not None:
                folders[number, str(path.parent)].append(_Loose(opening.stem, one, opening))
                break
        else:
            arranged.incoming.append(one)
    for (place, folder), members in sorted(folders.items()):
        loose = formats[place]
        groups = group([m.opening for m in members])
        if groups.homeless:
            said = "empty, and does not say which of the recordings beside it it belongs to; not kept"
            arranged.asides.extend(FileReport(members[i].shown, ignored=[said]) for i in groups.homeless)
        several = len(groups.recordings) > 1
        if several:
            arranged.asides.append(FileReport(f"loose {loose.name}", flagged=[f"{MIXED.format(len(groups.recordings))}."]))
        for number, places in enumerate(groups.recordings, start=1):
            _put_together(loose, folder, f" {number}" if several else "", [members[i] for i in places], arranged)
    return arranged


def _put_together(loose: LooseFiles, folder: str, number: str, members: Sequence[_Loose], arranged: Arranged) -> None:
    """Bundle the files of one recording, the same bytes once; leave them single, and say so, where two of a kind differ."""
    chosen: dict[str, _Loose] = {}
    again: list[_Loose] = []
    twice: set[str] = set()
    for member in sorted(members, key=lambda m: m.one.name):
        first = chosen.setdefault(member.stem, member)
        if first is not member and _digest(first.one) == _digest(member.one):
            again.append(member)
        elif first is not member:
            twice.add(member.stem)
    arranged.asides.extend(FileReport(m.shown, ignored=["the same bytes came twice in this upload; counted once"]) for m in again)
    if twice:
        arranged.incoming.extend(m.one for m in members if m not in again)
        what = f"{', '.join(sorted(twice))} came more than once, so that nobody can tell which files belong together; none was put together"
        arranged.asides.append(FileReport(f"loose {loose.name}", flagged=[f"{what}. Drop the folders themselves, or zip each of them."]))
    else:
        arranged.incoming.append(_bundle(loose, folder, number, [(stem, m.one) for stem, m in chosen.items()]))


def _digest(one: Incoming) -> str:
    """Hash a file's bytes and rewind it."""
    found = hashlib.sha256()
    while chunk := one.stream.read(files.CHUNK):
        found.update(chunk)
    one.stream.seek(0)
    return found.hexdigest()


def _bundle(loose: LooseFiles, folder: str, number: str, members: Sequence[tuple[str, Incoming]]) -> Incoming:
    """Bundle loose files in one zip: the same files give the same bytes, whatever their order, dates and folder."""
    with raw_file() as (sink, raw):
        with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
            for stem, one in sorted(members, key=lambda m: m[0]):
                info = zipfile.ZipInfo(f"{stem}.json", EPOCH)
                info.create_system, info.external_attr = 3, 0o100600 << 16
                with archive.open(info, "w", force_zip64=True) as out:
                    while chunk := one.stream.read(files.CHUNK):
                        out.write(chunk)
        stream = raw.open()  # keeps the bytes until they are received
    name = PurePosixPath(folder).name or loose.name
    return Incoming(f"{name}{number} ({len(members)} file{'s' if len(members) != 1 else ''} together)", stream)
