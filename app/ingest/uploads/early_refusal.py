"""Uploads are refused by role before their body is read: a form is parsed before any dependency is asked, and may have gigabytes.

What is read then is encrypted on its way (`app.platform.web.forms`). Meanwhile the process that forks readers starts.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import Request, Response
from fastapi.routing import APIRoute
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.concurrency import run_in_threadpool

from app.accounts import permissions as can
from app.accounts.deps import get_caller
from app.platform.database import new_session
from app.platform.jobs.children import limited
from app.platform.web.forms import EncryptedForm

_bearer = HTTPBearer(auto_error=False)


class UploadRoute(APIRoute):
    """A route whose POST is closed to users who may upload nowhere; the endpoint checks whose participant it is."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the route's handler, after the check."""
        handle = super().get_route_handler()

        async def checked(request: Request) -> Response:
            if request.method == "POST":
                await run_in_threadpool(_check, request, await _bearer(request))
            return await handle(EncryptedForm(request.scope, request.receive))

        return checked


def _check(request: Request, bearer: HTTPAuthorizationCredentials | None) -> None:
    """Raise Unauthorized for an unknown caller, Forbidden for one whose roles do not include uploads.

    The caller is known where the size of the body was looked at just before.
    """
    caller = getattr(request.state, "caller", None)
    if caller is None:
        with new_session() as db:
            caller = get_caller(request, db, bearer)
    caller.require(can.UPLOAD)
    limited.prepare()
