"""The audit trail in words: what one change of a row means to a reader ("approved plan 1 of P1"), and which of several names the act."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from app.platform.audit import AuditEvent

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Names:
    """Names of the rows that changes are about, by their numbers.

    Attributes:
        participants: code. visits: number and participant. sessions: ordinal and visit. plans: visit. policies: name and participant.
    """

    participants: Mapping[int, str] = field(default_factory=dict)
    visits: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    sessions: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    plans: Mapping[int, int] = field(default_factory=dict)
    policies: Mapping[int, tuple[str, int]] = field(default_factory=dict)

    def participant(self, number: int | None) -> str:
        """Its code."""
        return self.participants.get(number or 0, f"participant {number}")

    def visit(self, number: int) -> str:
        """A visit with its participant."""
        if number not in self.visits:
            return f"a visit that is gone ({number})"
        ordinal, participant = self.visits[number]
        return f"visit {ordinal} of {self.participant(participant)}"

    def session(self, number: int, row: Row | None = None) -> str:
        """A session with its visit; `row` where the session may be gone."""
        place = self.sessions.get(number) or ((row["ordinal"], row["visit_id"]) if row and "visit_id" in row else None)
        return f"session {place[0]} of {self.visit(place[1])}" if place else f"session {number}"

    def policy(self, number: int) -> str:
        """A policy with its participant."""
        name, participant = self.policies.get(number, (f"policy {number}", None))
        return f"policy {name} of {self.participant(participant)}" if participant is not None else name


def sentence(event: AuditEvent, names: Names) -> str:
    """What a change of a row means, without its subject: the actor stands beside it."""
    before, after = event.before or {}, event.after or {}
    if event.action not in ("insert", "update", "delete"):
        return _recorded(event, names)
    said = _SAID.get(event.entity)
    return said(before, after, names) if said else _plainly(event)


def headline(events: Sequence[AuditEvent]) -> AuditEvent:
    """Of the changes of one request, the one that names the act: rows that merely hang on others do not."""
    return min(events, key=lambda e: (_ORDER.index(e.entity) if e.entity in _ORDER else len(_ORDER), e.id))


def _recorded(event: AuditEvent, names: Names) -> str:
    """What changed no row: looks, exports, refusals."""
    number = int(event.entity_id) if event.entity_id.isdecimal() else 0
    plan = names.plans.get(number)
    said = {
        ("view", "results"): _looked(event.entity_id),
        ("export", "participant"): f"exported the record of {names.participant(number)}",
        ("export", "session"): f"exported the samples of {names.session(number)}",
        ("download", "plan"): f"printed plan {number}" + (f" for {names.visit(plan)}" if plan is not None else ""),
        ("refuse", "sign_in"): f"refused a sign-in of {event.entity_id}",
        ("refuse", "confirmation"): f"refused {event.entity_id} a signature or a new password",
    }
    return said.get((event.action, event.entity), f"{event.action}: {event.entity.replace('_', ' ')} {event.entity_id}")


def _looked(path: str) -> str:
    """Which results, by the address of their page."""
    whose, _, page = path.removeprefix("/api/v1").removeprefix("/participants/").partition("/")
    if not whose or not page:
        which = path.removeprefix("/api/v1").strip("/").removeprefix("analyses").replace("-", " ").replace("/", " ").strip()
        return "looked at the results of all participants" + (f": {which}" if which else "")
    return f"looked at the results of {whose}: {page.replace('-', ' ').replace('/', ', ')}"


def _plainly(event: AuditEvent) -> str:
    verb = {"insert": "added", "update": "changed", "delete": "removed"}.get(event.action, event.action)
    return f"{verb} a row of {event.entity.replace('_', ' ')}"


def _participant(before: Row, after: Row, _: Names) -> str:
    row = after or before
    if not before:
        return f"enrolled {row['code']}"
    said = {"withdrawn": "recorded that {} has withdrawn", "completed": "recorded that {} has completed the study"}
    if before.get("status") != row.get("status"):
        return said.get(str(row.get("status")), "recorded that {} takes part again").format(row["code"])
    return f"changed {row['code']}"


def _place(what: str) -> Callable[[Row, Row, Names], str]:
    def said(before: Row, after: Row, _: Names) -> str:
        row = after or before
        which = f"{what} {row['code']}"
        if not before:
            return f"added {which}"
        if bool(before.get("ended_at")) != bool(row.get("ended_at")):
            return f"ended {which}" if row.get("ended_at") else f"opened {which} again"
        return f"changed {which}"

    return said


def _visit(before: Row, after: Row, names: Names) -> str:
    row = after or before
    verb = "removed" if not after else "changed" if before else "added"
    return f"{verb} visit {row['number']} of {names.participant(row['participant_id'])}"


def _session(before: Row, after: Row, names: Names) -> str:
    row = after or before
    which = names.session(row["id"], row)
    if not after:
        return f"dropped {which}"
    if not before:
        return f"proposed {which}" if row.get("status") == "proposed" else f"took in {which}"
    if before.get("status") == "proposed" and row.get("status") == "confirmed":
        return f"confirmed {which}"
    if bool(before.get("excluded_reason")) != bool(row.get("excluded_reason")):
        return f"excluded {which}" if row.get("excluded_reason") else f"included {which} again"
    return f"corrected {which}"


def _plan(before: Row, after: Row, names: Names) -> str:
    row = after or before
    which = f"plan {row['id']} for {names.visit(row['visit_id'])}"
    if not before:
        return f"drafted {which}"
    changed = {"approved": "approved", "superseded": "replaced"} if row["status"] != before["status"] else {}
    return f"{changed.get(row['status'], 'changed')} {which}"


def _policy(before: Row, after: Row, names: Names) -> str:
    row = after or before
    which = f"policy {row['name']} of {names.participant(row['participant_id'])}"
    if not before:
        return f"stored {which}"
    if bool(before.get("retired_reason")) != bool(row.get("retired_reason")):
        return f"retired {which}" if row.get("retired_reason") else f"took {which} back into use"
    return f"changed {which}"


def _job(before: Row, after: Row, names: Names) -> str:
    row = after or before
    which = f"a {str(row['kind']).replace('_', ' ')} job of {names.participant(row['participant_id'])}"
    if not before:
        return f"asked for {which}"
    if row.get("cancel_requested_at") and not before.get("cancel_requested_at"):
        return f"stopped {which}"
    ends = {"running": "began", "succeeded": "finished", "failed": "failed at", "cancelled": "stopped"}
    return f"{ends.get(str(row['status']), 'changed') if row['status'] != before['status'] else 'changed'} {which}"


def _account(before: Row, after: Row, _: Names) -> str:
    row = after or before
    if not before:
        return f"made the account {row['email']}"
    if before.get("active") != row.get("active"):
        return f"{'opened' if row.get('active') else 'closed'} the account {row['email']}"
    return f"changed the account {row['email']}"


def _version(of: str) -> Callable[[Row, Row, Names], str]:
    def said(before: Row, after: Row, names: Names) -> str:
        row = after or before
        verb = "set the first" if row["version"] == 1 else "changed the"
        return f"{verb} {of} of {names.participant(row['participant_id'])} (version {row['version']})"

    return said


def _dose(before: Row, after: Row, names: Names) -> str:
    row = after or before
    did = "took back" if not after or after.get("removed_at") else "wrote down"
    return f"{did} a dose of {str(row['drug']).replace('_', ' ')} at {names.visit(row['visit_id'])}"


def _of_session(first: str, later: str) -> Callable[[Row, Row, Names], str]:
    def said(before: Row, after: Row, names: Names) -> str:
        row = after or before
        return f"{first if row.get('revision', 1) == 1 else later} {names.session(row['session_id'])}"

    return said


def _decided(_before: Row, after: Row, names: Names) -> str:
    of = names.participant(after.get("participant_id"))
    return f"decided whether policies of {of} learn from sessions of earlier ones: {after.get('choice')}"


def _token(before: Row, after: Row, _: Names) -> str:
    row = after or before
    revoked = row.get("revoked_at") and not before.get("revoked_at")
    return f"{'revoked' if revoked else 'changed' if before else 'made'} the token \u201c{row['name']}\u201d"


def _upload(before: Row, after: Row, names: Names) -> str:
    row = after or before
    return f"{'went on with' if before else 'began'} upload {row['id']} of {names.participant(row.get('participant_id'))}"


def _file(before: Row, after: Row, _: Names) -> str:
    row = after or before
    if row.get("decided_at") and not before.get("decided_at"):
        return f"decided on file {row['id']} of upload {row['upload_id']}"
    return f"{'read' if before else 'received'} file {row['id']} of upload {row['upload_id']}"


def _column_mapping(before: Row, after: Row, names: Names) -> str:
    row = after or before
    return f"{'removed' if row.get('removed') else 'stated'} the column mapping '{row['name']}'"


_SAID: dict[str, Callable[[Row, Row, Names], str]] = {
    "plan": _plan,
    "visit_lock": lambda b, a, n: f"{'locked' if a.get('locked') else 'unlocked'} {n.visit(a['visit_id'])}",
    "margins_lock": lambda b, a, n: f"locked the margins of {n.participant(a['participant_id'])}",
    "bundle_release": lambda b, a, n: (
        f"took the bundle of {n.policy(a['policy_id'])}" if a["policy_id"] is not None else "took the bundle of a session without a policy"
    ),
    "buffer_gate_decision": _decided,
    "study": _place("study"),
    "site": _place("site"),
    "participant": _participant,
    "settings_version": _version("settings"),
    "margins_version": _version("margins"),
    "characteristics_version": _version("characteristics"),
    "dose": _dose,
    "visit": _visit,
    "session": _session,
    "qoc": _of_session("entered the outcomes of", "corrected the outcomes of"),
    "session_conditions": _of_session("took down the conditions of", "corrected the conditions of"),
    "evaluation": lambda b, a, n: f"stored an evaluation of {n.participant((a or b)['participant_id'])}",
    "sweep": lambda b, a, n: f"stored {(a or b)['name']} of {n.participant((a or b)['participant_id'])}",
    "policy": _policy,
    "buffer_snapshot": lambda b, a, n: f"pinned the sessions that policies of {n.participant((a or b)['participant_id'])} learn from",
    "job": _job,
    "app_user": _account,
    "api_token": _token,
    "sign_in": lambda b, a, n: "signed out" if a.get("ended_at") and not b.get("ended_at") else "signed in",
    "column_mapping": _column_mapping,
    "upload": _upload,
    "upload_file": _file,
}
_ORDER = list(_SAID)
"""Which change names an act, first to last."""
