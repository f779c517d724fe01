"""Errors in the user's words: raised where the rule is, turned into problem+json (RFC 9457) or a page in one place."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout

FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Of an OSError where no room is left, on the disk or for its user."""
RETRY_S = 5
"""Seconds after which a request may be retried that failed by a temporary fault."""


class BetaloopError(Exception):
    """Something a user can understand and put right.

    Args:
        detail: what is wrong, and where.
        hint: what to do about it.
        extra: further members of the problem document; `field` is the one that all of it is about, so that a form says it there.
    """

    status = 400
    title = "The request cannot be carried out"
    retry_after_s: int | None = None
    """Seconds after which another try makes sense; None where time alone changes nothing."""

    def __init__(self, detail: str, hint: str = "", **extra: Any) -> None:
        super().__init__(f"{detail} {hint}".strip())
        self.detail, self.hint, self.extra = detail, hint, extra

    def problem(self, instance: str) -> dict[str, Any]:
        """Build the problem document."""
        body: dict[str, Any] = {"type": "about:blank", "title": self.title, "status": self.status}
        body |= {"detail": self.detail, "instance": instance}
        if self.hint:
            body["hint"] = self.hint
        return body | self.extra


class NotFound(BetaloopError):
    """No such thing, or not for this user."""

    status = 404
    title = "Not found"


class Invalid(BetaloopError):
    """The input breaks a rule."""

    status = 422
    title = "The input cannot be used"


class Conflict(BetaloopError):
    """The present state does not allow it."""

    status = 409
    title = "Not possible in the present state"


class EntriesOfAnother(Conflict):
    """A form that one person had filled in before another signed in."""

    title = "Entered by somebody else"


class Unauthorized(BetaloopError):
    """The caller is not signed in."""

    status = 401
    title = "Sign in first"


class Forbidden(BetaloopError):
    """Signed in, but not allowed."""

    status = 403
    title = "Not allowed"


class TooLarge(BetaloopError):
    """More bytes than the installation accepts."""

    status = 413
    title = "The file is too large"


class TooMany(BetaloopError):
    """Too many attempts.

    Args:
        detail, hint: as everywhere.
        retry_after_s: seconds after which another try makes sense.
    """

    status = 429
    title = "Too many attempts"

    def __init__(self, detail: str, hint: str = "", retry_after_s: int = 5) -> None:
        super().__init__(detail, hint)
        self.retry_after_s = retry_after_s


class DatabaseAway(BetaloopError):
    """The database does not answer for the moment."""

    status = 503
    title = "The database is not available"
    retry_after_s = RETRY_S


class GivenUp(DatabaseAway):
    """The database gave a transaction up for another one."""

    title = "Another request stood in the way"


class StorageFull(BetaloopError):
    """No room is left on the disk of the service or of its database."""

    status = 507
    title = "The disk is full"


_DISK_FULL = "53100"
_READ_ONLY = "25006"
"""Of a standby that is not promoted yet, or a server that was made read-only."""
_IN_THE_WAY = {"40001", "40P01"}
"""Of a transaction that was given up for another one: the same request may be sent again."""
_AWAY = {"08", "57P", "533"}
"""How states begin of a database that is away, restarting or out of connections."""


def passing(error: BaseException) -> BetaloopError | None:
    """Return a temporary infrastructure fault: disk full (507), database or store of files away, or transaction given up (503). None for
    every other error.
    """
    if isinstance(error, BetaloopError):
        return error if error.status in (503, 507) else None
    if isinstance(error, OSError) and error.errno in FULL:
        return no_room()
    if not isinstance(error, DBAPIError | PoolTimeout):
        return None
    state = getattr(getattr(error, "orig", None), "sqlstate", None) or ""
    if state == _DISK_FULL:
        return no_room()
    if state in _IN_THE_WAY:
        return GivenUp("Another request changed the same at the same moment.", "Look at what is stored, then send this again.")
    if state == _READ_ONLY:
        return DatabaseAway(
            "The database takes no writes for the moment.", "It does again by itself. Wait a few seconds, then send this again."
        )
    invalidated = isinstance(error, DBAPIError) and error.connection_invalidated
    unreached = isinstance(error, PoolTimeout) or (isinstance(error, OperationalError) and not state)
    if invalidated or unreached or state[:2] in _AWAY or state[:3] in _AWAY:
        return DatabaseAway(
            "The database does not answer for the moment.",
            "It comes back by itself. Wait a few seconds, look at what is stored, then try again.",
        )
    return None


def no_room() -> StorageFull:
    """Make the error for a full disk."""
    return StorageFull(
        "There is no room left on the disk.", "Ask your administrator to make room; what was stored before is safe. Then try again."
    )


@contextmanager
def about(field: str) -> Iterator[None]:
    """Assign an error inside to one field, where it names none itself."""
    try:
        yield
    except BetaloopError as error:
        error.extra.setdefault("field", field)
        raise
