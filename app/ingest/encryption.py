"""Files that cannot be parsed cannot be freed of identity: they are kept, encrypted with a key of this installation."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path

from cryptography.fernet import Fernet

from app.platform.files import CHUNK, draft_path
from app.settings import get_settings
from ml.formats import Source


def _cipher() -> Fernet:
    return Fernet(base64.urlsafe_b64encode(get_settings().secret("quarantine")))


def encrypt(original: Source) -> Path:
    """Encrypt a file into a draft, one line per MiB; the original is left where it is."""
    cipher, sealed = _cipher(), draft_path()
    try:
        with original.open("rb") as source, sealed.open("wb") as out:
            while chunk := source.read(CHUNK):
                out.write(cipher.encrypt(chunk) + b"\n")
    except BaseException:
        sealed.unlink(missing_ok=True)
        raise
    return sealed


def decrypt(path: Path) -> Iterator[bytes]:
    """Yield the original bytes of a quarantined file, a MiB at a time. Raises cryptography's InvalidToken when they were tampered with."""
    cipher = _cipher()
    with path.open("rb") as source:
        for line in source:
            yield cipher.decrypt(line.rstrip(b"\n"))
