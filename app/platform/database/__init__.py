"""The database: engine, session per request, base class of all tables, and who is acting (for the audit trail)."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import Depends
from psycopg.errors import UndefinedColumn, UndefinedTable
from sqlalchemy import Connection, DateTime, Engine, MetaData, create_engine, event, make_url, text
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.exc import DBAPIError, ProgrammingError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import DeclarativeBase, ORMExecuteState, Session, SessionTransaction

from app.platform.database.connection import NOTICED, connection_url
from app.platform.embedded import place
from app.platform.embedded.server import EmbeddedPostgres
from app.platform.errors import passing
from app.settings import Settings, get_settings

log = logging.getLogger(__name__)

NAMING = {
    "ix": "ix_%(column_0_N_label)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "ck": "ck_%(table_name)s_%(constraint_name)s",
    "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
    "pk": "pk_%(table_name)s",
}


class Base(DeclarativeBase):
    """Base of every table; times are UTC with time zone, dictionaries are JSONB."""

    metadata = MetaData(naming_convention=NAMING)
    type_annotation_map = {datetime: DateTime(timezone=True), dict[str, Any]: JSONB, list[Any]: JSONB}


ONE_STANDING: dict[str, Any] = {"unique": True, "postgresql_where": text("removed_at is null")}
"""Of an index: of the rows that were not marked as removed, one alone may have these values."""
DEFINED = "defined"


def column_info(definition: dict[str, Any] | None) -> dict[str, Any]:
    """Return the information of a column that an installation defines, which `migrate` adds; of none where it is built in.

    Args:
        definition: what may not change once there are values, with `check`, an SQL condition.
    """
    return {} if definition is None else {DEFINED: definition}


def now() -> datetime:
    """Return the present time, UTC."""
    return datetime.now(UTC)


_lock = threading.Lock()
_engines: dict[str, Engine] = {}
_embedded: dict[str, EmbeddedPostgres] = {}


def database_url(settings: Settings | None = None) -> str:
    """Return the SQLAlchemy URL; start the embedded PostgreSQL if the settings name no database."""
    settings = settings or get_settings()
    if settings.database_url:
        return connection_url("BETALOOP_DATABASE_URL", settings.database_url)
    return _embedded_server(settings).url("betaloop")


def owner_url(settings: Settings | None = None) -> str:
    """Return the URL for the owner of the tables (migrations, backup, restore); the service's if the settings name no owner."""
    settings = settings or get_settings()
    if settings.database_url and settings.owner_url:
        return connection_url("BETALOOP_OWNER_URL", settings.owner_url)
    return database_url(settings) if settings.database_url else _embedded_server(settings).owner_url("betaloop")


def _embedded_server(settings: Settings) -> EmbeddedPostgres:
    key = str(settings.data_dir.resolve())
    with _lock:
        if key not in _embedded:
            server = EmbeddedPostgres(settings.data_dir / "postgres", server_user=settings.server_user)
            server.start()
            _embedded[key] = server
        return _embedded[key]


ASK_S = 5.0
HEAL_POLL_S = 1.0
"""Longest time for which a service does not see that its embedded server died."""


def supervise_database(stop: threading.Event | None = None) -> None:
    """Start a thread that restarts the embedded server whenever it dies; an external PostgreSQL is left to its keeper.

    Args:
        stop: ends the thread; without one it ends with the process.
    """
    database_url()
    with _lock:
        server = _embedded.get(str(get_settings().data_dir.resolve()))
    if server is not None and not get_settings().database_url:
        threading.Thread(target=_supervise, args=(server, stop or threading.Event()), name="database-supervisor", daemon=True).start()


def _supervise(server: EmbeddedPostgres, stop: threading.Event) -> None:
    told = False
    while not stop.wait(HEAL_POLL_S):
        try:
            if server.heal():
                log.warning("the embedded database had died and was started again")
            told = False
        except (RuntimeError, OSError) as error:  # a full disk, mostly: tried again until there is room
            if not told:
                log.error("the embedded database has died and does not start: %s", error)
            told = True


def database_place(settings: Settings | None = None) -> str:
    """Return the place of the database for people: a folder, or an external address without its password. Start nothing."""
    settings = settings or get_settings()
    if settings.database_url:
        url = make_url(database_url(settings))
        return url.difference_update_query(NOTICED).render_as_string()
    asked = settings.data_dir.resolve() / "postgres"
    return str(place.recorded(asked) or f"{asked} (made at the first start, outside if PostgreSQL's user cannot enter this folder)")


KEPT_CONNECTIONS, MOST_CONNECTIONS = 2, 30
"""Connections that a process keeps when idle, and the most it opens. One costs PostgreSQL 3 to 4 MB, and 4 ms of processor time to open."""


def get_engine() -> Engine:
    """Return the engine of this process, made at the first call."""
    url = database_url()
    with _lock:
        if url not in _engines:
            overflow = MOST_CONNECTIONS - KEPT_CONNECTIONS
            _engines[url] = create_engine(url, pool_pre_ping=True, pool_size=KEPT_CONNECTIONS, max_overflow=overflow, hide_parameters=True)
        return _engines[url]


def lock_engine() -> Engine:
    """Return the engine for locks that outlast a transaction. Each statement commits by itself, and one connection is kept when idle."""
    url = database_url()
    with _lock:
        if (key := f"locks of {url}") not in _engines:
            _engines[key] = create_engine(url, isolation_level="AUTOCOMMIT", pool_pre_ping=True, pool_size=1, max_overflow=-1)
        return _engines[key]


