"""The OpenAPI document: what routes say of themselves, and the problems that stand before every route and are documented here alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

_PROBLEM = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
_READING = {"get", "head", "options"}
_OF_A_BODY = {
    400: "The body cannot be read: it is no JSON in UTF-8 (nested less than a thousand deep, numbers of ordinary length), no whole form,"
    " or ended early.",
}
_OF_WRITING = {
    413: "The body is larger than this kind of request may have.",
    429: "Too many tries, or too much was sent from here lately; `Retry-After` says when another try makes sense.",
}
_OF_THE_DATABASE = {503: "The database does not answer for the moment, or this was given up for another request; try again later."}
_OF_THE_DISK = {507: "No room is left on the disk; what was stored before is safe."}
_FRAMEWORKS_OWN = ("HTTPValidationError", "ValidationError")


def describe(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document of a service; problems are application/problem+json, and FastAPI's own validation schema is left out."""
    document = get_openapi(title=app.title, version=app.version, routes=app.routes, description="REST interface of a betaloop study.")
    for operations in document["paths"].values():
        for method, operation in operations.items():
            responses = operation["responses"]
            for status, words in _everywhere(method, operation):
                responses.setdefault(str(status), {"description": words})
            for status, response in responses.items():
                if int(status) >= 400:
                    response["content"] = _PROBLEM
    for unused in _FRAMEWORKS_OWN:
        document.get("components", {}).get("schemas", {}).pop(unused, None)
    return document


def _everywhere(method: str, operation: dict[str, Any]) -> Iterator[tuple[int, str]]:
    """What an operation may answer before, or whatever, its route does: status and words."""
    yield from _OF_THE_DATABASE.items()
    if "security" in operation:  # who calls is looked up, and their token's last use is written down, when somebody only reads
        yield from _OF_THE_DISK.items()
    if method not in _READING:
        yield from _OF_WRITING.items()
    if "requestBody" in operation:
        yield from _OF_A_BODY.items()
