"""Files by content: a folder `sha256[:2]/sha256`, written once, fsynced, never changed, readable by the service's user alone."""

from __future__ import annotations

import hashlib
import os
import secrets
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

from sqlalchemy import BigInteger, CheckConstraint, String, func
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.orm import Mapped, Session, mapped_column

from app.platform.database import Base
from app.settings import get_settings, private_folder

CHUNK = 1 << 20


class StoredFile(Base):
    """Bytes that the content-addressed folder holds."""

    __tablename__ = "stored_file"
    __table_args__ = (CheckConstraint("sha256 ~ '^[0-9a-f]{64}$'", name="sha256"), CheckConstraint("size >= 0", name="size"))

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    size: Mapped[int] = mapped_column(BigInteger)
    media_type: Mapped[str] = mapped_column(String(100))
    created_at: Mapped[datetime] = mapped_column(server_default=func.now())


class MissingFile(RuntimeError):
    """The database names bytes that the folder lacks, or that no longer have their hash."""


def path_of(sha256: str) -> Path:
    """Where bytes of this hash live."""
    return get_settings().files_dir / sha256[:2] / sha256


def draft_path() -> Path:
    """A fresh path inside the store's folder, on the same file system, for bytes whose hash is not yet known."""
    folder = private_folder(private_folder(get_settings().files_dir) / "incoming")
    return folder / secrets.token_hex(16)


def store(db: Session, content: bytes | Path, media_type: str) -> StoredFile:
    """Keep bytes (or a draft file, which is moved) and return their row; the same bytes twice are one file.

    The bytes are on disk, fsynced, before the row exists, so that a committed row always has its file.
    """
    draft = content if isinstance(content, Path) else draft_path()
    if isinstance(content, bytes):
        draft.write_bytes(content)
    sha256, size = hash_file(draft)
    target = path_of(sha256)
    if target.exists():
        draft.unlink()
    else:
        draft.chmod(0o600)
        _sync(draft)
        private_folder(target.parent)
        draft.rename(target)
        _sync(target.parent)
    db.execute(insert(StoredFile).values(sha256=sha256, size=size, media_type=media_type).on_conflict_do_nothing())
    return db.get_one(StoredFile, sha256)


def read(sha256: str) -> bytes:
    """The bytes of a hash.

    Raises:
        MissingFile: they are gone or damaged.
    """
    path = path_of(sha256)
    if not path.exists():
        raise MissingFile(f"File {sha256} is missing from {get_settings().files_dir}. Restore it from a backup of the data folder.")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != sha256:
        raise MissingFile(f"File {sha256} in {get_settings().files_dir} is damaged: its bytes have another hash. Restore a backup.")
    return content


def receive(stream: BinaryIO, limit: int) -> tuple[Path, str, int]:
    """Copy a stream to a draft file without holding it in memory; returns path, SHA-256 and size.

    Raises:
        OverflowError: more than `limit` bytes; the draft is removed.
    """
    path, digest, size = draft_path(), hashlib.sha256(), 0
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
        while chunk := stream.read(CHUNK):
            size += len(chunk)
            if size > limit:
                path.unlink()
                raise OverflowError(f"more than {limit} bytes")
            digest.update(chunk)
            out.write(chunk)
    return path, digest.hexdigest(), size


def close_to_others() -> None:
    """Close what an earlier version left readable by every user of the machine: stored files, job folders, the demo's logs."""
    settings = get_settings()
    for folder in (settings.files_dir, settings.jobs_dir, settings.data_dir / "log", settings.data_dir / "secrets"):
        if folder.is_dir() and folder.stat().st_mode & 0o077:
            for path in folder.rglob("*"):
                if not path.is_symlink():
                    path.chmod(0o700 if path.is_dir() else 0o600)
            folder.chmod(0o700)  # last: an interrupted run is done again


def hash_file(path: Path) -> tuple[str, int]:
    """SHA-256 in hex and size of a file."""
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest(), path.stat().st_size


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
