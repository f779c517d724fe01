"""Stored files in a bucket (S3) that web and workers on any number of machines share; each machine holds copies of what it reads.

The bucket has an object `files/ab/abcd…` for each file, named by its hash as in the folder. It also has `keys/NAME` with a fingerprint of
each key in `secrets/`. Machines with other keys would encrypt what no other machine can open, so they do not start.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import structlog

from app.platform.errors import RETRY_S, BetaloopError
from app.settings import Settings, get_settings

log = structlog.get_logger()

T = TypeVar("T")
CHUNK = 1 << 20
SLOW_S = 5.0
_LATELY_S = 3600.0
SHARED_KEYS = ("quarantine", "pseudonyms", "second-factor", "sign-on", "bundle-signing", "audit-seals", "visit-day")
"""Keys that every machine of an installation must have alike."""
_FINGERPRINT = b"betaloop key fingerprint 1\0"


class StoreAway(BetaloopError):
    """The bucket does not answer, or refuses."""

    status = 503
    title = "The store of files is not available"
    retry_after_s = RETRY_S


def bucket() -> Bucket | None:
    """Open the bucket of this installation; None where files are in the data folder."""
    settings = get_settings()
    return _bucket(settings.files_url, settings.files_endpoint, os.getpid()) if settings.files_url else None


@lru_cache(maxsize=2)
def _bucket(url: str, endpoint: str | None, _process: int) -> Bucket:
    """Make a bucket for each process: what a parent has opened, its children cannot use."""
    return Bucket(url, endpoint)


class Bucket:
    """Objects named by the hash of their bytes; used by many threads.

    Args:
        url: `s3://BUCKET/PREFIX`. endpoint: address of a server that is not Amazon's.
    """

    def __init__(self, url: str, endpoint: str | None = None) -> None:
        import fsspec  # loaded where there is a bucket alone

        if not url.startswith("s3://") or len(url) < 6:
            raise RuntimeError(f"BETALOOP_FILES_URL is {url}: give s3://BUCKET or s3://BUCKET/PREFIX.")
        self._root = url.removeprefix("s3://").rstrip("/")
        waits = {"connect_timeout": 5, "read_timeout": 10, "retries": {"max_attempts": 2, "mode": "standard"}}
        try:
            # listings are not kept: other machines write too
            self._fs: Any = fsspec.filesystem(
                "s3", endpoint_url=endpoint, config_kwargs=waits, use_listings_cache=False, skip_instance_cache=True
            )
        except ImportError as error:
            raise RuntimeError("Files in a bucket need the packages of betaloop[s3].") from error
        # its own tries come on top of those above, and a bucket that hangs would hold its caller for minutes
        self._fs.retries = 1
        self._asked: dict[object, float] = {}

    def size(self, sha256: str) -> int | None:
        """Return the size of an object in bytes; None where there is none."""
        try:
            return int(self._ask(lambda: self._fs.info(self._name(sha256)))["size"])
        except FileNotFoundError:
            return None

    def put(self, path: Path, sha256: str) -> None:
        """Store a file; there is no object until all of it has arrived. What is there already stays, unless it was damaged since."""
        size = path.stat().st_size
        if self.size(sha256) == size and self.hash_of(sha256) == sha256:
            return
        self._ask(lambda: self._fs.put_file(str(path), self._name(sha256)))
        if self.size(sha256) != size:
            raise StoreAway(f"The bucket has not taken all of {sha256}.", "Try again; nothing that was stored before is lost.")

    def fetch(self, sha256: str, target: Path) -> bool:
        """Copy an object into a file; whether there was one. The bytes are not judged here. Raises OSError where the disk is full."""
        try:
            with self.opened(sha256) as source, target.open("wb") as out:
                while piece := self._ask(lambda: source.read(CHUNK)):
                    out.write(piece)
        except FileNotFoundError:
            return False
        return True

    def hash_of(self, sha256: str) -> str | None:
        """Compute the SHA-256 of the bytes that an object really has, read whole; None where there is none."""
        try:
            with self.opened(sha256) as source:
                return self._ask(lambda: hashlib.file_digest(source, "sha256").hexdigest())  # type: ignore[arg-type]
        except FileNotFoundError:
            return None

    @contextmanager
    def opened(self, sha256: str) -> Iterator[BinaryIO]:
        """Open an object to read it from its beginning. Raises FileNotFoundError."""
        source = self._ask(lambda: self._fs.open(self._name(sha256), "rb", cache_type="readahead", block_size=8 * CHUNK))
        with source:
            yield source

    def remove(self, sha256: str) -> None:
        """Remove an object, if it is there."""
        try:
            self._ask(lambda: self._fs.rm_file(self._name(sha256)))
        except FileNotFoundError:
            return

    def empty(self) -> bool:
        """Decide whether there is no object at all under the prefix."""
        return not self._ask(lambda: self._fs.find(self._root, maxdepth=3))

    def check_keys(self, settings: Settings) -> None:
        """Compare this machine's keys with those of the other machines; the first machine makes them, and leaves their fingerprints.

        Raises:
            RuntimeError: a key is missing here, or another one.
        """
        folder = settings.data_dir / "secrets"
        known = {name.rsplit("/", 1)[-1] for name in self._ask(lambda: self._fs.find(f"{self._root}/keys"))}
        for name in SHARED_KEYS:
            place = f"{self._root}/keys/{name}"
            if name in known and not (folder / name).exists():
                raise RuntimeError(
                    f"{folder / name} is missing, and the other machines of this installation have it. Copy their folder `secrets` here."
                )
            said = hashlib.sha256(_FINGERPRINT + settings.secret(name)).hexdigest().encode()
            if name not in known:
                self._ask(lambda place=place, said=said: self._fs.pipe_file(place, said))  # type: ignore[misc]
            elif self._ask(lambda place=place: self._fs.cat_file(place)) != said:  # type: ignore[misc]
                raise RuntimeError(
                    f"{folder / name} is not the key that the other machines of this installation have. Copy their folder `secrets` here."
                )

    def _name(self, sha256: str) -> str:
        return f"{self._root}/files/{sha256[:2]}/{sha256}"

    def is_slow(self) -> bool:
        """Decide whether a call has waited for the bucket for longer than SLOW_S."""
        return any(time.monotonic() - begun > SLOW_S for begun in list(self._asked.values()))

    def _ask(self, ask: Callable[[], T]) -> T:
        """Call the bucket. Raises FileNotFoundError, or StoreAway for all else that goes wrong there."""
        from botocore.exceptions import BotoCoreError, ClientError

        call = object()
        self._asked[call] = time.monotonic()
        try:
            return ask()
        except FileNotFoundError:
            raise
        except (BotoCoreError, ClientError, OSError, TimeoutError) as error:
            log.error("the bucket cannot be used", error=type(error).__name__, what=str(error)[:200])
            raise StoreAway("The store of files does not answer.", "Nothing is lost. Try again in a while.") from error
        finally:
            del self._asked[call]


def prune_copies() -> int:
    """Remove copies of a bucket's files that were used longest ago, beyond the room for them; how many.

    Those of the last hour stay. So do those that the bucket does not have: files that are older than the bucket are no copies.
    """
    settings, store = get_settings(), bucket()
    if store is None or not settings.files_dir.is_dir():
        return 0
    copies: list[tuple[float, int, Path]] = []
    for path in settings.files_dir.glob("??/*"):
        with contextlib.suppress(FileNotFoundError):  # other processes of this machine make room too
            found = path.stat()
            copies.append((found.st_mtime, found.st_size, path))
    beyond, removed = sum(size for _, size, _ in copies) - settings.files_cache_gib * (1 << 30), 0
    for used, size, path in sorted(copies):
        if beyond <= 0 or used > time.time() - _LATELY_S:
            break
        try:
            if store.size(path.name) != size or path.stat().st_mtime != used:
                continue
        except FileNotFoundError:
            continue
        except StoreAway:
            break
        path.unlink(missing_ok=True)
        beyond, removed = beyond - size, removed + 1
    return removed


def prune_copies_beside() -> None:
    """Prune in a thread of its own, one at a time, so that a bucket that hangs delays no request."""
    if not get_settings().files_url:
        return
    with _pruning_guard:
        if not any(thread.is_alive() for thread in _pruning):
            _pruning[:] = [threading.Thread(target=prune_copies, name="prune-copies", daemon=True)]
            _pruning[0].start()


_pruning: list[threading.Thread] = []
_pruning_guard = threading.Lock()
