"""Uploads in gzip and tar: the same session as from a zip, with nothing readable left behind."""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile
from typing import Any

import pytest

from tests.app.ingest.conftest import device_zip, steady


def as_tar(archive: bytes, mode: str) -> bytes:
    """Pack the files of a zip as a tar."""
    sink = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as zipped, tarfile.open(fileobj=sink, mode=mode) as tar:  # type: ignore[call-overload]
        for name in zipped.namelist():
            info = tarfile.TarInfo(name)
            info.size = zipped.getinfo(name).file_size
            tar.addfile(info, io.BytesIO(zipped.read(name)))
    return sink.getvalue()


@pytest.mark.parametrize("mode", ["w", "w:gz"])
def test_a_tar_of_a_session_gives_the_session_of_its_zip(send: Any, mode: str) -> None:
    packed = send(("session.tar.gz", as_tar(device_zip(), mode)), visit=1, controller="random")
    assert packed.status_code == 201, packed.text
    assert "a tar archive was unpacked" in packed.text
    zipped = send(("session.zip", device_zip()), visit=1, controller="random")
    assert zipped.json()["sessions"] == packed.json()["sessions"]


def test_a_table_in_gzip_is_the_table(send: Any) -> None:
    answer = send(("t.csv.gz", gzip.compress(steady(1.0))), visit=1, controller="cdbs")
    assert answer.status_code == 201, answer.text
    assert len(answer.json()["sessions"]) == 1


def test_a_7z_archive_is_explained(send: Any) -> None:
    answer = send(("session.7z", b"7z\xbc\xaf\x27\x1c\0\x04" + bytes(24)))
    assert answer.status_code == 422
    assert "this is a 7-Zip archive" in answer.text
    assert "zip the session's folder" in answer.text