def new_session() -> Session:
    """Open a session outside a request (commands, workers); the caller commits and closes."""
    return Session(get_engine(), expire_on_commit=False)


@contextmanager
def transaction(actor: str = "system") -> Iterator[Session]:
    """Open a session that commits at the end and rolls back on an error; `actor` is written to the audit trail.

    Raises RuntimeError, worded for a command line, if the database does not have the tables of this version.
    """
    with new_session() as db:
        set_actor(db, actor)
        try:
            yield db
            db.commit()
        except ProgrammingError as error:
            if isinstance(error.orig, UndefinedTable | UndefinedColumn):
                raise RuntimeError("the database does not have the tables of this version: run `betaloop migrate` first") from error
            raise


def get_db() -> Iterator[Session]:
    """Open the session of one request; it closes when the answer has left, for some answers are read from it piece by piece."""
    db = new_session()
    try:
        yield db
    finally:
        _let_go(db)


def _let_go(db: Session) -> None:
    """Close a session. If the connection is lost, ignore it: the server has rolled back and the response is already sent or on its way."""
    try:
        db.close()
    except DBAPIError as error:
        if passing(error) is None:
            raise
        log.warning("the database went away before a request's session was closed: %s", type(error.orig).__name__)
        db.invalidate()


def request_session(db: Annotated[Session, Depends(get_db)]) -> Iterator[Session]:
    """Commit what an endpoint has changed when it returns, before its answer leaves. An error rolls back, as does a failed commit.

    Raises:
        SQLAlchemyError: the commit failed. The sender gets an error, and never the answer of the endpoint.
    """
    yield db
    wrote = may_have_written(db)
    try:
        db.commit()
    except DBAPIError as error:
        if wrote or passing(error) is None:
            raise
        # after reading alone the answer is right
        log.warning("the database went away before a request that only read had ended: %s", type(error.orig).__name__)


def may_have_written(db: Session) -> bool:
    """Decide whether the present transaction has, or may have, something to commit."""
    return bool(db.info.get(_MAY_HAVE_WRITTEN) or db.new or db.dirty or db.deleted)


def end_reading(db: Session) -> None:
    """End a transaction that has only read, with its locks and its connection, because what follows takes long. The session goes on.

    One that has written, or that a job's step keeps together, stays open.
    """
    if not (may_have_written(db) or db.info.get(KEPT_TOGETHER)):
        db.commit()


KEPT_TOGETHER = "kept together"
"""Key in a session's `info`: all that it does is one transaction."""


_MAY_HAVE_WRITTEN = "may have written"


@event.listens_for(Session, "after_flush")
def _after_flush(db: Session, _context: Any) -> None:
    db.info[_MAY_HAVE_WRITTEN] = True


@event.listens_for(Session, "do_orm_execute")
def _before_statement(state: ORMExecuteState) -> None:
    """Take every statement that is not a plain query for one that writes, a call of a function in text among them."""
    if not state.is_select:
        state.session.info[_MAY_HAVE_WRITTEN] = True


@event.listens_for(Session, "after_transaction_end")
def _after_end(db: Session, transaction: SessionTransaction) -> None:
    if transaction.parent is None:  # the end of a savepoint commits nothing
        db.info.pop(_MAY_HAVE_WRITTEN, None)


Db = Annotated[Session, Depends(request_session, scope="function")]
"""The session of a request. Nothing that takes it commits: the change of one request is one transaction."""


def set_actor(db: Session, label: str, user_id: int | None = None, request_id: str | None = None, reason: str | None = None) -> None:
    """Say who writes from now on in this session; the audit triggers read it from the transaction."""
    db.info["actor"] = {"label": label, "user_id": user_id, "request_id": request_id, "reason": reason}
    if db.in_transaction():
        _announce(db, db.connection())


def acting(db: Session) -> str:
    """Return who writes in this session, as the audit trail names them."""
    return str(db.info.get("actor", {}).get("label", "system"))


def set_reason(db: Session, reason: str | None) -> None:
    """Set the reason for the following changes of this session (kept in the audit trail)."""
    actor = db.info.get("actor", {"label": "system"})
    set_actor(db, actor["label"], actor.get("user_id"), actor.get("request_id"), reason)


def _announce(db: Session, connection: Connection) -> None:
    actor = db.info["actor"]
    connection.execute(
        text(
            "select set_config('betaloop.actor', :label, true), set_config('betaloop.user_id', :user_id, true),"
            " set_config('betaloop.request_id', :request_id, true), set_config('betaloop.reason', :reason, true)"
        ),
        {
            "label": actor["label"],
            "user_id": str(actor.get("user_id") or ""),
            "request_id": actor.get("request_id") or "",
            "reason": actor.get("reason") or "",
        },
    )


@event.listens_for(Session, "after_begin")
def _after_begin(db: Session, transaction: SessionTransaction, connection: Connection) -> None:
    if db.info.get("actor") and not transaction.nested:  # the settings of the transaction hold in it too
        _announce(db, connection)


def keep_asking(beat: Callable[[], None]) -> None:
    """Ask the database something every ASK_S, for ever, and call `beat` once it has answered or failed."""
    while True:
        try:
            with new_session() as db:
                check_connection(db)
        except (DBAPIError, PoolTimeout) as error:
            log.warning("the database does not answer: %s", type(error).__name__)
        beat()
        time.sleep(ASK_S)


def check_connection(db: Session) -> None:
    """Ask the database something; raises SQLAlchemy's OperationalError where it does not answer."""
    db.execute(text("select 1"))
