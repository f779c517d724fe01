"""Static files of a package, sent compressed: the chart library is 4.8 MB, a third of that as gzip."""

from __future__ import annotations

import gzip
import os
from functools import lru_cache
from pathlib import Path
from typing import Any

from fastapi.responses import FileResponse, Response
from fastapi.staticfiles import StaticFiles
from starlette.datastructures import Headers
from starlette.staticfiles import NotModifiedResponse
from starlette.types import Scope

from app.settings import get_settings

_LARGE = 1 << 16


class CompressedFiles(StaticFiles):
    """Static files of which large scripts are compressed once, kept in the data folder, and sent to whoever takes gzip."""

    def file_response(self, full_path: Any, stat_result: os.stat_result, scope: Scope, status_code: int = 200) -> Response:
        """The file, or its compressed twin under the file's own type."""
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
