"""Unpacking of gzip and tar, within the bounds of archives: a single file as it is, a folder as a zip that the decoders read."""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile
import zlib
from collections import Counter
from contextlib import ExitStack
from typing import IO, BinaryIO, cast

from ml.formats.archive import cleaned_suffix
from ml.formats.options import ArchiveLimits
from ml.formats.recording import UndecodableFile
from ml.formats.source import Source

GZIP = b"\x1f\x8b"
TAR, TAR_AT = b"ustar", 257
CHUNK = 1 << 20
HINT = "Zip the session's folder and upload that. A single report or table needs no archive."
_DAMAGE = (tarfile.TarError, zlib.error, EOFError, OSError, ValueError)
_EPOCH = (1980, 1, 1, 0, 0, 0)


def is_packed(source: Source) -> bool:
    """Decide by its first bytes whether a file is a gzip or a tar."""
    with source.open("rb") as stream:
        head = stream.read(TAR_AT + len(TAR))
    return head.startswith(GZIP) or head.startswith(TAR, TAR_AT)


def unpack(source: Source, sink: BinaryIO, limits: ArchiveLimits) -> tuple[str, list[str]]:
    """Unpack one layer, gzip around tar being one.

    Args:
        source: a gzip or a tar.
        sink: receives the file that was packed, or a zip of the members of a tar. It can be written and sought in.
        limits: bounds of an archive.

    Returns:
        What it was, and sentences on members that were ignored.

    Raises:
        UndecodableFile: damaged, cut, larger than the bounds, or compressed beyond belief.
    """
    with ExitStack() as opened:
        stream = opened.enter_context(source.open("rb"))
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        gzipped = stream.read(len(GZIP)) == GZIP
        stream.seek(0)
        plain = cast("IO[bytes]", opened.enter_context(gzip.GzipFile(fileobj=stream)) if gzipped else stream)
        bounded: io.BufferedReader = io.BufferedReader(_Bounded(plain, size, limits), CHUNK)
        try:
            if bounded.peek(TAR_AT + len(TAR))[TAR_AT:].startswith(TAR):
                return "a tar archive", _members(bounded, sink, limits)
            while chunk := bounded.read(CHUNK):
                sink.write(chunk)
        except _DAMAGE as error:
            raise UndecodableFile("the archive is damaged or cut", "file", f"Pack it again. {HINT}") from error
    return "a gzip file", []


class _Bounded(io.RawIOBase):
    """Unpacked bytes, counted against the bounds as they are read."""

    def __init__(self, stream: IO[bytes], size: int, limits: ArchiveLimits) -> None:
        self._stream, self._size, self._limits, self._total = stream, size, limits, 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview, /) -> int:  # type: ignore[override]
        content = self._stream.read(len(buffer))
        self._total += len(content)
        limits = self._limits
        if self._total > limits.total_bytes:
            what = f"unpacked the archive has more than {limits.total_bytes / 1e6:.0f} MB"
            raise UndecodableFile(what, "archive", "Upload fewer sessions at once.")
        if self._total > limits.ratio_applies_above_bytes and self._total > limits.ratio * max(1, self._size):
            what = f"the archive unpacks to more than {limits.ratio:.0f} times its size"
            raise UndecodableFile(what, "archive", f"Pack the original files again. {HINT}")
        buffer[: len(content)] = content
        return len(content)


def _members(stream: io.BufferedReader, sink: BinaryIO, limits: ArchiveLimits) -> list[str]:
    """Copy the files of a tar into a zip, whose reader checks their paths; list the members that are no files."""
    ignored: Counter[str] = Counter()
    count = 0
    with tarfile.open(fileobj=stream, mode="r|") as tar, zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for member in tar:
            count += 1
            if count > limits.members:
                what = f"the archive holds more than {limits.members} files"
                raise UndecodableFile(what, "archive", "Upload one session folder.")
            content = tar.extractfile(member) if member.isfile() else None
            if content is None:
                ignored["a link or special file, not a file"] += not member.isdir()
            elif member.size > limits.member_bytes:
                ignored[f"larger than {limits.member_bytes / 1e6:.0f} MB{cleaned_suffix(member.name)}"] += 1
            else:
                info = zipfile.ZipInfo(member.name, _EPOCH)
                info.create_system, info.external_attr = 3, 0o100600 << 16
                with archive.open(info, "w", force_zip64=True) as out:
                    while chunk := content.read(CHUNK):
                        out.write(chunk)
    return [f"{n} file{'s' if n > 1 else ''}: {reason}" for reason, n in sorted(ignored.items()) if n]
