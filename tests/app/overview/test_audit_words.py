"""The audit trail says in words what each change means, and names a request by its most telling change."""

from __future__ import annotations

import re
from typing import Any

import pytest
from sqlalchemy import true

from app.accounts.permissions import SYSTEM
from app.overview.trail import headline, lines, sentence
from app.overview.trail_changes import ACCOMPANY, SAID
from app.overview.trail_rows import Names, batches
from app.overview.trail_scope import TrailFilter
from app.platform.audit import AUDITED
from app.platform.database import new_session
from app.tables.audit import AuditEvent
from tests.app.every_route import World

QUERY = {"id": 8, "participant_id": 1, "session_id": 7, "upload_id": None, "field": "rating"}
NAMES = Names(
    participants={1: "P1"},
    visits={4: (2, 1)},
    sessions={7: (3, 4)},
    plans={9: 4},
    policies={5: ("rl-01", 1)},
    items={6: (1, 9)},
    events={2: (1, 4)},
    queries={8: QUERY},
    locks={3: 4},
    margins_locks={3: 1},
    people={2: "ada@clinic.example"},
    studies={1: "main"},
    sites={1: "south"},
    sweeps={1: ("rl-03", 1)},
)


def event(entity: str, before: dict[str, Any] | None, after: dict[str, Any] | None, number: int = 1) -> AuditEvent:
    action = "insert" if before is None else "delete" if after is None else "update"
    return AuditEvent(id=number, entity=entity, entity_id="1", action=action, before=before, after=after, actor="ada")


def recorded(action: str, entity: str, entity_id: str) -> AuditEvent:
    return AuditEvent(id=1, entity=entity, entity_id=entity_id, action=action, actor="ada")


