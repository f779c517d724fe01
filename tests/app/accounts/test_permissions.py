"""The permissions of each role and scope, written down a second time: a change is repeated here, and in the README."""

from __future__ import annotations

from app.accounts.permissions import PERMISSIONS, SCOPES
from app.tables.accounts import Role, Scope

READER = {"read", "arms:read"}
STAFF = READER | {"study:write", "qoc:write", "settings:write", "upload", "jobs:run", "plan:draft", "bundles:take", "audit:read"}
SIGNATURES = {"plan:sign", "key:open", "policies:release", "gate:decide", "events:clear", "margins:set"}
CLINICIAN = STAFF | SIGNATURES | {"quarantine:decide", "visit:lock", "queries:ask"}


def test_a_role_may_what_is_written_here() -> None:
    assert {
        Role.BLINDED_ASSESSOR: {"read", "qoc:write"},
        Role.VIEWER: READER,
        Role.MONITOR: READER | {"audit:read", "queries:ask"},
        Role.COORDINATOR: READER | {"study:write", "qoc:write", "upload", "audit:read", "queries:ask"},
        Role.CLINICIAN: CLINICIAN,
        Role.ENGINEER: STAFF | {"policies:write"},
        Role.ADMIN: CLINICIAN | {"policies:write", "accounts:write"},
    } == PERMISSIONS


def test_a_scope_leaves_what_is_written_here() -> None:
    assert {
        Scope.FULL: None,
        Scope.READ: READER,
        Scope.UPLOAD: READER | {"upload"},
        Scope.JOBS: READER | {"jobs:run"},
        Scope.METRICS: frozenset(),
    } == SCOPES
