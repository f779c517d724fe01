"""Zip archives from strangers: what they claim is checked before a byte of them is unpacked."""

from __future__ import annotations

import io
import stat
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import IO, Protocol, Self

from ml.formats.options import ArchiveLimits
from ml.formats.recording import UndecodableFile
from ml.formats.source import Source

NESTED = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar", ".bz2", ".xz")
SUFFIXES = frozenset({".json", ".csv", ".parquet", ".txt", ".tsv", ".xml", ".pdf", ".png", ".jpg", ".mat", ".edf", ".exe", *NESTED})
"""Endings that a report may show; any other might be a part of a name."""
READ_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError)
"""What zipfile raises for damaged members, wrong sizes, a password, and (a kind of RuntimeError) a compression that it does not know."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A file that is not read: its place in the archive's list, from 1, its ending and the reason. Its name may be a person's and is
    omitted."""

    number: int
    suffix: str
    reason: str

    def __str__(self) -> str:
        return f"{numbered(self.number, self.suffix)}: {self.reason}"


def numbered(number: int, suffix: str) -> str:
    """Name a member of an archive as a report may call it."""
    return f"member {number}{f' ({suffix})' if suffix else ''}"


def cleaned_suffix(name: str) -> str:
    """Return the ending of a file's name where it is a known one, in lower case. Else return nothing, since it may be a part of a name."""
    suffix = PurePosixPath(name.replace("\\", "/")).suffix.lower()
    return suffix if suffix in SUFFIXES else ""


INSIDE = "an archive inside the archive; unpack it and upload it by itself"


def hint_of(left_out: Sequence[LeftOut], hint: str) -> str:
    """Describe what to do about an archive without anything of use: archives inside it come first."""
    inside = sum(one.reason == INSIDE for one in left_out)
    several = f"{inside} other archives, which are" if inside > 1 else "another archive, which is"
    return f"It holds {several} not opened: unpack it and upload what is inside. {hint}" if inside else hint


def told(left_out: Sequence[LeftOut], most: int = 5) -> list[str]:
    """Describe ignored members in sentences: members of one ending and one reason are one sentence with their count."""
    groups: dict[tuple[str, str], list[int]] = defaultdict(list)
    for one in left_out:
        groups[one.suffix, one.reason].append(one.number)
    said = []
    for (suffix, reason), numbers in groups.items():
        if len(numbers) == 1:
            said.append(f"{numbered(numbers[0], suffix)}: {reason}")
            continue
        listed = ", ".join(map(str, numbers[:most])) + (", …" if len(numbers) > most else "")
        said.append(f"{len(numbers)} members ({f'{suffix}, ' if suffix else ''}number {listed}): {reason}")
    return said


_watcher: ContextVar[Callable[[float], None] | None] = ContextVar("watcher", default=None)


@contextmanager
def reading_of_members(watch: Callable[[float], None]) -> Iterator[None]:
    """Report to `watch`, while archives are read inside the context, which share of their unpacked bytes was read, 0 to 1."""
    token = _watcher.set(watch)
    try:
        yield
    finally:
        _watcher.reset(token)


class _Watched(io.BufferedIOBase):
    """A member's bytes, counted as they are read."""

    def __init__(self, stream: IO[bytes], count: Callable[[int], None]) -> None:
        self._stream, self._count = stream, count

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes from the stream and count them."""
        found = self._stream.read(-1 if size is None else size)
        self._count(len(found))
        return found

    def readable(self) -> bool:
        """Return True: it can be read."""
        return True

    def close(self) -> None:
        """Close the stream too."""
        self._stream.close()
        super().close()


class Files(Protocol):
    """Named files of one upload: members of an archive or files of a folder. Names use forward slashes; no report shows them."""

    left_out: list[LeftOut]

    def names(self) -> list[str]:
        """List names in sorted order."""

    def open(self, name: str) -> IO[bytes]:
        """Open the file's bytes as a stream."""


@dataclass(slots=True)
class FolderFiles:
    """Files below a folder; links are ignored and reported."""

    root: Path
    left_out: list[LeftOut] = field(default_factory=list)
    _paths: dict[str, Path] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for number, path in enumerate(sorted(self.root.rglob("*")), start=1):
            name = path.relative_to(self.root).as_posix()
            if path.is_symlink():
                self.left_out.append(LeftOut(number, cleaned_suffix(name), "a link, not followed"))
            elif path.is_file():
                self._paths[name] = path

    def names(self) -> list[str]:
        """List names in sorted order."""
        return sorted(self._paths)

    def open(self, name: str) -> IO[bytes]:
        """Open the file's bytes as a stream."""
        return self._paths[name].open("rb")


