"""Additions to the page of an error: what to do, and everything that had been typed, so that no entry is lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote, urlencode

from fastapi import Request
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from app.platform.web.forms import WRITTEN_BY, written_by

_PLAIN_FORM = "application/x-www-form-urlencoded"
_SECRET = "password"  # noqa: S105 - the name of a field

_ADVICE = {
    404: ("There is no such page", "The address may be mistyped; or what it named is gone, or lies outside your study or site."),
    405: ("This address takes no such request", "Open the page it belongs to and use its buttons."),
    413: ("Too large to take", "Go back and choose less at once."),
    422: ("Something in this request cannot be used", "Open the page from a link of betaloop, or correct what is named and send it again."),
}


ADDRESS_ALONE = {404, 405}
"""Of the framework's own errors those that say no more than that the address is wrong."""


def writer_of(request: Request) -> int | None:
    """Find who entered the content of a form: as the form says, else who has signed in, else whose sign-in has just ended."""
    caller = getattr(request.state, "caller", None)
    last = getattr(request.state, "last_caller", None)
    return written_by(request) or (caller.user_id if caller is not None else last)


def send_again_to(request: Request, writer: int) -> str:
    """Build the address to which the page of an error sends what was entered: the form's own with its query, and whose entries they are.

    It begins with one slash, because what begins with two is another host's.
    """
    query = [(name, value) for name, value in request.query_params.multi_items() if name != WRITTEN_BY]
    return "/" + quote(request.scope["path"].lstrip("/")) + "?" + urlencode([*query, (WRITTEN_BY, writer)])


def advised(status: int, title: str, has_entries: bool, writer: int | None) -> tuple[str, str]:
    """Choose the heading of an error's page, and what to do where the error itself does not say."""
    if status == 401:
        again = "Then send what you had entered from here." if writer else "Then open the form anew and enter this again."
        kept = f" {again}" if has_entries else ""
        return "Your sign-in has expired", f"Sign in again in a new window.{kept}"
    return _ADVICE.get(status, (title, ""))


_WANTED = {"int_parsing": "a whole number", "int_type": "a whole number", "float_parsing": "a number", "bool_parsing": "yes or no"}


def input_in_words(errors: Sequence[Mapping[str, Any]]) -> str:
    """Describe what is wrong with an address or a form, from the errors of its validation (pydantic's), without the names of types and
    members."""
    return " ".join(_sentence(error) for error in errors[:5])


def _sentence(error: Mapping[str, Any]) -> str:
    given, name = str(error.get("input"))[:80], str(error["loc"][-1]).replace("_", " ")
    wanted = _WANTED.get(str(error["type"]))
    if error["loc"][0] == "path":
        return f"The address has \u201c{given}\u201d where {wanted or f'another {name}'} belongs."
    return f"\u201c{given}\u201d cannot be taken for {name}" + (f": {wanted} belongs there." if wanted else f": {error['msg']}.")


async def kept_entries(request: Request) -> list[tuple[str, str]]:
    """List names and values of a plain form that was sent, in its order, without passwords. Empty for other requests."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if request.method != "POST" or media_type != _PLAIN_FORM:
        return []
    try:
        form = await request.form(max_files=0, max_fields=2000)
    except (RuntimeError, ClientDisconnect, HTTPException):
        return []  # the body went another way, is broken, or larger than any form: there is nothing to keep
    return [(name, value) for name, value in form.multi_items() if isinstance(value, str) and _SECRET not in name]
