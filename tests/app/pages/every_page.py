"""An address for every page of the service, on the study of `tests.app.every_route`."""

from __future__ import annotations

from typing import Any

from fastapi.routing import iter_route_contexts

from tests.app.every_route import World

ELSEWHERE = {
    "/sign-on": "leads to the hospital's sign-on, which this study has none of",
    "/sign-on/confirm": "the same",
    "/sign-on/return": "the same",
    "/sign-on/end": "the same",
    "/visit-day/files/{path:path}": "a script or a style of the day page, by its name",
}
"""Addresses without /api that no page stands at, or none without what other tests bring along."""
QUERIES = {"/search": "?q=rl", "/participants/{code}/compare": "?session=1&policy=15&policy=14"}


def routes(app: Any) -> list[str]:
    """Every address that a browser may open, less the REST interface's and what operates the service."""
    found = {c.path for c in iter_route_contexts(app.routes) if c.path and "GET" in (getattr(c, "methods", None) or ())}
    return sorted(p for p in found if not p.startswith(("/api/", "/healthz", "/readyz", "/metrics")))


def addresses(world: World) -> dict[str, str]:
    """By route: the address of a page that has something to show, for everything that a browser may open."""
    own: dict[str, dict[str, Any]] = {
        "/participants/{code}/ranking": {"code": "P2"},
        "/participants/{code}/proposals": {"code": "P4"},
        "/participants/{code}/quarantine": {"code": "P4"},
        "/participants/{code}/jobs": {"code": "P4"},
        "/participants/{code}/analyses/visits/{key}": {"key": "distilled"},
        "/participants/{code}/analyses/models/{key}": {"key": "distilled"},
        "/proposals/{session_id}": world.ids_of("get", "/api/v1/proposals/{session_id}"),
        "/sessions/{session_id}/signal": world.ids_of("get", "/api/v1/sessions/{session_id}/signal"),
        "/sessions/{session_id}/signal.json": world.ids_of("get", "/api/v1/sessions/{session_id}/signal"),
        "/uploaded-files/{file_id}/mapping": world.ids_of("get", "/api/v1/uploaded-files/{file_id}/preview"),
        "/visits/{visit_id}/plan": world.ids_of("get", "/api/v1/visits/{visit_id}/plan"),
        "/visits/{visit_id}/slots": world.ids_of("get", "/api/v1/visits/{visit_id}/slots"),
        "/visits/{visit_id}/bundles": world.ids_of("get", "/api/v1/visits/{visit_id}/day"),
        "/visit-day/{visit_id}": world.ids_of("get", "/api/v1/visits/{visit_id}/day"),
    }
    paths = [p for p in routes(world.app) if p not in ELSEWHERE]
    return {p: p.format(**(world.ids | own.get(p, {}))) + QUERIES.get(p, "") for p in paths}
