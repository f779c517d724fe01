"""Answers compressed on their way out: pages and JSON shrink to a fifth.

A page that holds a secret beside text that a stranger chooses tells the secret by its compressed length (BREACH). Such a stranger needs the
reader's browser to send many requests from another site, and the browser says where a request comes from. What another site asked for is
therefore sent as it is; so is an answer to a browser that does not say, where sign-in cookies travel over TLS. Pages hold no token of their
own: requests from other sites are refused by the same header (`app.platform.web.middleware`).
"""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

from app.settings import get_settings

_LEAST_BYTES = 1 << 10
_LEVEL = 6  # level 9 takes twice the time for 1 % fewer bytes
_COMPRESSED_ALREADY = (*DEFAULT_EXCLUDED_CONTENT_TYPES, "application/pdf", "application/octet-stream")


class Compression:
    """ASGI middleware: gzip for text that one of our own pages, or a program, asked for; event streams stay as they are."""

    def __init__(self, app: ASGIApp) -> None:
        self.plain = app
        self.compressed = GZipMiddleware(app, _LEAST_BYTES, _LEVEL, exclude_content_types=_COMPRESSED_ALREADY)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        compress = scope["type"] == "http" and _asked_by_ourselves(Headers(scope=scope))
        await (self.compressed if compress else self.plain)(scope, receive, send)


def _asked_by_ourselves(headers: Headers) -> bool:
    site = headers.get("sec-fetch-site")
    if site is None:
        return "cookie" not in headers or not get_settings().cookie_secure
    return site in ("same-origin", "none")
