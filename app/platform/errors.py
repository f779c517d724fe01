"""Errors in the user's words: raised where the rule is, turned into problem+json (RFC 9457) or a page in one place."""

from __future__ import annotations

from typing import Any


class BetaloopError(Exception):
    """Something a user can understand and put right.

    Args:
        detail: what is wrong, and where.
        hint: what to do about it.
        extra: further members of the problem document.
    """

    status = 400
    title = "The request cannot be carried out"

    def __init__(self, detail: str, hint: str = "", **extra: Any) -> None:
        super().__init__(f"{detail} {hint}".strip())
        self.detail, self.hint, self.extra = detail, hint, extra

    def problem(self, instance: str) -> dict[str, Any]:
        """The problem document."""
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
    """A form that somebody else had filled in before another person signed in."""

    title = "Entered by somebody else"


class Unauthorized(BetaloopError):
    """Nobody is signed in."""

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


class StorageFull(BetaloopError):
    """No room is left on the disk of the service or of its database."""

    status = 507
    title = "The disk is full"
