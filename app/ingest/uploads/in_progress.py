"""Uploads that are being received at this moment, by locks that die with the process that has them; and how far this process is."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import structlog
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.orm import Session

from app.ingest import repository
from app.platform.bucket import StoreAway, bucket
from app.platform.database import lock_engine
from app.platform.errors import BetaloopError, passing

log = structlog.get_logger()

LOCKS = 0x75706C64
"""First key of the advisory locks of uploads; the second is the upload's number."""


AT_ONCE = 8
"""Uploads that one process receives at once. Each needs a thread and one or two connections of the database, which pages need too."""
_places = threading.BoundedSemaphore(AT_ONCE)
_NOTICED = ", ".join(
    f"set_config('tcp_keepalives_{name}', '{seconds}', false)" for name, seconds in (("idle", 10), ("interval", 5), ("count", 3))
)
"""How the database's server notices within 25 s that a machine is gone, and frees its locks; 2 h otherwise."""


class TooManyUploads(BetaloopError):
    """As many uploads as may be received at once."""

    status = 503
    title = "Too many uploads at once"
    retry_after_s = 20


@contextmanager
def place() -> Iterator[None]:
    """Take one of the places of uploads; without one fail at once, rather than wait for it.

    Raises:
        TooManyUploads, StoreAway: none is free. StoreAway where that is because the bucket does not answer.
    """
    if not _places.acquire(blocking=False):
        store = bucket()
        if store is not None and store.is_slow():
            raise StoreAway("The store of files does not answer, and other uploads wait for it.", "Nothing is lost. Try again in a while.")
        raise TooManyUploads(f"{AT_ONCE} uploads are received here at this moment.", "Send this one again in half a minute.")
    try:
        yield
    finally:
        _places.release()


@dataclass(frozen=True)
class Progress:
    """Progress of an upload that this process is receiving.

    Attributes:
        file, files: the file that is read, from 1, and how many there are; 0 before the first.
        share: of that file, 0 to 1. doing: what is done to it.
    """

    file: int = 0
    files: int = 0
    share: float = 0.0
    doing: str = ""


_progress: dict[int, Progress] = {}
"""By upload. In memory, for it is of use while the upload's own request runs, and is not worth a row in the audit trail each time."""


def tell(upload_id: int, share: float | None = None, doing: str | None = None) -> None:
    """Say how far the reading of the present file of an upload is."""
    known = _progress.get(upload_id, Progress())
    _progress[upload_id] = replace(known, share=known.share if share is None else share, doing=doing or known.doing)


def tell_file(upload_id: int, file: int, of: int) -> None:
    """Say which file of an upload comes now."""
    _progress[upload_id] = Progress(file, of)


def told(upload_id: int) -> Progress | None:
    """Return the progress of an upload; None where this process is not receiving it."""
    return _progress.get(upload_id)


@contextmanager
def in_progress(upload_id: int) -> Iterator[None]:
    """Lock an upload that is being received, on a connection of its own, for the upload itself commits in between."""
    with lock_engine().connect() as connection:
        connection.execute(text(f"select {_NOTICED}, pg_advisory_lock(:space, :upload)"), {"space": LOCKS, "upload": upload_id})
        try:
            yield
        finally:
            _progress.pop(upload_id, None)
            try:
                connection.execute(text("select pg_advisory_unlock(:space, :upload)"), {"space": LOCKS, "upload": upload_id})
            except DBAPIError:
                # the lock goes with the connection, and the error that ended the upload is reported, not this
                connection.invalidate()


@contextmanager
def not_counted(db: Session, take_back: Callable[[], None]) -> Iterator[None]:
    """Take back a count of begun work if a temporary fault ends it: the count is for work that ends the process.

    Args:
        take_back: sets the count in the rows of `db` to what it was. Where the database cannot store that either, the count stays.
    """
    try:
        yield
    except Exception as fault:
        if passing(fault) is not None:
            db.rollback()
            try:
                take_back()
                db.commit()
            except SQLAlchemyError as error:
                db.rollback()
                log.warning("a begin that a passing fault ended stays counted", error=type(error).__name__)
        raise


def coming(db: Session) -> set[int]:
    """List the numbers of the uploads that some process is receiving, this one or another on the same database."""
    held = text(
        "select objid::bigint from pg_locks where locktype = 'advisory' and granted and classid::bigint = :space and objsubid = 2"
        " and database = (select oid from pg_database where datname = current_database())"
    )
    return set(db.scalars(held, {"space": LOCKS}))


def interrupted(db: Session) -> list[int]:
    """List the numbers of the uploads that were begun and that no process is receiving, oldest first."""
    free = text("select pg_try_advisory_xact_lock(:space, :upload)")
    return [i for i in repository.unfinished_uploads(db) if db.scalar(free, {"space": LOCKS, "upload": i})]
