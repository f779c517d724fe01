"""FastAPI dependencies: who calls. API routes take a bearer token or the browser's cookie; pages take the cookie."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated

from fastapi import Depends, Request
from fastapi.responses import RedirectResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from app.accounts import service
from app.accounts.permissions import Caller, is_open
from app.platform.database import Db, new_session, set_actor
from app.platform.errors import EntriesOfAnother, Forbidden, TooMany, Unauthorized
from app.platform.web.forms import written_by
from app.platform.web.sources import Allowance, from_this_machine, in_words, network_address
from app.settings import get_settings
from app.tables.accounts import Scope

COOKIE = "betaloop_session"
METRICS = "/metrics"

CALLER_AGE_S = 1.0
"""Age of a caller found before the body was read, beyond which it is looked up again, seconds: a slow body outlives a revoked token."""

_bearer = HTTPBearer(auto_error=False, description="API token from `betaloop token create`.")


def get_caller(request: Request, db: Db, bearer: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]) -> Caller:
    """Find the caller of a request; its name goes into the audit trail of everything the request writes.

    Raises:
        Unauthorized: neither a live token nor a live browser session.
    """
    caller = _found_before(request)
    if caller is None and bearer is not None:
        caller = service.caller_of_token(db, bearer.credentials)
    elif caller is None and (cookie := request.cookies.get(COOKIE)):
        caller = service.caller_of_cookie(db, cookie)
    if caller is None:
        request.state.last_caller = service.last_user_of_cookie(db, request.cookies.get(COOKIE, ""))
        raise Unauthorized(
            "This needs a bearer token or a browser session.", "Make one with `betaloop token create EMAIL --name NAME`, or sign in."
        )
    # the router goes by this path; that of `url` is put together again, with escapes and the caller's Host
    path = request.scope["path"]
    if caller.token_scope is Scope.METRICS and path != METRICS:
        raise Forbidden("A token for 'metrics' reads the figures of the service and nothing else.", "Make one with a wider scope.")
    if caller.is_blinded and not is_open(request.method, path):
        raise Forbidden(
            "This is closed to blinded assessors: it may show which controller a session had.",
            "Results by controller are under Analyses once a visit is locked.",
        )
    set_actor(db, caller.label, caller.user_id, getattr(request.state, "request_id", None))
    request.state.caller = caller  # before a form is refused: the page that says so is of who has signed in, and drops what another typed
    _refuse_entries_of_others(request, caller)
    return caller


def _found_before(request: Request) -> Caller | None:
    """Return the caller that was found before the body was read; None where that was more than a second ago."""
    found_at, caller = getattr(request.state, "found", (0.0, None))
    return caller if time.monotonic() - found_at < CALLER_AGE_S else None


def _refuse_entries_of_others(request: Request, caller: Caller) -> None:
    """Raise EntriesOfAnother for a form that another user filled in, in a browser that has changed hands since.

    Forms name their author where that is known (entries.js, and the page of an expired sign-in). This guards against mix-ups, not against
    attackers, who can type whatever they like once they have signed in.
    """
    writer = written_by(request)
    if writer is not None and writer != caller.user_id:
        raise EntriesOfAnother(
            "Another person had signed in when this was entered; nothing was saved under your name.",
            "The person who entered it signs in here and sends it again; or open the page again and enter what is yours.",
        )


CurrentCaller = Annotated[Caller, Depends(get_caller)]


def reader_of_figures(request: Request, db: Db, bearer: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]) -> None:
    """Admit to `/metrics` callers who have signed in or have a token; where the installation allows it, every program of this machine too.

    Raises:
        Unauthorized, Forbidden: as `get_caller`.
    """
    if not (get_settings().metrics_on_loopback and from_this_machine(request)):
        get_caller(request, db, bearer)


async def judge(request: Request) -> str:
    """Name the sender of a request before its body is read. Raises Unauthorized as `get_caller`."""
    bearer = await _bearer(request)
    return await run_in_threadpool(_judged, request, bearer)


def _judged(request: Request, bearer: HTTPAuthorizationCredentials | None) -> str:
    with new_session() as db:
        caller = get_caller(request, db, bearer)
    request.state.found = (time.monotonic(), caller)
    return f"user {caller.user_id}"


def caller_now(request: Request) -> Callable[[Session], Caller | None]:
    """Make a function that finds the caller of a request again at each call, for long answers: None once session, token or account have
    ended."""
    scheme, _, token = request.headers.get("Authorization", "").partition(" ")
    cookie = request.cookies.get(COOKIE, "")

    def look(db: Session) -> Caller | None:
        if scheme.lower() == "bearer":
            return service.caller_of_token(db, token)
        return service.caller_of_cookie(db, cookie, used=False)

    return look


CallerNow = Annotated[Callable[[Session], Caller | None], Depends(caller_now)]


# Effects of signing in on a browser, by whatever way: its cookie, where it goes on, and how often one source may fail.

SIGNED_OUT = "betaloop_signed_out"
"""Cookie of a browser in which a user has signed out. Its next sign-on asks again, so that one click does not restore their session."""

failed_sign_ins = Allowance(lambda: get_settings().failed_sign_ins_per_source, service.FAILURE_WINDOW.total_seconds())
"""By network address, whatever the accounts: who tries one password with many accounts meets no lock-out of an account."""


def count_try(request: Request) -> str:
    """Count a sign-in before it is judged, however many come at once; give it back where it was right. Returns its source.

    Raises:
        TooMany: too many failed from there.
    """
    source = network_address(request)
    if wait_s := failed_sign_ins.take(source):
        raise TooMany("Too many failed sign-ins came from here.", f"Wait {in_words(wait_s)} and try again.", wait_s)
    return source


def signed_in(token: str, target: str) -> RedirectResponse:
    """Redirect a user who has just signed in, with the session's cookie."""
    settings, answer = get_settings(), RedirectResponse(target, 303)
    answer.set_cookie(
        COOKIE, token, max_age=3600 * settings.session_max_hours, httponly=True, samesite="lax", secure=settings.cookie_secure
    )
    return answer


def local_path(target: str) -> str:
    """Return a path of this service, or `/`: signing in never leads to another site.

    Browsers read a backslash as a slash and drop tabs and line ends, hence the strict look at every character.
    """
    ok = target.startswith("/") and not target.startswith("//") and "\\" not in target and all(" " < c < "\x7f" for c in target)
    return target if ok else "/"
