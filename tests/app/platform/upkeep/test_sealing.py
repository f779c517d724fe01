"""Sealed streams: what comes out is what went in, and whatever was done to a file between is noticed."""

from __future__ import annotations

import io
import secrets

import pytest

from app.platform.upkeep.sealing import CHUNK, MAGIC, NotOpened, SealedReader, SealedWriter, opened

KEY = bytes(range(32))
HEAD = len(MAGIC) + 7


def sealed(content: bytes) -> bytes:
    out = io.BytesIO()
    writer = SealedWriter(out, KEY)
    for start in range(0, len(content), 300_000):
        writer.write(content[start : start + 300_000])
    writer.close()
    return out.getvalue()


@pytest.mark.parametrize("size", [0, 1, CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK, 3 * CHUNK + 17])
def test_what_comes_out_is_what_went_in(size: int) -> None:
    content = secrets.token_bytes(size)
    closed = sealed(content)
    assert b"".join(opened(io.BytesIO(closed), KEY)) == content
    assert io.BufferedReader(SealedReader(io.BytesIO(closed), KEY)).read() == content
    assert size < 100 or content[:50] not in closed


def test_two_files_of_the_same_bytes_differ() -> None:
    assert sealed(b"the same") != sealed(b"the same")


def _damaged() -> dict[str, bytes]:
    whole = sealed(secrets.token_bytes(3 * CHUNK))
    step = CHUNK + 16
    first, second, third = (whole[HEAD + i * step : HEAD + (i + 1) * step] for i in range(3))
    return {
        "one bit": whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:],
        "cut within a chunk": whole[:-100],
        "cut between chunks": whole[:HEAD] + first + second,
        "without a chunk": whole[:HEAD] + first + third,
        "exchanged": whole[:HEAD] + second + first + third,
        "longer": whole + third,
        "another prefix": whole[: HEAD - 1] + b"?" + whole[HEAD:],
        "no sealed file": b"PK" + whole[2:],
        "empty": b"",
        "head alone": whole[:HEAD],
    }


@pytest.mark.parametrize("kind", list(_damaged()))
def test_whatever_was_done_to_it_is_noticed(kind: str) -> None:
    with pytest.raises(NotOpened):
        list(opened(io.BytesIO(_damaged()[kind]), KEY))


def test_another_key_opens_nothing() -> None:
    with pytest.raises(NotOpened, match="another key"):
        list(opened(io.BytesIO(sealed(b"content")), bytes(32)))
