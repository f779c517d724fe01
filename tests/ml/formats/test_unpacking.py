"""Gzip and tar around a file or a folder: the same content as without them, within the bounds of archives."""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile

import pytest

from ml.formats import ArchiveLimits, UndecodableFile
from ml.formats.source import InMemory
from ml.formats.unpacking import is_packed, unpack


def tar_of(files: dict[str, bytes], mode: str = "w") -> bytes:
    """Pack files as a tar."""
    sink = io.BytesIO()
    with tarfile.open(fileobj=sink, mode=mode) as archive:  # type: ignore[call-overload]
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return sink.getvalue()


def unpack_bytes(content: bytes, **limits: float) -> tuple[bytes, str, list[str]]:
    """Unpack bytes in memory."""
    sink = io.BytesIO()
    what, ignored = unpack(InMemory(content), sink, ArchiveLimits(**limits))  # type: ignore[arg-type]
    return sink.getvalue(), what, ignored


def test_a_single_file_comes_out_as_it_was() -> None:
    assert unpack_bytes(gzip.compress(b"t_s,beta\n2,1\n")) == (b"t_s,beta\n2,1\n", "a gzip file", [])
    assert unpack_bytes(gzip.compress(b"a") + gzip.compress(b"b"))[0] == b"ab"


@pytest.mark.parametrize("mode", ["w", "w:gz"])
def test_a_folder_comes_out_as_a_zip_of_its_files(mode: str) -> None:
    files = {"Session1/DeviceNPC/StimLog.json": b"[]", "Session1/DeviceNPC/RawDataTD.json": b"[1]" * 50_000}
    packed = tar_of(files, mode)
    assert is_packed(InMemory(packed))
    content, what, ignored = unpack_bytes(packed)
    assert (what, ignored) == ("a tar archive", [])
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == files


def test_links_are_no_files_and_are_counted() -> None:
    sink = io.BytesIO()
    with tarfile.open(fileobj=sink, mode="w") as archive:
        link = tarfile.TarInfo("StimLog.json")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
    content, _, ignored = unpack_bytes(sink.getvalue())
    assert ignored == ["1 file: a link or special file, not a file"]
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert archive.namelist() == []


@pytest.mark.parametrize(
    ("content", "limits", "what"),
    [
        (gzip.compress(bytes(10_000)), {"total_bytes": 9_999}, "more than 0 MB"),
        (gzip.compress(bytes(3_000_000)), {"ratio_applies_above_bytes": 1_000_000}, "more than 200 times"),
        (tar_of({f"{i}.json": b"[]" for i in range(6)}), {"members": 5}, "more than 5 files"),
        (gzip.compress(b"x" * 5000 + bytes(range(256)) * 40)[:-300], {}, "damaged or cut"),
        (tar_of({"a.json": b"x" * 40_000})[:20_000], {}, "damaged or cut"),
    ],
)
def test_what_is_beyond_the_bounds_or_damaged_is_refused(content: bytes, limits: dict[str, float], what: str) -> None:
    with pytest.raises(UndecodableFile, match=what):
        unpack_bytes(content, **limits)


def test_a_zip_and_a_table_are_not_unpacked() -> None:
    assert not is_packed(InMemory(b"PK\x03\x04" + bytes(400)))
    assert not is_packed(InMemory(b"t_s,beta\n"))
