"""Pages and routes open to a blinded assessor. Everything else is closed, so that a new page or route cannot give a controller away by
mistake."""

from __future__ import annotations

import re

OPEN = (
    ("GET", "/"),
    ("GET", "/account"),
    ("POST", "/account/.*"),
    ("POST", "/sign-out"),
    ("GET", "(/api/v1)?/participants"),
    ("GET", "(/api/v1)?/participants/[^/]+"),
    ("GET", "(/api/v1)?/participants/[^/]+/visits"),
    ("GET", "(/api/v1)?/participants/[^/]+/analyses(/.*)?"),
    ("GET", "(/api/v1)?/analyses(/.*)?"),
    ("GET", "/trial-time"),
    ("GET", "/glossary"),
    ("GET", "/energy-saved"),
    ("GET", "/api-reference"),
    ("GET", "/api/v1/openapi.json"),
    ("GET", "(/api/v1)?/visits/[0-9]+"),
    ("GET", "/api/v1/visits/[0-9]+/(sessions|locks)"),
    ("GET", "(/api/v1)?/sessions/[0-9]+"),
    ("GET", "/api/v1/sessions/[0-9]+/(qoc|outcomes|trace)"),
    ("PUT", "/api/v1/sessions/[0-9]+/qoc"),
    ("POST", "/sessions/[0-9]+/qoc"),
    ("POST", "/api/v1/participants/[^/]+/adverse-events"),
    ("GET", "/visit-day/(key|[0-9]+)"),
    ("POST", "/visit-day/[0-9]+"),
    ("GET", "/api/v1/visits/[0-9]+/day(/entries)?"),
    ("POST", "/api/v1/visits/[0-9]+/day/entries"),
)
"""Method and path, as a regular expression. What these show of a visit that is not locked goes through `app.study.blinding`."""

_PATTERNS = [(method, re.compile(path)) for method, path in OPEN]


def is_open(method: str, path: str) -> bool:
    """Decide whether a blinded assessor may call this."""
    return any(m == ("GET" if method == "HEAD" else method) and p.fullmatch(path) for m, p in _PATTERNS)