DRAFT = {"id": 9, "visit_id": 4, "status": "draft"}
DOSE = {"drug": "levodopa", "visit_id": 4}
REVISION = {"event_id": 2, "revision": 1, "kind": "fall", "cleared_reason": None}
MEMBER = {"user_id": 2, "study_id": 1, "site_id": None, "role": "viewer"}
FILE = {"id": 1, "upload_id": 2, "reviewed_at": None}
JOB = {"participant_id": 1, "status": "queued"}
AMPLITUDE = {"visit_id": 4, "hemisphere": "left", "program": 0, "amplitude_ma": 2.5, "removed_at": None}
GONE = {"removed_at": "2026-03-02"}
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
        (recorded("accept", "audit_event", "17"), "accepted that row 17 of the trail has a false time"),
        (recorded("refuse", "sign_on", "eve@clinic.example"), "refused a sign-on of eve@clinic.example"),
        (recorded("view", "visit", "4"), "looked at the sessions and results of visit 2 of P1"),
        (recorded("view", "session", "7"), "looked at the results of session 3 of visit 2 of P1"),
        (recorded("view", "sweep", "1"), "looked at rl-03 of P1"),
        (recorded("view", "results", "/participants/P1"), "looked at the results of P1"),
        (recorded("view", "results", "/participants/P1/policies/5"), "looked at the results of policy rl-01 of P1"),
        (recorded("view", "results", "/energy-saved"), "looked at the results of all participants: energy saved"),
        (recorded("export", "results", "/participants/P1/ranking.csv"), "exported the results of P1: ranking as CSV"),
        (recorded("export", "upload_file", "3"), "took the original of file 3"),
        (recorded("export", "audit", "trail"), "exported the audit trail"),
        (event("session_segment", None, {"session_id": 7}), "gave a part of a recording to session 3 of visit 2 of P1"),
        (event("adverse_event", None, {"participant_id": 1, "visit_id": 4}), "wrote down an adverse event of P1 at visit 2"),
        (event("adverse_event", None, {"participant_id": 1, "visit_id": None}), "wrote down an adverse event of P1"),
        (event("adverse_event_revision", None, REVISION), "wrote down an adverse event (fall) of P1 at visit 2"),
        (event("adverse_event_revision", None, REVISION | {"revision": 2}), "corrected an adverse event (fall) of P1 at visit 2"),
        (event("adverse_event_revision", None, REVISION | {"cleared_reason": "x"}), "cleared an adverse event (fall) of P1 at visit 2"),
        (event("data_query", None, QUERY), "asked a data query on rating of session 3 of visit 2 of P1"),
        (
            event("data_query", None, QUERY | {"session_id": None, "visit_id": 4, "field": "cdbs_left"}),
            "asked a data query on cDBS amplitude, left of visit 2 of P1",
        ),
        (
            event("data_query", None, QUERY | {"session_id": None, "event_id": 2, "field": "severity"}),
            "asked a data query on severity of an adverse event of P1 at visit 2",
        ),
        (
            event("data_query", None, QUERY | {"session_id": None, "record": "settings", "field": "xi_beta"}),
            "asked a data query on beta threshold in the settings of P1",
        ),
        (
            event("data_query_entry", None, {"query_id": 8, "state": "answered"}),
            "answered data query 8 on rating of session 3 of visit 2 of P1",
        ),
        (
            event("day_entry", None, {"kind": "rating", "plan_id": 9, "plan_item_id": 6, "replaces": []}),
            "entered a rating of session 1 of plan 9 for visit 2 of P1",
        ),
        (
            event("day_entry", None, {"kind": "note", "plan_id": 9, "plan_item_id": None, "replaces": ["a"]}),
            "corrected a note on plan 9 for visit 2 of P1",
        ),
        (
            event("membership", None, {"user_id": 2, "study_id": 1, "site_id": None, "role": "blinded_assessor"}),
            "gave ada@clinic.example the role blinded assessor in study main",
        ),
        (
            event("membership", {"user_id": 2, "study_id": 1, "site_id": 1, "role": "viewer"}, None),
            "took the role viewer from ada@clinic.example in study main, site south",
        ),
        (event("membership", MEMBER, MEMBER | {"role": "monitor"}), "changed ada@clinic.example to the role monitor in study main"),
        (event("study", None, {"code": "main"}), "made the study main"),
        (event("study", {"code": "main"}, {"code": "main", "ended_at": "2026"}), "ended the study main"),
        (event("dose", None, DOSE), "wrote down a dose of levodopa at visit 2 of P1"),
        (event("dose", DOSE, DOSE | {"removed_at": "2026"}), "took back a dose of levodopa at visit 2 of P1"),
        (event("site", {"code": "south", "study_id": 1}, {"code": "south", "study_id": 1}), "changed the site south of study main"),
        (event("second_factor", None, {"user_id": 2}), "began to set up the second factor of ada@clinic.example"),
        (event("second_factor", {"user_id": 2}, {"user_id": 2, "confirmed_at": "2026"}), "set up the second factor of ada@clinic.example"),
        (event("second_factor", {"user_id": 2}, None), "removed the second factor of ada@clinic.example"),
        (event("sign_on_link", None, {"user_id": 2}), "linked the account ada@clinic.example to a sign-on"),
        (
            event("signature", None, {"subject_kind": "plan", "subject_id": 9, "meaning": "approved"}),
            "signed plan 9 for visit 2 of P1: approved",
        ),
        (
            event("signature", None, {"subject_kind": "visit_lock", "subject_id": 3, "meaning": "complete"}),
            "signed the lock of visit 2 of P1: complete",
        ),
        (
            event("signature", None, {"subject_kind": "margins_lock", "subject_id": 3, "meaning": "agreed"}),
            "signed the margins of P1: agreed",
        ),
        (
            event("signature", None, {"subject_kind": "policy", "subject_id": 5, "meaning": "released"}),
            "signed policy rl-01 of P1: released",
        ),
        (
            event("cdbs_amplitude", None, AMPLITUDE),
            "set the cDBS amplitude of visit 2 of P1 to 2.5 mA (left)",
        ),
        (
            event("cdbs_amplitude", AMPLITUDE, AMPLITUDE | GONE),
            "took back the cDBS amplitude of visit 2 of P1, 2.5 mA (left)",
        ),
        (
            event("cdbs_amplitude", AMPLITUDE | GONE, AMPLITUDE | GONE | {"visit_id": None}),
            "kept the cDBS amplitude of visit 2 of P1, 2.5 mA (left), which was taken back, without the visit",
        ),
        (
            event("cdbs_amplitude", AMPLITUDE | {"visit_id": 5} | GONE, AMPLITUDE | GONE | {"visit_id": None}),
            "kept the cDBS amplitude of a visit that is gone (5), 2.5 mA (left), which was taken back, without the visit",
        ),
        (event("device", None, {"participant_id": 1}), "took in a device of P1"),
        (event("grasp_test", None, {"session_id": 7}), "took in a grasp test of session 3 of visit 2 of P1"),
        (event("grasp_test", {"session_id": 7}, {"session_id": 7} | GONE), "took back a grasp test of session 3 of visit 2 of P1"),
        (
            event("grasp_test", {"session_id": 8} | GONE, {"session_id": None} | GONE),
            "kept a grasp test of session 8, which was taken back, without the session",
        ),
        (event("tremor_series", None, {"participant_id": 1}), "took in tremor readings of P1"),
        (event("tremor_series", {"participant_id": 1}, {"participant_id": 1} | GONE), "took back tremor readings of P1"),
        (event("session_proposal", None, {"session_id": 7}), "made the proposal of session 3 of visit 2 of P1"),
        (event("plan_item", None, {"plan_id": 9, "position": 2}), "planned session 2 of plan 9 for visit 2 of P1"),
        (event("upload_file", FILE, FILE | {"reviewed_at": "2026"}), "looked at the original of file 1 of upload 2"),
        (event("job", None, JOB | {"kind": "evaluate"}), "asked for an evaluation job of P1"),
        (event("job", None, JOB | {"kind": "train"}), "asked for a training job of P1"),
        (event("job", None, JOB | {"kind": "mean_beta"}), "asked for a mean beta job of P1"),
        (event("plan", DRAFT, None), "discarded the draft of plan 9 for visit 2 of P1"),
    ],
)
def test_a_change_is_said_in_words(changed: AuditEvent, said: str) -> None:
    assert sentence(changed, NAMES) == said


def test_every_table_of_the_trail_has_its_sentence() -> None:
    assert set(SAID) == set(AUDITED), "say in app/overview/trail_changes.py what a new row of the table means"
    assert set(SAID) > ACCOMPANY, "tables whose rows come with an act"


@pytest.mark.parametrize("name", sorted(ACCOMPANY))
def test_what_comes_with_an_act_never_names_it(name: str) -> None:
    for act in set(SAID) - ACCOMPANY:
        assert headline([event(name, None, {}, 1), event(act, None, {}, 2)]).entity == act


def test_every_row_that_a_used_study_wrote_is_told(world: World) -> None:
    """No row stops the page, and none is shown as a row."""
    with new_session() as db:
        told = [line for rows in batches(db, true(), TrailFilter()) for line in lines(db, rows, SYSTEM)]
    assert len({line.event.entity for line in told}) > 35
    plain = {line.said for line in told if re.search(r" a row of |\(None\)|\bNone\b|: [a-z_]+ [0-9]+$", line.said)}
    assert plain == set()


def test_a_request_is_named_by_its_act_and_not_by_what_hangs_on_it() -> None:
    rows = [event("session_segment", None, {}, 1), event("session", None, SESSION, 2), event("plan", None, DRAFT, 3)]
    assert headline(rows).entity == "plan"
    assert headline(rows[:2]).entity == "session"
