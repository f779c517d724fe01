"""Checks of request bodies: before one is read its size, its sender and how much they have sent lately; then its members.

No body may be larger than its kind allows, stated or not: files up to the installation's upload limit, all else 1 MiB. Three kinds are read
only from callers who have signed in: bodies to the REST interface, JSON to any address, and bodies beyond `UNJUDGED_LIMIT`. Files count
against what a network address and a user may send in an hour. An answer to a request whose body was not read ends the connection, so that
the rest of it is not received either.

Parsers take the last of two members of one name without a word. The sender meant one of the two, so the document is refused.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.platform.errors import BetaloopError, Invalid, TooMany
from app.platform.web.sources import Allowance, in_words, network_address
from app.settings import get_settings

PLAIN_LIMIT = 1 << 20
"""Bytes of a JSON document or a plain form."""
UNJUDGED_LIMIT = 1 << 16
"""Bytes of a form of a page that is read before anybody asks who sends it: a sign-in, or what an expired sign-in gives back."""
INTERFACE = "/api/"
"""What paths of the REST interface begin with."""
Refusal = Callable[[Request, Exception], Awaitable[Response]]
"""Makes the answer to a request that was refused for a reason; raises what it does not know."""
Judge = Callable[[Request], Awaitable[str]]
"""Names the sender of a request, as a word for a user. Raises Unauthorized for a caller who is not signed in."""
_FORM_ALLOWANCE = 1 << 20  # the form fields and boundaries around a file of the largest size

sent = Allowance(lambda: get_settings().upload_gib_per_hour * (1 << 30), 3600.0)
"""Bytes of files by network address and by user."""


class BodyTooLarge(BetaloopError):
    """More bytes than this kind of request may have."""

    status = 413
    title = "The request is too large"


class BodyLimit:
    """ASGI middleware: refuses by the stated length before reading, and cuts off bodies that state none."""

    def __init__(self, app: ASGIApp, refusal: Refusal, judge: Judge) -> None:
        self.app = app
        self.refusal = refusal
        self.judge = judge

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 401, 413 or 429."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        body = _Body(scope, receive, send)
        if body.is_of_callers_alone:
            request = Request(scope)
            try:
                body.require_size()
                body.count_for([f"address {network_address(request)}", await self.judge(request)])
            except Exception as error:
                response = await self.refusal(request, error)
                await response(scope, receive, body.send)
                return
        await self.app(scope, body.receive, body.send)


class _Body:
    """The body of one request, as it is received."""

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = dict(scope["headers"])
        stated = headers.get(b"content-length", b"")
        self._receive, self._send = receive, send
        self._stated = int(stated) if stated.isdigit() else None
        self._has_files = headers.get(b"content-type", b"").lower().startswith(b"multipart/form-data")
        self._is_data = is_json(scope) or scope["path"].startswith(INTERFACE)
        self._limit = get_settings().upload_limit_mb * 1024 * 1024 + _FORM_ALLOWANCE if self._has_files else PLAIN_LIMIT
        self.is_of_callers_alone = b"transfer-encoding" in headers or (self._stated or 0) > (0 if self._is_data else UNJUDGED_LIMIT)
        self._sources: list[str] = []
        self._seen, self._whole = 0, False

    def require_size(self) -> None:
        """Raise BodyTooLarge by the stated length."""
        if (self._stated or 0) > self._limit:
            raise BodyTooLarge(*_advice(self._has_files))

    def count_for(self, sources: list[str]) -> None:
        """Count the files that are to come for their sources. Raises TooMany where one has sent too much."""
        if self._has_files:
            _take(sources, self._stated or 0)
            self._sources = sources if self._stated is None else []

    async def receive(self) -> Message:
        """Receive the next part; beyond the limits raise an HTTPException, which those who read bodies let through to the error
        handlers."""
        message = await self._receive()
        part = len(message.get("body", b""))
        self._seen += part
        self._whole = not message.get("more_body", False)
        if self._seen > self._limit:
            raise HTTPException(413, _advice(self._has_files)[0])
        try:
            _take(self._sources, part)
        except TooMany as error:
            raise HTTPException(429, str(error), {"Retry-After": str(error.retry_after_s)}) from error
        return message

    async def send(self, message: Message) -> None:
        """Pass a part of the answer on; the connection ends with the answer where the body was left unread."""
        if message["type"] == "http.response.start" and self.is_of_callers_alone and not self._whole:
            message["headers"] = [*message.get("headers", []), (b"connection", b"close")]
        await self._send(message)


def is_json(scope: Scope) -> bool:
    """Decide whether a request states that its body is a JSON document."""
    kind = dict(scope["headers"]).get(b"content-type", b"").partition(b";")[0].strip().lower()
    return bool(kind == b"application/json" or kind.endswith(b"+json"))


def _take(sources: list[str], size: int) -> None:
    for i, source in enumerate(sources):
        if wait_s := sent.take(source, size):
            for earlier in sources[:i]:
                sent.give_back(earlier, size)
            raise TooMany(
                f"More than {get_settings().upload_gib_per_hour:g} GiB of files came from here within an hour.",
                f"Wait {in_words(wait_s)} and send this again, or have BETALOOP_UPLOAD_GIB_PER_HOUR raised.",
                wait_s,
            )


def _advice(has_files: bool) -> tuple[str, str]:
    """Describe what is wrong and what to do about it."""
    if has_files:
        return (
            f"The request is larger than {get_settings().upload_limit_mb} MiB.",
            "Split the upload, or have BETALOOP_UPLOAD_LIMIT_MB raised.",
        )
    return "The request is larger than 1 MiB and has no file in it.", "Send recordings and policies as files (multipart/form-data)."


# A JSON document that states a member twice is refused: parsers take the last one silently, and who sent it meant one of the two.

AT_ONCE_BYTES = 1 << 16
"""Up to which a document is looked through where it came, which takes 2 ms at most; larger ones in a thread of their own."""


class _Doubled(dict[str, Any]):
    """An object of which a member was stated twice."""

    name = ""


def doubled_member(body: bytes) -> tuple[str, str] | None:
    """Find an object of a JSON document with a member stated twice: where it is, and which. None where there is none, or this is no
    JSON."""
    found: list[_Doubled] = []

    def members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        made = dict(pairs)
        if len(made) == len(pairs):
            return made
        doubled, names = _Doubled(made), [name for name, _ in pairs]
        doubled.name = next(name for i, name in enumerate(names) if name in names[:i])
        found.append(doubled)
        return doubled

    try:
        document = json.loads(body, object_pairs_hook=members)
    except (ValueError, RecursionError):
        return None  # what reads it next says what is wrong
    return _place(document) if found else None


def _place(document: Any) -> tuple[str, str]:
    """Locate the outermost doubled member, as errors of validation name places."""
    waiting: list[tuple[str, Any]] = [("body", document)]
    for where, part in waiting:
        if isinstance(part, _Doubled):
            return where, part.name
        inside = part.items() if isinstance(part, dict) else enumerate(part) if isinstance(part, list) else ()
        waiting.extend((f"{where} > {name}", value) for name, value in inside if isinstance(value, dict | list))
    raise AssertionError("what was found is part of the document")


class UniqueMembers:
    """ASGI middleware, inside that which limits bodies and asks whose they are: reads JSON whole, and refuses a doubled member."""

    def __init__(self, app: ASGIApp, refusal: Refusal) -> None:
        self.app = app
        self.refusal = refusal

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on as it came, or answer 422."""
        if scope["type"] != "http" or not is_json(scope):
            await self.app(scope, receive, send)
            return
        came, failure = await _receive_body(receive)
        body = b"".join(message.get("body", b"") for message in came)
        doubled = await run_in_threadpool(doubled_member, body) if len(body) > AT_ONCE_BYTES else doubled_member(body)
        if doubled is not None:
            response = await self.refusal(Request(scope), _refusal(*doubled))
            await response(scope, receive, send)
            return
        again = iter(came)

        async def receive_again() -> Message:
            if (message := next(again, None)) is not None:
                return message
            if failure is not None:
                raise failure
            return await receive()

        await self.app(scope, receive_again, send)


async def _receive_body(receive: Receive) -> tuple[list[Message], HTTPException | None]:
    """Receive the parts of a body. What broke it off is raised where it is read, whose handlers know it."""
    came: list[Message] = []
    try:
        while not came or came[-1].get("more_body", False):
            came.append(await receive())
    except HTTPException as error:
        return came, error
    return came, None


def _refusal(where: str, name: str) -> Invalid:
    shown = name[:80]
    return Invalid(
        f"{where} has the member '{shown}' more than once.",
        "State it once, with the value that is meant, and send it again.",
        errors=[{"where": f"{where} > {shown}", "what": "stated more than once"}],
    )
