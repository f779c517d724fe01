"""Middleware of every request: request id, security headers, cross-site check, one place for errors."""

from __future__ import annotations

import json
import secrets
import time
from contextlib import suppress
from typing import Any
from urllib.parse import quote, urlsplit

import structlog
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse
from fastapi.routing import iter_route_contexts
from prometheus_client import Counter, Histogram
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware.base import RequestResponseEndpoint
from starlette.requests import ClientDisconnect
from starlette.routing import compile_path

from app.platform.database import new_session
from app.platform.errors import BetaloopError, Conflict, DatabaseAway, EntriesOfAnother, Forbidden, StorageFull, Unauthorized, passing
from app.platform.upkeep.migrate import newest_revision, revision
from app.platform.web.compression import Compression
from app.platform.web.error_pages import ADDRESS_ALONE, advised, input_in_words, kept_entries, send_again_to, writer_of
from app.platform.web.request_bodies import BodyLimit, Judge, UniqueMembers
from app.platform.web.templates import render
from app.settings import get_settings

log = structlog.get_logger()

CONTENT_SECURITY_POLICY = (
    "default-src 'self'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self'; "
    "form-action 'self'; frame-ancestors 'none'; base-uri 'none'; object-src 'none'"
)
_SAFE = {"GET", "HEAD", "OPTIONS"}
_requests = Counter("betaloop_requests_total", "Requests by method, route and status.", ["method", "route", "status"])
_seconds = Histogram("betaloop_request_seconds", "Time to answer by route.", ["route"])


def install(app: FastAPI, judge: Judge) -> None:
    """Add middleware and error handlers to the service; `judge` names the sender of a request before its body is read."""
    app.add_middleware(UniqueMembers, refusal=_refused_unread)
    app.add_middleware(BodyLimit, refusal=_refused_unread, judge=judge)  # inside the other: its refusals have the headers of every answer
    app.middleware("http")(_serve)
    app.add_middleware(Compression)  # outermost: what it shrinks is whole
    app.state.judge = judge
    app.add_exception_handler(BetaloopError, _known_error)
    app.add_exception_handler(RequestValidationError, _bad_input)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(DBAPIError, _fault_beneath)
    app.add_exception_handler(PoolTimeout, _fault_beneath)
    app.add_exception_handler(OSError, _fault_beneath)
    app.add_exception_handler(ClientDisconnect, _caller_left)
    app.add_exception_handler(Exception, _unknown_error)


async def _serve(request: Request, call_next: RequestResponseEndpoint) -> Response:
    request.state.request_id = secrets.token_hex(8)
    started = time.perf_counter()
    refused = _cross_site(request)
    response = await _answer(request, refused) if refused else await call_next(request)
    route = getattr(request.scope.get("route"), "path", "none")
    _requests.labels(request.method, route, response.status_code).inc()
    _seconds.labels(route).observe(time.perf_counter() - started)
    return _add_headers(request, response)


def _add_headers(request: Request, response: Response) -> Response:
    """Add the headers that every answer has, a server error's among them."""
    response.headers["X-Request-ID"] = getattr(request.state, "request_id", "")
    response.headers["Content-Security-Policy"] = CONTENT_SECURITY_POLICY
    response.headers["X-Content-Type-Options"] = "nosniff"
    response.headers["Referrer-Policy"] = "same-origin"
    if (synthetic := getattr(request.state, "synthetic", None)) is not None:
        response.headers["X-Synthetic-Participant"] = synthetic
        attachment = response.headers.get("Content-Disposition", "")
        response.headers.update({"Content-Disposition": attachment.replace('filename="', 'filename="synthetic-', 1)} if attachment else {})
    if get_settings().cookie_secure:
        response.headers["Strict-Transport-Security"] = "max-age=31536000"
    if not request.url.path.startswith("/static/"):
        response.headers.setdefault("Cache-Control", "no-store")
    return response


def _cross_site(request: Request) -> BetaloopError | None:
    """Refuse a change from another site: a browser states where a request comes from, and changes must come from our own pages.

    A request with a bearer token and no cookie has no rights but the token's, which no other site can know. So it may come from anywhere.
    """
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    by_token_alone = scheme.lower() == "bearer" and bool(token.strip()) and not request.cookies
    if request.method in _SAFE or by_token_alone:
        return None
    site, origin = request.headers.get("sec-fetch-site"), request.headers.get("origin")
    if site in ("same-origin", "none") or (site is None and origin is None):
        return None
    if site is None and origin is not None and urlsplit(origin).netloc == request.headers.get("host"):
        return None
    return Forbidden("This request came from another site.", "Open the page from betaloop itself and try again.")


def wants_page(request: Request) -> bool:
    """Decide whether a person at a browser page asks, not a program."""
    return not request.url.path.startswith("/api/") and "text/html" in request.headers.get("accept", "")


async def _answer(request: Request, error: BetaloopError) -> Response:
    body = error.problem(request.url.path) | {"request_id": getattr(request.state, "request_id", None)}
    headers = {"Retry-After": str(error.retry_after_s)} if error.retry_after_s is not None else {}
    if not wants_page(request):
        headers |= {"WWW-Authenticate": "Bearer"} if error.status == 401 else {}
        return JSONResponse(json.loads(json.dumps(body, default=str)), error.status, headers, "application/problem+json")
    if isinstance(error, Unauthorized) and request.method in _SAFE:
        target = request.url.path + (f"?{request.url.query}" if request.url.query else "")
        return RedirectResponse(f"/sign-in?next={quote(target, safe='/')}" if target != "/" else "/sign-in", 303)
    entries = await kept_entries(request) if not isinstance(error, EntriesOfAnother) else []
    writer = writer_of(request)
    title, advice = advised(error.status, error.title, bool(entries), writer)
    only_advice = isinstance(error, _PlainError) and error.status in ADDRESS_ALONE
    again = send_again_to(request, writer) if writer else ""
    page = render(request, "error.html", problem=body, title=title, advice=advice, only_advice=only_advice, entries=entries, again=again)
    return HTMLResponse(page, error.status, headers)


