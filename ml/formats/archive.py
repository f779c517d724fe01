"""Zip archives from strangers: what they claim is checked before a byte of them is unpacked."""

from __future__ import annotations

import stat
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import IO, Protocol, Self

from ml.formats.options import ArchiveLimits
from ml.formats.recording import UndecodableFile

NESTED = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar", ".bz2", ".xz")
READ_ERRORS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError)
"""What zipfile raises for damaged members, wrong sizes, a password, and (a kind of RuntimeError) a compression that it does not know."""


class Files(Protocol):
    """Named files of one upload: members of an archive or files of a folder. Names use forward slashes and are safe to show."""

    ignored: list[str]

    def names(self) -> list[str]:
        """Names in sorted order."""

    def open(self, name: str) -> IO[bytes]:
        """The file's bytes as a stream."""


@dataclass(slots=True)
class FolderFiles:
    """Files below a folder; links are left out and said."""

    root: Path
    ignored: list[str] = field(default_factory=list)
    _paths: dict[str, Path] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for path in sorted(self.root.rglob("*")):
            name = path.relative_to(self.root).as_posix()
            if path.is_symlink():
                self.ignored.append(f"{name}: a link, not followed")
            elif path.is_file():
                self._paths[name] = path

    def names(self) -> list[str]:
        """Names in sorted order."""
        return sorted(self._paths)

    def open(self, name: str) -> IO[bytes]:
        """The file's bytes as a stream."""
        return self._paths[name].open("rb")


class ZipFiles:
    """Members of a zip archive that are safe to read; use as a context manager.

    Raises:
        UndecodableFile: not a zip, encrypted, larger than the limits, or compressed beyond belief.
    """

    def __init__(self, path: Path, limits: ArchiveLimits) -> None:
        self.ignored: list[str] = []
        self._limits = limits
        self._members: dict[str, zipfile.ZipInfo] = {}
        try:
            self._zip = zipfile.ZipFile(path)
        except READ_ERRORS as error:
            raise UndecodableFile("this is no readable zip archive", "file", "Zip the session folder again and upload that.") from error
        try:
            self._check(self._zip.infolist())
        except BaseException:
            self._zip.close()
            raise

    def _check(self, infos: list[zipfile.ZipInfo]) -> None:
        limits = self._limits
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
        for info in infos:
            self._take(info)

    def _take(self, info: zipfile.ZipInfo) -> None:
        name = info.filename.replace("\\", "/")
        mode = info.external_attr >> 16
        parts = PurePosixPath(name).parts
        if info.is_dir() or name.endswith("/"):
            return
        if name.startswith("/") or ".." in parts or (parts and parts[0].endswith(":")) or any(ord(c) < 32 for c in name):
            self.ignored.append(f"{_safe(name)}: its path leads outside the archive")
        elif stat.S_IFMT(mode) not in (0, stat.S_IFREG):
            self.ignored.append(f"{_safe(name)}: a link or special file, not a file")
        elif info.file_size > self._limits.member_bytes:
            self.ignored.append(f"{_safe(name)}: {info.file_size / 1e6:.0f} MB, larger than {self._limits.member_bytes / 1e6:.0f} MB")
        elif name.lower().endswith(NESTED):
            self.ignored.append(f"{_safe(name)}: an archive inside the archive; unpack it and upload it by itself")
        elif "__MACOSX" in parts or (parts and parts[-1].startswith("._")):
            return
        elif name in self._members:
            self.ignored.append(f"{_safe(name)}: the name stands twice in the archive; the first is used")
        else:
            self._members[name] = info

    def names(self) -> list[str]:
        """Names in sorted order."""
        return sorted(self._members)

    def open(self, name: str) -> IO[bytes]:
        """The member's bytes as a stream. Raises UndecodableFile for a member that cannot be unpacked."""
        try:
            return self._zip.open(self._members[name])
        except READ_ERRORS as error:
            raise UndecodableFile("the archive is damaged here", _safe(name), "Zip the session folder again.") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._zip.close()


def _safe(name: str) -> str:
    """A member name as it may stand in a message."""
    return "".join(c if c.isprintable() else "?" for c in name[-120:])
