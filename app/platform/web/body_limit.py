"""No request body may be larger than the installation's upload limit, stated or not."""

from __future__ import annotations

import json

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.settings import get_settings

_FORM_ALLOWANCE = 1 << 20  # the form fields and boundaries around a file of the largest size


class BodyLimit:
    """ASGI middleware: refuses by the stated length before reading, and cuts off bodies that state none."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 413."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = get_settings().upload_limit_mb * 1024 * 1024 + _FORM_ALLOWANCE
        stated = dict(scope["headers"]).get(b"content-length", b"0")
        if stated.isdigit() and int(stated) > limit:
            await _refuse(send, scope["path"])
            return
        seen = 0

        async def counted() -> Message:
            nonlocal seen
            message = await receive()
            seen += len(message.get("body", b""))
            if seen > limit:
                # the reader of the form lets this one through to the error handlers
                raise HTTPException(413, f"The request is larger than {get_settings().upload_limit_mb} MiB.")
            return message

        await self.app(scope, counted, send)


async def _refuse(send: Send, path: str) -> None:
    megabytes = get_settings().upload_limit_mb
    problem = {
        "type": "about:blank",
        "title": "The file is too large",
        "status": 413,
        "detail": f"The request is larger than {megabytes} MiB.",
        "mend": "Split the upload, or have BETALOOP_UPLOAD_LIMIT_MB raised.",
        "instance": path,
    }
    headers = [(b"content-type", b"application/problem+json"), (b"connection", b"close")]
    await send({"type": "http.response.start", "status": 413, "headers": headers})
    await send({"type": "http.response.body", "body": json.dumps(problem).encode()})
