"""Pages for those who build on betaloop: the REST interface from its own description, and, in development, the set of components."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from app.accounts.deps import CurrentCaller
from app.platform.errors import NotFound
from app.platform.web.charts import CONTROLLERS, Chart, axis, figure, horizontal, marker
from app.platform.web.templates import render
from app.settings import get_settings

pages = APIRouter()

_METHODS = ("get", "post", "put", "patch", "delete")
_PREFIX = "/api/v1/"


@dataclass(frozen=True)
class Member:
    """A parameter, or a member of an object: its type in words, and what it means."""

    name: str
    type: str
    required: bool
    about: str


@dataclass(frozen=True)
class Operation:
    """One route. `answer`: type of what it gives where all is right."""

    method: str
    path: str
    about: str
    parameters: tuple[Member, ...]
    body: str
    answer: str


def operations(document: Mapping[str, Any]) -> dict[str, list[Operation]]:
    """Group the routes of an OpenAPI document by the first part of their path."""
    found: dict[str, list[Operation]] = {}
    for path, entry in document["paths"].items():
        for method in _METHODS:
            if method in entry:
                found.setdefault(path.removeprefix(_PREFIX).strip("/").partition("/")[0], []).append(
                    _operation(method, path, entry[method])
                )
    return dict(sorted(found.items()))


def schemas(document: Mapping[str, Any]) -> dict[str, list[Member]]:
    """List the members of every named object."""
    named = document.get("components", {}).get("schemas", {})
    return {name: _members(schema) for name, schema in sorted(named.items()) if schema.get("properties")}


def type_in_words(schema: Mapping[str, Any]) -> str:
    """Write a schema's type for people: `text`, `list of number`, `Job or null`."""
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if alternatives := schema.get("anyOf") or schema.get("oneOf"):
        return " or ".join(dict.fromkeys(type_in_words(s) for s in alternatives))
    if "enum" in schema:
        return " | ".join(str(v) for v in schema["enum"])
    if "const" in schema:
        return str(schema["const"])
    if schema.get("type") == "array":
        return f"list of {type_in_words(schema.get('items', {}))}"
    names = {"string": "text", "integer": "whole number", "boolean": "true or false", "object": "object"}
    kind = str(schema.get("type", "any"))
    return {"date": "date", "date-time": "time", "binary": "file"}.get(str(schema.get("format")), names.get(kind, kind))


@pages.get("/api-reference")
def api_reference(request: Request, _: CurrentCaller) -> HTMLResponse:
    """Show every route of the REST interface with its parameters, and every object that it takes or gives."""
    document = request.app.openapi()
    return HTMLResponse(render(request, "overview/api_reference.html", groups=operations(document), schemas=schemas(document)))


@pages.get("/styleguide")
def styleguide(request: Request, _: CurrentCaller) -> HTMLResponse:
    """Show the set of components with the rules of writing pages; only in development."""
    if not get_settings().development:
        raise NotFound("The style guide is shown in development mode alone.", "Start the service with BETALOOP_DEVELOPMENT=true.")
    return HTMLResponse(render(request, "overview/styleguide.html", controllers=CONTROLLERS, example=_example()))


def _operation(method: str, path: str, entry: Mapping[str, Any]) -> Operation:
    parameters = tuple(
        Member(p["name"], type_in_words(p.get("schema", {})), bool(p.get("required")), p.get("description", ""))
        for p in entry.get("parameters", ())
    )
    right = min((s for s in entry["responses"] if s < "400"), default="")
    body = _content(entry.get("requestBody", {}))
    return Operation(method.upper(), path, entry.get("description", ""), parameters, body, _content(entry["responses"].get(right, {})))


def _content(holder: Mapping[str, Any]) -> str:
    return ", ".join(type_in_words(c["schema"]) if c.get("schema") else kind for kind, c in holder.get("content", {}).items())


def _members(schema: Mapping[str, Any]) -> list[Member]:
    required = set(schema.get("required", ()))
    return [
        Member(name, type_in_words(inner), name in required, inner.get("description", "")) for name, inner in schema["properties"].items()
    ]


def _example() -> Chart:
    minutes, beta = [0.0, 2.0, 4.0, 6.0, 8.0], [1.2, 1.6, 1.1, 0.9, 1.3]
    line, label = horizontal(1.4, "threshold 1.4 uV")
    trace = {"type": "scatter", "mode": "lines+markers", "name": "Beta", "x": minutes, "y": beta, "marker": marker("cdbs")}
    layout = {"xaxis": axis("Time in session", "min"), "yaxis": axis("Beta amplitude", "uV"), "shapes": [line], "annotations": [label]}
    rows = [list(pair) for pair in zip(minutes, beta, strict=True)]
    return Chart(
        "example", "Beta amplitude", "uV over 2 s · n = 5 steps", figure([trace], **layout), ("Time (min)", "Beta (uV)"), rows, 220
    )
