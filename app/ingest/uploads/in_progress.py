"""Which uploads are being received at this moment, by locks that die with the process that holds them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import NullPool, create_engine, select, text
from sqlalchemy.orm import Session

from app.ingest.models import Upload
from app.platform.database import database_url

LOCKS = 0x75706C64
"""First key of the advisory locks of uploads; the second is the upload's number."""


@contextmanager
def in_progress(upload_id: int) -> Iterator[None]:
    """Hold the lock that says that an upload is being received, on a connection of its own, for the upload itself commits in between."""
    engine = create_engine(database_url(), poolclass=NullPool)
    with engine.connect() as connection:
        connection.execute(text("select pg_advisory_lock(:space, :upload)"), {"space": LOCKS, "upload": upload_id})
        connection.commit()
        try:
            yield
        finally:
            # The server frees it too once it notices that the connection is gone, which on a busy machine is a moment later.
            connection.execute(text("select pg_advisory_unlock(:space, :upload)"), {"space": LOCKS, "upload": upload_id})
            connection.commit()


def interrupted(db: Session) -> list[int]:
    """Numbers of the uploads that were begun and that nobody is receiving, oldest first."""
    begun = db.scalars(select(Upload.id).where(Upload.status == "received").order_by(Upload.id)).all()
    free = text("select pg_try_advisory_xact_lock(:space, :upload)")
    return [i for i in begun if db.scalar(free, {"space": LOCKS, "upload": i})]
