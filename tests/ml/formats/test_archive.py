from __future__ import annotations

import bz2
import gzip
import io
import lzma
import stat
import struct
import tarfile
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ml.formats import ArchiveLimits, DecodeOptions, UndecodableFile, decode, redact, sniff
from ml.formats.archive import FolderFiles, ZipFiles


def members(path, **limits):
    with ZipFiles(path, ArchiveLimits(**limits)) as files:
        return files.names(), [str(f) for f in files.left_out]


def test_paths_that_lead_out_are_ignored_and_said(pack):
    names, ignored = members(
        pack({"../evil.json": "1", "/etc/passwd.json": "1", "C:\\x.json": "1", "a/../../b.json": "1", "ok/StimLog.json": "[]"})
    )
    assert names == ["ok/StimLog.json"]
    assert len(ignored) == 4


def test_links_and_archives_inside_are_ignored_and_said(tmp_path):
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w") as archive:
        link = zipfile.ZipInfo("StimLog.json")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "/etc/passwd")
        archive.writestr("inner.zip", b"PK")
        archive.writestr("__MACOSX/._a", b"")
        archive.writestr("EventLog.json", "[]")
    names, ignored = members(path)
    assert names == ["EventLog.json"]
    assert any("a link" in text for text in ignored)
    assert any("archive inside" in text for text in ignored)


def test_links_in_a_folder_are_not_followed(tmp_path):
    secret = tmp_path / "secret.json"
    secret.write_text("[]")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "StimLog.json").symlink_to(secret)
    files = FolderFiles(folder)
    assert files.names() == []
    assert "not followed" in files.left_out[0].reason


def test_an_encrypted_archive_is_refused(pack):
    path = pack({"StimLog.json": "[]"})
    raw = bytearray(path.read_bytes())
    central = raw.find(b"PK\x01\x02")
    raw[6] |= 1
    raw[central + 8] |= 1
    path.write_bytes(raw)
    with pytest.raises(UndecodableFile, match="encrypted"):
        decode(path)


def test_a_bomb_is_refused_without_unpacking_it(pack):
    path = pack({"RawDataTD.json": b"0" * 60_000_000})
    tracemalloc.start()
    with pytest.raises(UndecodableFile, match="times its size"):
        decode(path)
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_a_claim_of_more_bytes_than_allowed_is_refused_at_its_word(pack):
    path = pack({"RawDataTD.json": "[]"})
    raw = bytearray(path.read_bytes())
    central = raw.find(b"PK\x01\x02")
    raw[central + 24 : central + 28] = struct.pack("<I", 4_000_000_000)
    path.write_bytes(raw)
    with pytest.raises(UndecodableFile, match="4000 MB"):
        decode(path)


def test_a_claim_of_ten_gigabytes_is_refused_at_its_word(tmp_path):
    path = tmp_path / "x.zip"
    info = zipfile.ZipInfo("RawDataTD.json")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(info, "[]")
        info.file_size = 10 * 10**9  # written into the directory as ZIP64
    with pytest.raises(UndecodableFile, match="10000 MB"):
        decode(path)


@pytest.mark.parametrize("claimed", [1, 100, 5_000])
def test_a_member_that_claims_less_than_it_holds_never_gives_more_than_it_claims(rcs, pack, claimed):
    path = pack({"d/RawDataTD.json": rcs.time_domain(np.full(50_000, 0.01)), "d/StimLog.json": rcs.stim((0, rcs.program(1.0)))})
    raw = bytearray(path.read_bytes())
    for mark, at in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        place = raw.find(mark)
        raw[place + at : place + at + 4] = struct.pack("<I", claimed)
    path.write_bytes(raw)
    decoded = decode(path)
    assert any(r.name == "StimLog.json" and r.understood for r in decoded.reports)
    about = next(r for r in decoded.reports if r.name == "RawDataTD.json")
    assert about.repaired or about.problem or about.flagged


def test_one_file_larger_than_the_limit_costs_only_itself(pack):
    names, ignored = members(pack({"RawDataTD.json": "[" + "1," * 2000 + "1]", "StimLog.json": "[]"}), member_bytes=1000)
    assert names == ["StimLog.json"]
    assert "larger than" in ignored[0]


def test_too_many_members_are_refused(pack):
    with pytest.raises(UndecodableFile, match="holds 6 files"):
        members(pack({f"{i}.json": "" for i in range(6)}), members=5)


@pytest.mark.parametrize("share", [0.05, 0.4, 0.9])
def test_a_cut_archive_is_refused(pack, share):
    path = pack({"StimLog.json": "[]" * 500, "EventLog.json": "[]"})
    raw = path.read_bytes()
    path.write_bytes(raw[: int(share * len(raw))])
    with pytest.raises(UndecodableFile, match="no readable zip"):
        decode(path, "rcs")


def test_damage_inside_one_member_leaves_the_others(rcs, pack):
    path = pack({"d/EventLog.json": [rcs.note(1.0, "x")] * 50, "d/StimLog.json": rcs.stim((0, rcs.program(1.0)))})
    raw = bytearray(path.read_bytes())
    start = raw.find(b"EventLog.json") + 40
    raw[start : start + 20] = b"\xff" * 20
    path.write_bytes(raw)
    decoded = decode(path, options=DecodeOptions())
    assert any(r.name == "StimLog.json" and r.understood for r in decoded.reports)
    about = next(r for r in decoded.reports if r.name == "EventLog.json")
    assert about.repaired or about.problem


def test_an_archive_of_archives_says_what_to_do(tmp_path):
    path = tmp_path / "visit.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("Ada Lovelace/Ada 1.zip", b"PK")
        archive.writestr("Ada Lovelace/Ada 2.zip", b"PK")
    with pytest.raises(UndecodableFile) as refused:
        redact(path, tmp_path / "clean.zip", "rcs", b"a key of the clinic's own")
    assert refused.value.hint.startswith("It holds 2 other archives, which are not opened: unpack it and upload what is inside.")
    assert "Ada" not in str(refused.value)


def tar_archive(mode: str) -> bytes:
    sink = io.BytesIO()
    with tarfile.open(fileobj=sink, mode=mode) as archive:  # type: ignore[call-overload]
        archive.addfile(tarfile.TarInfo("RawDataTD.json"))
    return sink.getvalue()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("gzip", gzip.compress(b"[]")),
        ("gzip", tar_archive("w:gz")),
        ("bzip2", bz2.compress(b"[]")),
        ("xz", lzma.compress(b"[]")),
        ("tar", tar_archive("w")),
        ("7-Zip", b"7z\xbc\xaf\x27\x1c\0\x04" + bytes(24)),
        ("RAR", b"Rar!\x1a\x07\x01\0" + bytes(24)),
    ],
)
def test_an_archive_that_is_not_unpacked_is_named_with_what_to_do(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / "session").write_bytes(content)
    with pytest.raises(UndecodableFile, match=f"this is a {name} archive") as refused:
        sniff(tmp_path / "session")
    assert "zip the session's folder" in refused.value.hint
