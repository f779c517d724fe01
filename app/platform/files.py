"""Files by content: a folder `sha256[:2]/sha256`, written once, fsynced, never changed, readable by the service's user alone.

With a bucket (`app.platform.bucket`) that holds the files, and the folder this machine's copies of what it has read or written lately.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import secrets
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import structlog
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.orm import Session

from app.platform.bucket import Bucket, bucket
from app.platform.errors import BetaloopError
from app.settings import get_settings, private_folder
from app.tables.uploads import StoredFile

log = structlog.get_logger()

CHUNK = 1 << 20
_LOCK = ".lock"
_OPEN_FILES = Path("/proc")


class MissingFile(BetaloopError):
    """The database names bytes that the folder lacks, or that no longer have their hash."""

    status = 409
    title = "A stored file is missing or damaged"

    def __init__(self, detail: str) -> None:
        super().__init__(detail, "Ask your administrator to restore it from a backup of the data folder.")


def path_of(sha256: str) -> Path:
    """Locate bytes of this hash on this machine; with a bucket, they are copied here first. No such file: they are missing."""
    path = _place(sha256)
    store = bucket()
    if store is None:
        return path
    try:
        os.utime(path)  # what was used lately stays
    except FileNotFoundError:
        _copy_here(store, sha256, path)
    return path


def _place(sha256: str) -> Path:
    return get_settings().files_dir / sha256[:2] / sha256


def _copy_here(store: Bucket, sha256: str, path: Path) -> None:
    """Copy an object to its place on this machine; one that is damaged is not believed, and not kept."""
    draft = draft_path()
    try:
        if not store.fetch(sha256, draft):
            return
        if hash_file(draft)[0] != sha256:
            raise MissingFile(f"The stored file {sha256} is damaged: its bytes have another hash.")
        _sync(draft)
        private_folder(path.parent)
        draft.rename(path)
        _sync(path.parent)
    finally:
        draft.unlink(missing_ok=True)


@contextmanager
def borrowed(sha256: str) -> Iterator[Path]:
    """Lend bytes of this hash for as long as the context lasts: with a bucket, no copy of them stays on this machine."""
    store = bucket()
    if store is None:
        yield _place(sha256)
        return
    draft = draft_path()
    try:
        if not store.fetch(sha256, draft):
            draft.unlink()
        yield draft
    finally:
        draft.unlink(missing_ok=True)


def remove(sha256: str) -> None:
    """Remove bytes for good; those of a bucket were kept with `copy=False`, so that no machine has a copy."""
    _place(sha256).unlink(missing_ok=True)
    if (store := bucket()) is not None:
        store.remove(sha256)


def is_whole(sha256: str, size: int | None = None, hashes: bool = True) -> bool:
    """Check that the store has the bytes of a hash: of this size, where one is given. With `hashes` the bytes are read and hashed."""
    store = bucket()
    if store is not None:
        has = store.size(sha256)
        return has is not None and size in (None, has) and (not hashes or store.hash_of(sha256) == sha256)
    path = _place(sha256)
    if not path.is_file() or (size is not None and path.stat().st_size != size):
        return False
    return not hashes or whole_at(path, sha256)


_own_folder: list[tuple[Path, int]] = []
"""This process's folder of drafts, once it has one, and the descriptor that holds its lock until the process ends."""
_folder_guard = threading.Lock()


def draft_path() -> Path:
    """Make a fresh, empty file inside the store's folder, on the same file system, for bytes whose hash is not yet known.

    It is in a folder of this process, both readable by the owner only; `remove_abandoned` removes what a killed process leaves there. Bytes
    that may name a person do not belong here, but into `raw_bytes.raw_file`.
    """
    path = _draft_folder() / secrets.token_hex(16)
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    return path


def _incoming() -> Path:
    return get_settings().files_dir / "incoming"


