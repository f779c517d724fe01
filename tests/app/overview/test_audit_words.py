"""The audit trail says in words what each change means, and names a request by its most telling change."""

from __future__ import annotations

from typing import Any

import pytest

from app.overview.trail.names import Names
from app.overview.trail.words import headline, sentence
from app.platform.audit import AuditEvent

NAMES = Names({1: "P1"}, {4: (2, 1)}, {7: (3, 4)}, {9: 4}, {5: ("rl-01", 1)})


def event(entity: str, before: dict[str, Any] | None, after: dict[str, Any] | None, number: int = 1) -> AuditEvent:
    action = "insert" if before is None else "delete" if after is None else "update"
    return AuditEvent(id=number, entity=entity, entity_id="1", action=action, before=before, after=after, actor="ada")


def recorded(action: str, entity: str, entity_id: str) -> AuditEvent:
    return AuditEvent(id=1, entity=entity, entity_id=entity_id, action=action, actor="ada")


DRAFT = {"id": 9, "visit_id": 4, "status": "draft"}
SESSION = {"id": 7, "visit_id": 4, "ordinal": 3, "status": "confirmed", "excluded_reason": None}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (event("plan", None, DRAFT), "drafted plan 9 for visit 2 of P1"),
        (event("plan", DRAFT, DRAFT | {"status": "approved"}), "approved plan 9 for visit 2 of P1"),
        (event("session", SESSION | {"status": "proposed"}, SESSION), "confirmed session 3 of visit 2 of P1"),
        (event("session", SESSION, SESSION | {"excluded_reason": "fell asleep"}), "excluded session 3 of visit 2 of P1"),
        (event("session", SESSION | {"excluded_reason": "x"}, SESSION), "included session 3 of visit 2 of P1 again"),
        (event("qoc", None, {"session_id": 7, "revision": 2}), "corrected the outcomes of session 3 of visit 2 of P1"),
        (event("visit_lock", None, {"visit_id": 4, "locked": False}), "unlocked visit 2 of P1"),
        (event("bundle_release", None, {"policy_id": 5}), "took the bundle of policy rl-01 of P1"),
        (event("settings_version", None, {"participant_id": 1, "version": 2}), "changed the settings of P1 (version 2)"),
        (event("sign_in", {"ended_at": None}, {"ended_at": "2026-03-02"}), "signed out"),
        (event("participant", {"code": "P1", "status": "active"}, {"code": "P1", "status": "withdrawn"}), "recorded that P1 has withdrawn"),
        (recorded("view", "results", "/participants/P1/analyses"), "looked at the results of P1: analyses"),
        (recorded("export", "participant", "1"), "exported the record of P1"),
        (recorded("export", "session", "7"), "exported the samples of session 3 of visit 2 of P1"),
        (recorded("download", "plan", "9"), "printed plan 9 for visit 2 of P1"),
        (recorded("refuse", "sign_in", "ada@clinic.example"), "refused a sign-in of ada@clinic.example"),
        (recorded("seize", "thing", "3"), "seize: thing 3"),
        (event("session_segment", None, {"session_id": 7}), "added a row of session segment"),
    ],
)
def test_a_change_is_said_in_words(changed: AuditEvent, said: str) -> None:
    assert sentence(changed, NAMES) == said


def test_a_request_is_named_by_its_act_and_not_by_what_hangs_on_it() -> None:
    rows = [event("session_segment", None, {}, 1), event("session", None, SESSION, 2), event("plan", None, DRAFT, 3)]
    assert headline(rows).entity == "plan"
    assert headline(rows[:2]).entity == "session"
