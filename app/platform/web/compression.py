"""Answers compressed on their way out: pages and JSON shrink to a fifth, and large scripts of packages are compressed once and kept.

A page with a secret and with text that a stranger chooses reveals the secret by its compressed length (BREACH). Such a stranger needs the
reader's browser to send many requests from another site, and the browser states where a request comes from. What another site requested is
therefore sent uncompressed. So is an answer to a browser that does not state it, where sign-in cookies travel over TLS. Pages have no token
of their own: the same header refuses requests from other sites (`app.platform.web.middleware`).
"""

from __future__ import annotations

import gzip
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

from fastapi.responses import FileResponse, Response
from fastapi.staticfiles import StaticFiles
from starlette.datastructures import Headers
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.staticfiles import NotModifiedResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from app.settings import get_settings

_LEAST_BYTES = 1 << 10
_LARGE = 1 << 16
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


class CompressedFiles(StaticFiles):
    """Static files of which large scripts are compressed once, stored in the data folder, and sent to clients that accept gzip."""

    def file_response(self, full_path: Any, stat_result: os.stat_result, scope: Scope, status_code: int = 200) -> Response:
        """Answer with the file, or with its compressed twin under the file's own type."""
        path = Path(full_path)
        takes = any("gzip" in part and "q=0" not in part for part in Headers(scope=scope).get("accept-encoding", "").split(","))
        response: Response
        if takes and path.suffix == ".js" and stat_result.st_size >= _LARGE:
            twin = _twin(path, stat_result.st_mtime_ns, stat_result.st_size, get_settings().data_dir)
            response = FileResponse(twin, status_code, {"Content-Encoding": "gzip"}, "text/javascript", stat_result=twin.stat())
            if self.is_not_modified(response.headers, Headers(scope=scope)):
                response = NotModifiedResponse(response.headers)
        else:
            response = super().file_response(full_path, stat_result, scope, status_code)
        response.headers["Vary"] = "Accept-Encoding"
        response.headers["Cache-Control"] = "public, max-age=31536000, immutable"
        return response


@lru_cache(maxsize=16)
def _twin(path: Path, changed_ns: int, size: int, data_dir: Path) -> Path:
    folder = data_dir / "cache"
    folder.mkdir(parents=True, exist_ok=True)
    twin = folder / f"{path.name}.{changed_ns:x}-{size:x}.gz"
    if not twin.exists():
        draft = twin.with_name(f".{twin.name}.{os.getpid()}")
        draft.write_bytes(gzip.compress(path.read_bytes(), compresslevel=6, mtime=0))
        draft.replace(twin)
    return twin
