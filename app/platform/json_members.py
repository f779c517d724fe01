"""A JSON document that states a member twice is refused: parsers take the last one silently, and who sent it meant one of the two."""

from __future__ import annotations

import json
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.platform.errors import Invalid
from app.platform.web.body_limit import Refusal, is_json

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
