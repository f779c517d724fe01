"""Files that arrive with one upload: single files, and loose files of RC+S folders that belong together."""

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
from ml.formats.rcs.folder import KNOWN, MIXED
from ml.formats.rcs.opening import HEAD, Opening, group, read_opening, stem_in_name
from ml.formats.recording import FileReport

EPOCH = (1980, 1, 1, 0, 0, 0)
LITTER = frozenset({".ds_store", "thumbs.db", "desktop.ini"})
"""Files that operating systems leave in folders; they hold nothing of a recording."""

LOOSE = "loose RC+S files"


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
    """A loose file that belongs to an RC+S session."""

    stem: str
    one: Incoming
    opening: Opening

    @property
    def shown(self) -> str:
        """Its name without folders."""
        return PurePosixPath(self.one.name.replace("\\", "/")).name


def arrange(incoming: Sequence[Incoming]) -> Arranged:
    """Bundle loose RC+S files by folder, implant and session, each recording into one zip; everything else stays as it is.

    Files without a folder are one folder together. A file is known by its name, else by its content. Two different files of one kind in one
    recording could belong to two, and mixing them would give a wrong recording. Then none of them is bundled, each is stored alone, and the
    report explains how to send them.
    """
    arranged = Arranged([])
    folders: dict[str, list[_Loose]] = defaultdict(list)
    for one in incoming:
        path = PurePosixPath(one.name.replace("\\", "/"))
        if path.name.lower() in LITTER or path.name.startswith("._") or "__MACOSX" in path.parts:
            arranged.asides.append(FileReport(path.name, ignored=["left by the operating system, no recording; not kept"]))
            continue
        opening = read_opening(one.stream.read(HEAD))
        one.stream.seek(0)
        stem = _stem(path, opening)
        if stem is None:
            arranged.incoming.append(one)
        else:
            folders[str(path.parent)].append(_Loose(stem, one, opening))
    for folder, members in sorted(folders.items()):
        groups = group([m.opening for m in members])
        if groups.homeless:
            said = "empty, and does not say which of the recordings beside it it belongs to; not kept"
            arranged.asides.extend(FileReport(members[i].shown, ignored=[said]) for i in groups.homeless)
        several = len(groups.recordings) > 1
        if several:
            arranged.asides.append(FileReport(LOOSE, flagged=[f"{MIXED.format(len(groups.recordings))}."]))
        for number, places in enumerate(groups.recordings, start=1):
            _put_together(folder, f" {number}" if several else "", [members[i] for i in places], arranged)
    return arranged


def _stem(path: PurePosixPath, opening: Opening) -> str | None:
    """Find which file of a session a loose file is: by its name or its content. Where that is empty or damaged, the beginning of its name
    decides."""
    if path.suffix.lower() == ".json" and (stem := KNOWN.get(path.stem.lower())) is not None:
        return stem
    return opening.stem or (stem_in_name(path.name) if path.suffix.lower() == ".json" else None)


def _put_together(folder: str, number: str, members: Sequence[_Loose], arranged: Arranged) -> None:
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
        arranged.asides.append(FileReport(LOOSE, flagged=[f"{what}. Drop the folders themselves, or zip each of them."]))
    else:
        arranged.incoming.append(_bundle(folder, number, [(stem, m.one) for stem, m in chosen.items()]))


def _digest(one: Incoming) -> str:
    """Hash a file's bytes and rewind it."""
    found = hashlib.sha256()
    while chunk := one.stream.read(files.CHUNK):
        found.update(chunk)
    one.stream.seek(0)
    return found.hexdigest()


def _bundle(folder: str, number: str, members: Sequence[tuple[str, Incoming]]) -> Incoming:
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
    name = PurePosixPath(folder).name or "RC+S files"
    return Incoming(f"{name}{number} ({len(members)} file{'s' if len(members) != 1 else ''} together)", stream)
