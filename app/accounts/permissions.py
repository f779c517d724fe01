"""Permissions: one table of who may do what, one function that asks it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime, timedelta

from app.platform.database import now
from app.platform.errors import Forbidden, NotFound
from app.tables.accounts import Role, Scope

STUDY_ENDED_HINT = "An administrator of the study can open it again."
CONFIRMED_FOR = timedelta(minutes=5)
"""A confirmation by the sign-on that is older signs nothing."""

READ = "read"
READ_ARMS = "arms:read"  # which controller a session had, also before its visit is locked
WRITE_STUDY = "study:write"  # participants, visits, sessions, QoCs
WRITE_QOC = "qoc:write"
LOCK_VISIT = "visit:lock"
ASK_QUERIES = "queries:ask"  # open and close questions about values; answering them is WRITE_STUDY
WRITE_SETTINGS = "settings:write"
UPLOAD = "upload"
DECIDE_QUARANTINE = "quarantine:decide"  # may see what could not be freed of identity
RUN_JOBS = "jobs:run"
WRITE_POLICIES = "policies:write"
DRAFT_PLAN = "plan:draft"
SIGN_PLAN = "plan:sign"  # and overrule what speaks against a policy of it
OPEN_KEY = "key:open"  # of a blinded plan, and let it be drafted again
RELEASE = "policies:release"
DECIDE_GATE = "gate:decide"  # whether sessions of learned policies may be learned from
CLEAR_EVENT = "events:clear"
SET_MARGINS = "margins:set"  # and lock them
TAKE_BUNDLES = "bundles:take"  # a signed controller: each one taken is stored and recorded
READ_AUDIT = "audit:read"
MANAGE_ACCOUNTS = "accounts:write"

AFTER_END = frozenset({READ, READ_ARMS, READ_AUDIT, MANAGE_ACCOUNTS})
"""What is left of every role in a study that has ended: to read, and for administrators to open it again."""

_BLINDED = frozenset({READ, WRITE_QOC})
_VIEWER = frozenset({READ, READ_ARMS})
_STAFF = _VIEWER | {WRITE_STUDY, WRITE_QOC, WRITE_SETTINGS, UPLOAD, RUN_JOBS, DRAFT_PLAN, TAKE_BUNDLES, READ_AUDIT}
_SIGNATURES = {SIGN_PLAN, OPEN_KEY, RELEASE, DECIDE_GATE, CLEAR_EVENT, SET_MARGINS}
_CLINICIAN = _STAFF | _SIGNATURES | {DECIDE_QUARANTINE, LOCK_VISIT, ASK_QUERIES}
_ENGINEER = _STAFF | {WRITE_POLICIES}
PERMISSIONS: dict[Role, frozenset[str]] = {
    Role.BLINDED_ASSESSOR: _BLINDED,
    Role.VIEWER: _VIEWER,
    Role.MONITOR: _VIEWER | {READ_AUDIT, ASK_QUERIES},
    Role.COORDINATOR: _VIEWER | {WRITE_STUDY, WRITE_QOC, UPLOAD, READ_AUDIT, ASK_QUERIES},
    Role.CLINICIAN: _CLINICIAN,
    Role.ENGINEER: _ENGINEER,
    Role.ADMIN: _CLINICIAN | _ENGINEER | {MANAGE_ACCOUNTS},
}

SCOPES: dict[Scope, frozenset[str] | None] = {
    Scope.FULL: None,
    Scope.READ: _VIEWER,
    Scope.UPLOAD: _VIEWER | {UPLOAD},
    Scope.JOBS: _VIEWER | {RUN_JOBS},
    Scope.METRICS: frozenset(),
}
"""The permissions that a token's scope leaves of its user's; None leaves all. Blinding follows the role alone."""


@dataclass(frozen=True)
class Grant:
    """A role in a study, at one site of it or (site_id None) at all. `ended`: the study has."""

    study_id: int
    site_id: int | None
    role: Role
    ended: bool = False

    def holds(self, permission: str) -> bool:
        """Decide whether the role includes a permission and the study has not ended, or the permission outlasts studies."""
        return permission in PERMISSIONS[self.role] and (not self.ended or permission in AFTER_END)

    def covers(self, study_id: int | None, site_id: int | None) -> bool:
        """Decide whether this is of a study, and of a site of it; None is every one."""
        return study_id in (None, self.study_id) and (site_id is None or self.site_id in (None, site_id))


@dataclass(frozen=True)
class Caller:
    """The acting user: a signed-in one, a token's owner, or the system itself.

    `may` and `require` take the site that the row belongs to; rows the caller may not even read look as if they did not exist.
    """

    label: str
    user_id: int | None
    grants: tuple[Grant, ...]
    is_system: bool = False
    token_scope: Scope | None = None
    """Of the API token that the request came with; None for a browser session."""
    sign_in_id: int | None = None
    """Of the browser session; None for a token."""
    confirmed_at: datetime | None = None
    """When the user showed at the sign-on, in this browser session, who they are, to sign something with it."""

    @property
    def confirmed_until(self) -> datetime | None:
        """Until when the user may sign with that confirmation instead of the password; None where there is none, or an old one."""
        ends = self.confirmed_at + CONFIRMED_FOR if self.confirmed_at is not None else None
        return ends if ends is not None and ends > now() else None

    def may(self, permission: str, study_id: int | None = None, site_id: int | None = None) -> bool:
        """Decide whether some grant that covers the site has the permission; without a study: whether any grant does."""
        if self.is_system:
            return True
        return any(g.covers(study_id, site_id) for g in self.grants_with(permission))

    def grants_with(self, permission: str) -> tuple[Grant, ...]:
        """List the grants that have a permission, as far as the scope of the token allows it. They also show where it applies."""
        left = SCOPES[self.token_scope] if self.token_scope is not None else None
        if left is not None and permission not in left:
            return ()
        return tuple(g for g in self.grants if g.holds(permission))

    def require(self, permission: str, study_id: int | None = None, site_id: int | None = None) -> None:
        """Raise NotFound for what the caller may not see, Forbidden for what it may see but not do."""
        if self.may(permission, study_id, site_id):
            return
        if study_id is not None and not self.may(READ, study_id, site_id):
            raise NotFound("There is no such record, or you have no access to it.")
        if self.token_scope not in (None, Scope.FULL):
            raise Forbidden(f"A token for '{self.token_scope}' may not do this ('{permission}').", "Make one with a wider scope.")
        if any(g.ended and permission in PERMISSIONS[g.role] and g.covers(study_id, site_id) for g in self.grants):
            raise Forbidden("The study has ended: it is read and exported, and nothing in it changes.", STUDY_ENDED_HINT)
        raise Forbidden(f"Your role does not include '{permission}'.", "Ask an administrator of the study for a role that does.")

    def require_browser(self) -> None:
        """Raise Forbidden for a token: passwords, tokens and accounts are changed by people who have signed in."""
        if self.token_scope is not None:
            raise Forbidden("A token may not change passwords, tokens or accounts.", "Sign in with a browser.")

    @property
    def is_blinded(self) -> bool:
        """True where the caller is a blinded assessor anywhere: then only what `app.accounts.permissions` lists is open to them."""
        return any(g.role is Role.BLINDED_ASSESSOR for g in self.grants)

    def may_open(self, url: str, study_id: int | None = None, site_id: int | None = None) -> bool:
        """Decide whether a page opens for this caller, at a site or, without one, at any."""
        path = re.split("[?#]", url)[0]
        needed = next((permission for pattern, permission in _PAGE_NEEDS if pattern.fullmatch(path)), READ)
        return (not self.is_blinded or is_open("GET", path)) and self.may(needed, study_id, site_id)

    @property
    def role(self) -> Role | None:
        """The strongest role, for display."""
        order = list(Role)
        return max((g.role for g in self.grants), key=order.index, default=None)


SYSTEM = Caller(label="system", user_id=None, grants=(), is_system=True)


# Pages and routes open to a blinded assessor. Everything else is closed, so that a new page or route cannot give a controller away by
# mistake.

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


# Pages that ask for more than to read. Links are shown to those alone whom their page does not refuse.

_PAGE_NEEDS = tuple(
    (re.compile(path), permission)
    for path, permission in (
        ("/accounts|/studies", MANAGE_ACCOUNTS),
        (r"/audit(\.csv)?", READ_AUDIT),
        ("/participants/new|/participants/[^/]+/visits/new", WRITE_STUDY),
        ("/participants/[^/]+/upload", UPLOAD),
        ("/participants/[^/]+/next-generation", RUN_JOBS),
        (r"/participants/[^/]+/policies/[0-9]+/threshold-rule\.pdf", TAKE_BUNDLES),
        ("/uploaded-files/[0-9]+/mapping", UPLOAD),
    )
)