def _draft_folder() -> Path:
    """Return this process's folder of drafts, locked as long as the process lives."""
    incoming = _incoming().resolve()
    with _folder_guard:
        if _own_folder:
            folder, lock = _own_folder[0]
            if folder.parent == incoming and folder.exists():
                return folder
            os.close(lock)
            _own_folder.clear()
        private_folder(private_folder(get_settings().files_dir) / "incoming")
        while True:
            folder = incoming / secrets.token_hex(8)
            folder.mkdir(mode=0o700)
            # another process that clears up may look between any two of these lines: then this folder is theirs, and another one is made
            if (taken := _lock_folder(folder)) is not None:
                _own_folder.append((folder, taken))
                return folder


def _lock_folder(folder: Path) -> int | None:
    """Lock a folder and return the descriptor of the lock; None where another process has it, or has removed the folder."""
    try:
        lock = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR, 0o600)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(lock).st_ino == (folder / _LOCK).stat().st_ino:
            return lock
    except (BlockingIOError, FileNotFoundError):
        pass
    os.close(lock)
    return None


def remove_abandoned() -> int:
    """Remove the drafts of processes that live no more, and those of earlier versions; how many files that were."""
    incoming, removed = _incoming(), 0
    for entry in sorted(incoming.iterdir()) if incoming.is_dir() else []:
        if not entry.is_dir():
            # earlier versions wrote straight into the folder; none of them runs on the same data folder any more
            entry.unlink(missing_ok=True)
            removed += 1
            continue
        lock = _lock_folder(entry)
        if lock is None:
            continue
        try:
            removed += sum(1 for f in entry.rglob("*") if f.is_file() and f.name != _LOCK)
            shutil.rmtree(entry)
        finally:
            os.close(lock)
    return removed


@contextmanager
def draft_folder() -> Iterator[Path]:
    """Make a fresh folder next to the drafts of this process, for work on one of them. It goes with its content, as drafts do."""
    folder = private_folder(_draft_folder() / secrets.token_hex(16))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


@contextmanager
def nameless_file() -> Iterator[tuple[BinaryIO, Path]]:
    """Make a file without a name, and a path by which this process and its children, and no other user, can open it again.

    It is gone when the context ends and when the process is killed, at whatever moment: no cleaning up is needed.
    """
    draft = draft_path()
    with draft.open("w+b", buffering=0) as file:
        path = _path_of_open(file)
        named = not path.exists()
        if not named:
            draft.unlink()
        try:
            yield file, draft if named else path
        finally:
            draft.unlink(missing_ok=True)


@contextmanager
def in_memory(content: bytes) -> Iterator[Path]:
    """Make a path by which this process and its children can read a few bytes, as long as the context lasts. The bytes are on no disk.

    Where the system has no files in memory (it is not Linux), they are in a draft for the owner alone.
    """
    if hasattr(os, "memfd_create") and _OPEN_FILES.is_dir():
        with os.fdopen(os.memfd_create("betaloop"), "w+b", buffering=0) as file:
            file.write(content)
            yield _path_of_open(file)
    else:
        with nameless_file() as (file, path):
            file.write(content)
            yield path


def _path_of_open(file: BinaryIO) -> Path:
    """Return the path of an open file, with or without a name, where the system lists open files."""
    return _OPEN_FILES / str(os.getpid()) / "fd" / str(file.fileno())


@dataclass(frozen=True)
class KeptBytes:
    """Bytes that are on disk or in the bucket, before a row says so; size in bytes."""

    sha256: str
    size: int


@dataclass
class Unsent:
    """Files that a transaction has stored on this machine and that are to reach the bucket before it commits.

    Attributes:
        arrived: hashes that are in the bucket. waiting: those that are not, in the present transaction.
    """

    arrived: set[str] = field(default_factory=set)
    waiting: set[str] = field(default_factory=set)

    def send(self) -> None:
        """Put what waits into the bucket; what has arrived is not sent again. Raises StoreAway."""
        store = bucket()
        for sha256 in sorted(self.waiting):
            if store is not None:
                store.put(_place(sha256), sha256)
            self.arrived.add(sha256)
            self.waiting.discard(sha256)


