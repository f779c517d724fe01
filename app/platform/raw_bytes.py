"""Raw bytes of uploads, which may name a person: in files without a name, encrypted with keys that never leave the memory.

The disk never holds a readable file or byte, neither while the service runs nor after it was killed. Each file has a key of its own
(AES-256 in counter mode, which decrypts from any place on). The key is drawn when the file is made and forgotten with it. On systems
without files in memory (other than Linux), a key is on disk with its file while that is used (`files.in_memory`).
"""

from __future__ import annotations

import hashlib
import io
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, cast

from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes

from app.platform import files

BUFFER = 1 << 16
"""Bytes that a reader decrypts at a time."""
_KEY_BYTES, _BLOCK = 32, 16


class _Encrypted(io.RawIOBase):
    """The plain bytes of an encrypted file, at any place of it; holds no more of them than one call asks for.

    A place that is written twice has the same key stream twice. That happens to a zip's frame alone, to lengths and checksums, which
    identify no person.
    """

    def __init__(self, file: BinaryIO, key: bytes) -> None:
        self._file, self._key, self._at = file, key, 0

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        content = self._crypt(os.pread(self._file.fileno(), len(buffer), self._at))
        buffer[: len(content)] = content
        self._at += len(content)
        return len(content)

    def write(self, content: Any, /) -> int:
        left = memoryview(self._crypt(content))
        size = len(left)
        while left:
            written = os.pwrite(self._file.fileno(), left, self._at)
            self._at, left = self._at + written, left[written:]
        return size

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        begin = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: os.fstat(self._file.fileno()).st_size}[whence]
        self._at = max(0, begin + offset)
        return self._at

    def close(self) -> None:
        self._file.close()
        super().close()

    def _crypt(self, content: Any) -> bytes:
        """Encrypt or decrypt the content for the present place."""
        block, within = divmod(self._at, _BLOCK)
        cipher = Cipher(algorithms.AES256(self._key), modes.CTR(block.to_bytes(_BLOCK, "big"))).encryptor()
        cipher.update(bytes(within))
        return cipher.update(content)


@dataclass(frozen=True)
class RawFile:
    """Raw bytes that this process and its children, and no other user, can open as long as the context lasts that gave them.

    Attributes:
        encrypted: a path by which the encrypted bytes can be opened.
        key: a path by which the key can be read; it leads into memory.
    """

    encrypted: Path
    key: Path
    name: str = "file"

    def open(self, mode: Literal["rb"] = "rb") -> BinaryIO:
        """Open the plain bytes; a stream that is open outlives the context."""
        key = self.key.read_bytes()
        return io.BufferedReader(_Encrypted(self.encrypted.open("rb", buffering=0), key), BUFFER)

    def open_for_writing(self) -> BinaryIO:
        """Open the file for plain bytes, which are encrypted as they are written."""
        return _stream(self.encrypted.open("r+b", buffering=0), self.key.read_bytes())

    def sha256(self) -> str:
        """Compute the hash of the plain bytes, in hex."""
        with self.open() as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()  # type: ignore[arg-type]


@contextmanager
def raw_file() -> Iterator[tuple[BinaryIO, RawFile]]:
    """Make an empty file for raw bytes: a stream to write them with, and the file as it can be opened again. It goes when the context
    ends."""
    key = secrets.token_bytes(_KEY_BYTES)
    with files.nameless_file() as (file, path), files.in_memory(key) as kept:
        yield _stream(file, key), RawFile(path, kept)


def raw_stream() -> BinaryIO:
    """Open a stream into an empty file that no other process can open, not even by a path; it goes when the stream is closed."""
    draft = files.draft_path()
    file = draft.open("w+b", buffering=0)
    draft.unlink()
    return _stream(file, secrets.token_bytes(_KEY_BYTES))


@contextmanager
def received(stream: BinaryIO, limit: int) -> Iterator[tuple[RawFile, str, int]]:
    """Copy a stream to a raw file without holding it in memory; gives the file, its SHA-256 and size, valid inside the context.

    Raises:
        OverflowError: more than `limit` bytes.
    """
    digest, size = hashlib.sha256(), 0
    with raw_file() as (out, raw):
        while chunk := stream.read(files.CHUNK):
            size += len(chunk)
            if size > limit:
                raise OverflowError(f"more than {limit} bytes")
            digest.update(chunk)
            out.write(chunk)
        yield raw, digest.hexdigest(), size


def _stream(file: BinaryIO, key: bytes) -> BinaryIO:
    return cast(BinaryIO, _Encrypted(file, key))
