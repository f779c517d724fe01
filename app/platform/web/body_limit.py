"""No request body may be larger than its kind allows, stated or not: files up to the installation's upload limit, all else 1 MiB.

JSON and plain forms are read into memory and parsed before anybody asks who calls, hence their small limit.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.settings import get_settings

PLAIN_LIMIT = 1 << 20
"""Bytes of a JSON document or a plain form."""
Refusal = Callable[[Request, str, str], Awaitable[Response]]
"""Makes the answer to a request that is too large: what is wrong, what to do about it."""
_FORM_ALLOWANCE = 1 << 20  # the form fields and boundaries around a file of the largest size


class BodyLimit:
    """ASGI middleware: refuses by the stated length before reading, and cuts off bodies that state none."""

    def __init__(self, app: ASGIApp, refusal: Refusal) -> None:
        self.app = app
        self.refusal = refusal

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 413."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        has_files = headers.get(b"content-type", b"").lower().startswith(b"multipart/form-data")
        limit = get_settings().upload_limit_mb * 1024 * 1024 + _FORM_ALLOWANCE if has_files else PLAIN_LIMIT
        said = _said(has_files)
        stated = headers.get(b"content-length", b"0")
        if stated.isdigit() and int(stated) > limit:
            response = await self.refusal(Request(scope), *said)
            response.headers["Connection"] = "close"
            await response(scope, receive, send)
            return
        seen = 0

        async def counted() -> Message:
            nonlocal seen
            message = await receive()
            seen += len(message.get("body", b""))
            if seen > limit:
                # those who read the body let this one through to the error handlers
                raise HTTPException(413, said[0])
            return message

        await self.app(scope, counted, send)


def _said(has_files: bool) -> tuple[str, str]:
    """What is wrong and what to do about it."""
    if has_files:
        return (
            f"The request is larger than {get_settings().upload_limit_mb} MiB.",
            "Split the upload, or have BETALOOP_UPLOAD_LIMIT_MB raised.",
        )
    return "The request is larger than 1 MiB and has no file in it.", "Send recordings and policies as files (multipart/form-data)."