class ZipFiles:
    """Members of a zip archive that are safe to read; use as a context manager.

    Raises:
        UndecodableFile: not a zip, encrypted, larger than the limits, or compressed beyond belief.
    """

    def __init__(self, path: Source, limits: ArchiveLimits) -> None:
        self.left_out: list[LeftOut] = []
        self._limits = limits
        self._members: dict[str, zipfile.ZipInfo] = {}
        self._number: dict[str, int] = {}
        self._bytes = self._read = 0
        self._open = ExitStack()
        with ExitStack() as opened:
            stream = opened.enter_context(path.open("rb"))
            try:
                self._zip = opened.enter_context(zipfile.ZipFile(stream))
            except READ_ERRORS as error:
                raise UndecodableFile("this is no readable zip archive", "file", "Zip the session folder again and upload that.") from error
            self._check(self._zip.infolist())
            self._open = opened.pop_all()

    def _check(self, infos: list[zipfile.ZipInfo]) -> None:
        limits = self._limits
        if not infos:
            raise UndecodableFile("the archive is empty", "archive", "Zip the folder again, with its files, and upload that.")
        if len(infos) > limits.members:
            raise UndecodableFile(
                f"the archive holds {len(infos)} files, more than {limits.members}", "archive", "Upload one session folder."
            )
        if any(info.flag_bits & 0x1 for info in infos):
            raise UndecodableFile("the archive is encrypted", "archive", "Unpack it with its password and zip the folder without one.")
        total = sum(info.file_size for info in infos)
        packed = max(1, sum(info.compress_size for info in infos))
        if total > limits.total_bytes:
            raise UndecodableFile(
                f"unpacked the archive would have {total / 1e6:.0f} MB, more than {limits.total_bytes / 1e6:.0f} MB",
                "archive",
                "Upload fewer sessions at once.",
            )
        if total > limits.ratio_applies_above_bytes and total / packed > limits.ratio:
            raise UndecodableFile(
                f"the archive claims to unpack to {total / packed:.0f} times its size", "archive", "Zip the original session folder again."
            )
        for number, info in enumerate(infos, start=1):
            self._take(number, info)
        self._bytes = sum(info.file_size for info in self._members.values())

    def _take(self, number: int, info: zipfile.ZipInfo) -> None:
        name = info.filename.replace("\\", "/")
        mode = info.external_attr >> 16
        parts, suffix = PurePosixPath(name).parts, cleaned_suffix(name)
        if info.is_dir() or name.endswith("/"):
            return
        if name.startswith("/") or ".." in parts or (parts and parts[0].endswith(":")) or any(ord(c) < 32 for c in name):
            self.left_out.append(LeftOut(number, suffix, "its path leads outside the archive"))
        elif stat.S_IFMT(mode) not in (0, stat.S_IFREG):
            self.left_out.append(LeftOut(number, suffix, "a link or special file, not a file"))
        elif info.file_size > self._limits.member_bytes:
            self.left_out.append(
                LeftOut(number, suffix, f"{info.file_size / 1e6:.0f} MB, larger than {self._limits.member_bytes / 1e6:.0f} MB")
            )
        elif name.lower().endswith(NESTED):
            self.left_out.append(LeftOut(number, suffix, INSIDE))
        elif "__MACOSX" in parts or (parts and parts[-1].startswith("._")):
            return
        elif name in self._members:
            self.left_out.append(LeftOut(number, suffix, "the name stands twice in the archive; the first is used"))
        else:
            self._members[name], self._number[name] = info, number

    def names(self) -> list[str]:
        """List names in sorted order."""
        return sorted(self._members)

    def open(self, name: str) -> IO[bytes]:
        """Open the member's bytes as a stream. Raises UndecodableFile for a member that cannot be unpacked."""
        try:
            stream = self._zip.open(self._members[name])
        except READ_ERRORS as error:
            where = numbered(self._number[name], cleaned_suffix(name))
            raise UndecodableFile("the archive is damaged here", where, "Zip the session folder again.") from error
        watch = _watcher.get()
        return stream if watch is None else _Watched(stream, lambda size: self._tell(watch, size))  # type: ignore[return-value]

    def _tell(self, watch: Callable[[float], None], size: int) -> None:
        self._read += size
        watch(min(1.0, self._read / max(1, self._bytes)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._open.close()