async def _refused_unread(request: Request, error: Exception) -> Response:
    """Answer a request whose body was not read: refusals are outside the handlers of errors."""
    if isinstance(error, BetaloopError):
        return await _answer(request, error)
    if isinstance(error, DBAPIError | PoolTimeout):
        return await _fault_beneath(request, error)
    raise error


async def _known_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, BetaloopError)
    return await _answer(request, error)


class _InputError(BetaloopError):
    status = 422
    title = "The input cannot be used"


async def _bad_input(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    errors = [{"where": " > ".join(map(str, e["loc"])), "what": e["msg"]} for e in error.errors()]
    if wants_page(request):
        return await _answer(request, _InputError(input_in_words(error.errors())))
    detail = "; ".join(f"{e['where']}: {e['what']}" for e in errors[:5])
    return await _answer(request, _InputError(detail, "Correct the named members and send again.", errors=errors))


class _PlainError(BetaloopError):
    def __init__(self, status: int, detail: str, hint: str = "") -> None:
        super().__init__(detail, hint)
        self.status, self.title = status, detail


_HINTS = {
    400: "Send JSON as one document in UTF-8 (nested less than a thousand deep, numbers of ordinary length); send forms and files as "
    "a browser or `curl -F` does.",
    404: "/api/v1/openapi.json lists every address of this service.",
}
"""What to do about errors that the framework finds before any rule of ours is asked."""


async def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if isinstance(error.__cause__, OSError):  # what the framework calls a body that cannot be read, where our disk could not take it
        return await _fault_beneath(request, error.__cause__)
    if wants_page(request) and getattr(request.state, "caller", None) is None:
        # no route asked who this is: for a signed-in person the page of the error still has the way back, if the database answers
        with suppress(BetaloopError, DBAPIError, PoolTimeout):
            await request.app.state.judge(request)
    hint = _HINTS.get(error.status_code, "") if not wants_page(request) else ""
    response = await _answer(request, _PlainError(error.status_code, str(error.detail), hint))
    response.headers.update(error.headers or {})
    if error.status_code == 405:
        response.headers["Allow"] = ", ".join(_methods(request))
    return response


def _methods(request: Request) -> list[str]:
    """List every method that some route takes at a request's address (RFC 9110, 10.2.1); the router names those of the first route
    alone."""
    found: set[str] = set()
    for context in iter_route_contexts(request.app.routes):
        if context.path and compile_path(context.path)[0].match(request.url.path):
            found |= set(getattr(context, "methods", None) or ())
    return sorted(found)


async def _caller_left(request: Request, error: Exception) -> Response:
    """Log that the reader of the answer is gone: no fault of ours, and nothing that strangers should fill the log with."""
    log.debug("the caller left before the whole request had come", path=request.url.path)
    return await _answer(request, _PlainError(400, "The request ended before it was whole."))


_FIRST = {"23505", "23503"}
"""A row is there already, or is gone: another person did it at the same moment, after both had looked."""


async def _fault_beneath(request: Request, error: Exception) -> Response:
    """Answer 503 where the database is away or gave the request up for another, 507 where a disk is full, 409 where another person was
    first. Anything else is an error of ours.
    """
    state = getattr(getattr(error, "orig", None), "sqlstate", None)
    if state in _FIRST:
        return await _second(request, error)
    if (known := passing(error)) is None and (known := await run_in_threadpool(_other_schema)) is None:
        return await _unknown_error(request, error)
    tell = log.error if isinstance(known, StorageFull) else log.warning
    tell("a request met a fault that passes", told=known.title, path=request.url.path, error=type(error).__name__, sqlstate=state)
    return await _answer(request, known)


def _other_schema() -> BetaloopError | None:
    """Return an error in words where the database has another schema than this version needs, as during an upgrade."""
    try:
        with new_session() as db:
            has, needs = revision(db), newest_revision()
    except (DBAPIError, PoolTimeout):
        return None
    if has == needs:
        return None
    return DatabaseAway(
        f"The database has schema {has or 'none'}, and this version needs {needs}: it is being upgraded. Nothing was stored.",
        "Try again in some minutes. If it stays so, ask your administrator to bring this service to the version of the database.",
    )


async def _second(request: Request, error: Exception) -> Response:
    """Refuse the second of two requests that did the same at the same moment."""
    told = getattr(error, "orig", None)
    constraint = getattr(getattr(told, "diag", None), "constraint_name", None)
    log.warning("two requests at the same moment", path=request.url.path, sqlstate=getattr(told, "sqlstate", None), constraint=constraint)
    return await _answer(
        request,
        Conflict(
            "Another request changed the same at the same moment, and was first; or this one was sent twice.",
            "Look at what is stored now, then send what is missing.",
        ),
    )


async def _unknown_error(request: Request, error: Exception) -> Response:
    log.error("request failed", path=request.url.path, request_id=getattr(request.state, "request_id", None), exc_info=error)
    problem: Any = _PlainError(500, "Something went wrong on our side.")
    number = getattr(request.state, "request_id", "?")
    problem.hint = f"Tell your administrator the request id {number}. Look at what is stored before you send anything again."
    return _add_headers(request, await _answer(request, problem))
