"""Encrypted streams of any length: AES-256-GCM in chunks, so that neither end holds the whole, and nothing can be cut off or reordered.

Construction: STREAM (Hoang, Reyhanitabar, Rogaway, Vizar 2015). The nonce of a chunk is a random prefix, its number, and whether it is the
last. So a file that ends early, lacks a chunk or has two exchanged does not open.
"""

from __future__ import annotations

import io
import secrets
import struct
from collections.abc import Iterator
from typing import BinaryIO

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from app.platform.errors import BetaloopError

MAGIC = b"betaloop sealed 1\n"
CHUNK = 1 << 20
KEY_BYTES = 32
_PREFIX, _TAG = 7, 16


class NotOpened(BetaloopError):
    """A sealed file is damaged, or was sealed with another key."""

    title = "The file cannot be opened"


class SealedWriter(io.RawIOBase):
    """Seals what is written to it into `out`; `close` writes the last chunk. `out` stays open."""

    def __init__(self, out: BinaryIO, key: bytes) -> None:
        self._out, self._cipher, self._prefix = out, AESGCM(key), secrets.token_bytes(_PREFIX)
        self._waiting, self._number = bytearray(), 0
        out.write(MAGIC + self._prefix)

    def writable(self) -> bool:
        """Return True: it can be written."""
        return True

    def write(self, data: object) -> int:
        """Take bytes of any length."""
        view = memoryview(data)  # type: ignore[arg-type]
        self._waiting += view
        while len(self._waiting) > CHUNK:  # one chunk is kept back: it may be the last
            self._seal(bytes(self._waiting[:CHUNK]), last=False)
            del self._waiting[:CHUNK]
        return view.nbytes

    def close(self) -> None:
        """Write what is left, marked as the last chunk."""
        if not self.closed:
            self._seal(bytes(self._waiting), last=True)
            super().close()

    def _seal(self, plain: bytes, last: bool) -> None:
        self._out.write(self._cipher.encrypt(_nonce(self._prefix, self._number, last), plain, MAGIC))
        self._number += 1


def opened(source: BinaryIO, key: bytes) -> Iterator[bytes]:
    """Open a sealed stream and yield its chunks, each checked before it is given.

    Raises:
        NotOpened: it is damaged, cut off, no sealed stream, or the key is another.
    """
    head = source.read(len(MAGIC) + _PREFIX)
    if len(head) < len(MAGIC) + _PREFIX or not head.startswith(MAGIC):
        raise NotOpened("This is no sealed file of betaloop.", "Give a backup that `betaloop backup` made.")
    prefix, cipher, number = head[len(MAGIC) :], AESGCM(key), 0
    chunk = source.read(CHUNK + _TAG)
    while True:
        following = source.read(CHUNK + _TAG)
        try:
            yield cipher.decrypt(_nonce(prefix, number, last=not following), chunk, MAGIC)
        except InvalidTag as error:
            raise NotOpened(
                "The file was sealed with another key, or is damaged or incomplete.", "Give the key file of this backup, or another copy."
            ) from error
        if not following:
            return
        chunk, number = following, number + 1


class SealedReader(io.RawIOBase):
    """A sealed stream as a file to read from. Raises NotOpened as `opened` does."""

    def __init__(self, source: BinaryIO, key: bytes) -> None:
        self._chunks, self._waiting = opened(source, key), b""

    def readable(self) -> bool:
        """Return True: it can be read."""
        return True

    def readinto(self, buffer: object) -> int:
        """Fill the buffer as far as the present chunk goes; 0 at the end."""
        view = memoryview(buffer).cast("B")  # type: ignore[arg-type]
        while not self._waiting:
            chunk = next(self._chunks, None)
            if chunk is None:
                return 0
            self._waiting = chunk
        part = self._waiting[: len(view)]
        view[: len(part)] = part
        self._waiting = self._waiting[len(part) :]
        return len(part)


def _nonce(prefix: bytes, number: int, last: bool) -> bytes:
    return prefix + struct.pack(">I?", number, last)
