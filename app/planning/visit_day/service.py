"""Rules of the clinic day: what a tablet may enter, and what becomes of it. The caller commits."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation import repository as evaluations
from app.planning.plans import repository as plans
from app.planning.plans.view import read_plan, refuse_running
from app.planning.visit_day import repository, wording
from app.planning.visit_day.record import GRADED, SEVERE, moment
from app.planning.visit_day.schemas import AdverseEventPayload, DosePayload, EntryIn, EntryResult, NotePayload, StopCausePayload, Unreadable
from app.planning.visit_day.screening import screen
from app.planning.visit_day.session_outcomes import is_stop, locked_session, stop_words, take_outcomes
from app.platform.database import now
from app.platform.errors import BetaloopError, Conflict, Forbidden, Invalid, NotFound
from app.settings import get_settings
from app.study import access, doses
from app.study import adverse_events as events
from app.study.adverse_event_types import AdverseEventIn
from app.study.adverse_events import add_adverse_event, take_back_entry
from app.study.doses import DoseIn
from app.study.visits import require_unlocked
from app.tables.adverse_events import EventKind, Severity
from app.tables.learning import Policy
from app.tables.plans import DayEntry, Plan, PlanItem
from app.tables.visits import Visit

_KEY = "visit-day"
FIRST_YEAR = 1990
"""Times before it are those of a tablet that has lost its clock."""


@dataclass(frozen=True)
class Day:
    """The approved plan of a visit, its policies by number, why it may not run (or nothing), and everything that was entered about it."""

    visit: Visit
    plan: Plan
    policies: dict[int, Policy]
    not_runnable: str
    entries: Sequence[DayEntry]


@dataclass(frozen=True)
class DeviceKey:
    """With what a tablet encrypts the entries of one person until they are sent.

    Attributes:
        owner: number of the account. key: 32 bytes, base64. until: when a tablet forgets it at the latest.
    """

    owner: int
    key: str
    until: datetime


def read_day(db: Session, visit: Visit, caller: Caller) -> Day:
    """Read the clinic day of a visit. Raises NotFound without a plan, Conflict where it is not approved."""
    access.require(caller, can.READ, visit.participant)
    plan = plans.live_plan(db, visit.id)
    if plan is None:
        raise NotFound(f"Visit {visit.number} has no plan, and so nothing to run.", "Draft a plan and have it approved.")
    if plan.status != "approved":
        raise Conflict(
            f"The plan of visit {visit.number} is not approved yet; nothing is run that is not approved.", "A clinician approves it first."
        )
    policies = evaluations.policies_by_id(db, [item.policy_id for item in plan.items if item.policy_id is not None])
    return Day(visit, plan, policies, _not_runnable(db, visit, caller), repository.entries(db, plan.id))


def add_entries(db: Session, visit: Visit, plan_id: int, entries: Sequence[EntryIn | Unreadable], caller: Caller) -> list[EntryResult]:
    """Take what a tablet sends. An entry that is there already is `known`; one that cannot be taken is `refused`, the others are stored.

    The plan may have been replaced since: what was done under it stays true. Outcomes of confirmed sessions follow at once.

    Raises:
        NotFound: the visit never had this plan approved. Forbidden: the caller may only read.
    """
    access.require(caller, can.WRITE_QOC, visit.participant)
    plan = repository.plan_of_visit(db, visit.id, plan_id)
    if plan is None:
        raise NotFound(f"Visit {visit.number} has no approved plan {plan_id}.", "Load the page of the day again.")
    repository.lock_plan(db, plan.id)
    items = {item.id: item for item in plan.items}
    known = repository.entries_named(db, [e.uuid for e in entries if e.uuid is not None])
    results = []
    for entry in entries:
        if isinstance(entry, Unreadable):
            results.append(EntryResult(uuid=entry.uuid, outcome="refused", detail=entry.why, hint="Enter it again."))
            continue
        stored = known.get(entry.uuid)
        try:
            if stored is not None:
                _require_same(stored, entry, plan)
                results.append(EntryResult(uuid=entry.uuid, outcome="known"))
                continue
            if not _tells_harm(entry):  # what harms a participant is written down whenever it becomes known
                require_unlocked(visit)
            _check(entry, items)
            if entry.kind == "dose":
                doses.add_dose(db, visit, dose_of(entry), caller)
        except BetaloopError as error:
            field = str(error.extra.get("field", ""))
            results.append(EntryResult(uuid=entry.uuid, outcome="refused", detail=error.detail, hint=error.hint, field=field))
            continue
        known[entry.uuid] = _store(db, plan, entry, caller)
        _record_event(db, visit, items.get(entry.plan_item_id or 0), known[entry.uuid], caller)
        _take_back_stops(db, visit, known[entry.uuid], caller)
        results.append(EntryResult(uuid=entry.uuid, outcome="stored"))
    db.flush()
    if not visit.locked:
        for session in repository.sessions_in_place(db, plan.id):
            take_outcomes(db, session, caller)
    return results


def words_like_names(note: str) -> list[str]:
    """List the words of a note that the author must confirm to be no names."""
    return [found.text for found in screen(note) if found.kind == "name"]


def device_key(caller: Caller) -> DeviceKey:
    """Return the key of the caller's own entries: the same at every sign-in, so that entries waiting on a tablet stay readable.

    Raises:
        Forbidden: asked for with an API token.
    """
    caller.require_browser()
    if caller.user_id is None:
        raise Forbidden("Only people have a key for a tablet.", "Sign in with a browser.")
    derive = HKDF(SHA256(), 32, None, f"entries of account {caller.user_id}".encode())
    key = derive.derive(get_settings().secret(_KEY))
    return DeviceKey(caller.user_id, base64.b64encode(key).decode(), now() + timedelta(hours=get_settings().session_max_hours))


def _not_runnable(db: Session, visit: Visit, caller: Caller) -> str:
    """Explain why the approved plan may not run; what was done is entered all the same."""
    try:
        refuse_running(read_plan(db, visit, caller))
    except (Conflict, Invalid) as error:
        return f"{error.detail} {error.hint}".strip()
    return ""


def _tells_harm(entry: EntryIn) -> bool:
    return entry.kind == "adverse_event" or (isinstance(entry.payload, StopCausePayload) and entry.payload.cause == "participant")


def _require_same(stored: DayEntry, entry: EntryIn, plan: Plan) -> None:
    """Raise Conflict where a known identifier comes with other content."""
    same = (stored.plan_id, stored.plan_item_id, stored.kind, stored.payload) == (
        plan.id, entry.plan_item_id, entry.kind, _payload(entry),
    )  # fmt: skip
    if not same:
        raise Conflict(
            f"An entry with this identifier is stored already and says something else ({stored.kind} by {stored.entered_by}).",
            "Enter it again as a new one.",
        )


def _check(entry: EntryIn, items: dict[int, PlanItem]) -> None:
    if entry.plan_item_id is not None and entry.plan_item_id not in items:
        raise Invalid(f"The plan has no session {entry.plan_item_id}.", "Load the page of the day again.")
    field, text, no_names = _free_text(entry)
    found = screen(text, no_names)
    if found:
        raise Invalid(wording.screened(found), "Take it out, or say that a word is no name.", field=field)


def dose_of(entry: EntryIn) -> DoseIn:
    """Build the dose of an entry, to the minute: the same one twice within a minute counts as entered twice.

    Raises:
        Invalid: the tablet had lost its clock, and the time of the dose is unknown.
    """
    assert isinstance(entry.payload, DosePayload)
    taken_at = moment(entry).replace(second=0, microsecond=0)
    if taken_at.year < FIRST_YEAR:
        raise Invalid(
            f"The tablet's clock showed {taken_at:%Y-%m-%d %H:%M} UTC.", "Write the dose down on the page of the visit, with its time."
        )
    return DoseIn(drug=entry.payload.drug, mg=entry.payload.mg, taken_at=taken_at)


def _free_text(entry: EntryIn) -> tuple[str, str, Sequence[str]]:
    """Return the free-text field of the payload, its text, and the words that its author says are no names."""
    payload = entry.payload
    if isinstance(payload, NotePayload):
        return "text", payload.text, payload.no_names
    if isinstance(payload, AdverseEventPayload):
        return "note", payload.note, payload.no_names
    reason = getattr(payload, "reason", "")
    return ("reason", reason, ()) if reason else ("text", getattr(payload, "text", ""), ())


def _store(db: Session, plan: Plan, entry: EntryIn, caller: Caller) -> DayEntry:
    in_session = entry.plan_item_id is not None
    row = DayEntry(
        uuid=entry.uuid,
        plan_id=plan.id,
        plan_item_id=entry.plan_item_id,
        attempt=(entry.attempt or 1) if in_session else None,
        kind=entry.kind,
        payload=_payload(entry),
        replaces=[str(u) for u in entry.replaces],
        device_time=entry.device_time,
        clock_offset_ms=entry.clock_offset_ms,
        entered_by=caller.label,
    )
    db.add(row)
    return row


def _record_event(db: Session, visit: Visit, item: PlanItem | None, row: DayEntry, caller: Caller) -> None:
    """Record adverse events and severe side effects among the adverse events at once, with or without a recording of the session."""
    payload = row.payload
    if row.kind == "adverse_event":
        about = {name: payload[name] for name in ("kind", "severity", "serious", "note")}
    elif row.kind in GRADED and payload["grade"] == SEVERE:
        about = {"kind": row.kind, "severity": SEVERE}
    elif is_stop(row):
        about = {"kind": EventKind.STOPPED, "severity": Severity.NOT_STATED, "note": stop_words(row)}
    else:
        return
    session = locked_session(db, visit, row)
    where = {"session_id": session.id} if session is not None else {"visit_id": visit.id, "policy_id": item.policy_id if item else None}
    draft = AdverseEventIn.model_validate(
        about
        | where
        | {
            "occurred_at": moment(row) if moment(row).year >= FIRST_YEAR else None,
            "entry_key": str(row.uuid),
        }
    )
    add_adverse_event(db, visit.participant, draft, caller)


def _take_back_stops(db: Session, visit: Visit, row: DayEntry, caller: Caller) -> None:
    """Take back the stops that an entry corrects, each with the entry's own words where it is a stop too."""
    for uuid in row.replaces:
        event = events.event_by_key(db, visit.participant_id, str(uuid))
        if event is not None and event.is_stop and row.kind == "stop_cause":
            take_back_entry(db, event, wording.CORRECTED_ON_THE_DAY, caller)


def _payload(entry: EntryIn) -> dict[str, object]:
    return entry.payload.model_dump(mode="json")