_UNSENT = "unsent files"


def send_later(db: Session, unsent: Unsent) -> None:
    """Let `store` put nothing into the bucket in this session: the caller sends it after a rollback, and begins again."""
    db.info[_UNSENT] = unsent


def store(db: Session, content: bytes | Path, *, copy: bool = True) -> StoredFile:
    """Keep bytes (or a draft file, which is moved) and return their row; the same bytes twice are one file.

    The bytes are on disk, fsynced, or in the bucket, before the row exists, so that a committed row always has its file.

    Args:
        copy: as of `keep`.
    """
    unsent: Unsent | None = db.info.get(_UNSENT)
    return record(db, keep_bytes(content, copy=copy, unsent=unsent if copy and bucket() is not None else None))


def keep_bytes(content: bytes | Path, *, copy: bool = True, unsent: Unsent | None = None) -> KeptBytes:
    """Keep bytes (or a draft file, which is moved) without a row. Arguments as of `keep`."""
    draft = content if isinstance(content, Path) else draft_path()
    try:
        if isinstance(content, bytes):
            draft.write_bytes(content)
        size = draft.stat().st_size
        return KeptBytes(keep(draft, copy=copy, unsent=unsent), size)
    finally:
        # also where the disk is full: what cannot be stored must not keep it full
        draft.unlink(missing_ok=True)


def record(db: Session, file: KeptBytes) -> StoredFile:
    """Return the row of bytes that were kept, and make it if it is not there."""
    db.execute(insert(StoredFile).values(sha256=file.sha256, size=file.size).on_conflict_do_nothing())
    return db.get_one(StoredFile, file.sha256)


def keep(draft: Path, *, copy: bool = True, unsent: Unsent | None = None) -> str:
    """Move a draft to where its bytes live, on disk or in the bucket when this returns, and give their hash.

    What is there already stays, unless it was damaged since: then these bytes take its place.

    Args:
        copy: whether this machine keeps a copy of what is in the bucket; not of what is to be removed for good one day.
        unsent: takes the place of the bucket for now.
    """
    sha256, _ = hash_file(draft)
    target = _place(sha256)
    store = bucket()
    if unsent is not None:
        unsent.waiting |= {sha256} - unsent.arrived
    elif store is not None:
        store.put(draft, sha256)
    if whole_at(target, sha256) or (store is not None and not copy):
        draft.unlink()
    else:
        draft.chmod(0o600)
        _sync(draft)
        private_folder(target.parent)
        draft.rename(target)
        _sync(target.parent)
    return sha256


def whole_at(path: Path, sha256: str) -> bool:
    """Check that a file is there with the bytes of its hash. One that cannot be read is damaged."""
    try:
        return hash_file(path)[0] == sha256
    except FileNotFoundError:
        return False
    except OSError as error:
        log.error("a stored file cannot be read", sha256=sha256, error=type(error).__name__, errno=error.errno)
        return False


def read(sha256: str) -> bytes:
    """Read the bytes of a hash.

    Raises:
        MissingFile: they are gone or damaged.
    """
    path = path_of(sha256)
    if not path.exists():
        raise MissingFile(f"The stored file {sha256} is missing.")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != sha256:
        raise MissingFile(f"The stored file {sha256} is damaged: its bytes have another hash.")
    return content


def close_to_others() -> None:
    """Close what other users of the machine can read: stored files, job folders, the demo's logs, secrets."""
    settings = get_settings()
    for folder in (settings.files_dir, settings.jobs_dir, settings.data_dir / "log", settings.data_dir / "secrets"):
        if folder.is_dir() and folder.stat().st_mode & 0o077:
            for path in folder.rglob("*"):
                if not path.is_symlink():
                    path.chmod(0o700 if path.is_dir() else 0o600)
            folder.chmod(0o700)  # last: an interrupted run is done again


def hash_file(path: Path) -> tuple[str, int]:
    """Compute SHA-256 in hex and size of a file."""
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest(), path.stat().st_size


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
