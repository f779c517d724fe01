"""Entries of the clinic day as the outcome of the session that takes its place in the plan. The caller commits.

It joins the session whenever the later of both arrives: log, confirmation and entries may come in any order.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.planning.visit_day import repository, wording
from app.planning.visit_day.record import ASKED, GRADED, MILD, Entry, attempt_at, moment, outcome_of, said_of, standing
from app.platform.database import set_reason
from app.study import adverse_events as events
from app.study.adverse_event_types import AdverseEventIn
from app.study.adverse_events import add_adverse_event, take_back_entry
from app.study.outcomes.service import follow_day
from app.study.visits import require_unlocked
from app.tables.plans import DayEntry
from app.tables.sessions import StudySession
from app.tables.visits import Visit

SAME_END = timedelta(seconds=60)
"""A stop that was entered within this time of its recording's end is that end: it is pressed by hand."""


def take_outcomes(db: Session, session: StudySession, caller: Caller) -> list[str]:
    """Give a confirmed session the outcomes, mild side effects and early stop that were entered about its place.

    They are those of the attempt that its recording began nearest to. What a person typed for the session, or a file gave, stays.
    Contradicting entries count for nothing. Again, it adds nothing.

    Args:
        db: the session of the database. session: confirmed, with `plan_item_id`; without one nothing is taken. caller: who confirms, or
            sends the entries.

    Returns:
        Sentences on what the clinic day says otherwise than the session.

    Raises:
        Conflict: the visit is locked.
    """
    if session.plan_item_id is None:
        return []
    entries = repository.entries_beside(db, session.plan_item_id)
    if not any(e.plan_item_id == session.plan_item_id for e in entries):
        return []
    require_unlocked(session.visit)
    number = attempt_at(entries, session.plan_item_id, session.started_at)
    found = outcome_of(entries, session.plan_item_id, number)
    reason = wording.from_the_day(sorted(set(found.entered_by.values())))
    follow_day(db, session, {one.field: found.qocs.get(one.field) for one in ASKED}, caller.label, reason)
    _early_stop(session, entries, number, db)
    _mild(db, session, entries, number, caller)
    db.flush()
    return differences(session, entries)


def differences(session: StudySession, entries: Sequence[DayEntry]) -> list[str]:
    """Return what the entries of a day say otherwise than the session that fills their place, in sentences.

    Args:
        session: in its place of the plan, or proposed for it. entries: all of the plan's day.
    """
    item = session.plan_item_id
    if item is None:
        return []
    number = attempt_at(entries, item, session.started_at)
    found = outcome_of(entries, item, number)
    told = []
    for one in ASKED:
        entered, known = found.qocs.get(one.field), getattr(session.qoc, one.field, None)
        if entered is not None and entered != known:
            told.append(wording.day_differs(one, entered, known))
    elapsed = elapsed_s(entries, item, number)
    if elapsed is not None and abs(elapsed - session.duration_s) > SAME_END.total_seconds():
        told.append(wording.day_ended(elapsed, session.duration_s))
    return told + [wording.open_contradiction(kind) for kind in found.contradictions]


def elapsed_s(entries: Sequence[DayEntry], item: int, number: int) -> float | None:
    """Return the time from the start of an attempt to its stop, s; None where one of them was not entered."""
    marks = said_of(entries, item, number)
    if "start" not in marks or "stop" not in marks:
        return None
    return (moment(marks["stop"]) - moment(marks["start"])).total_seconds()


def _early_stop(session: StudySession, entries: Sequence[DayEntry], number: int, db: Session) -> None:
    """Let the session's stop follow the day's: a stop for the participant's sake counts while one such entry is not replaced."""
    mine = [e for e in entries if e.kind == "stop_cause" and e.plan_item_id == session.plan_item_id]
    sake = [e for e in mine if is_stop(e)]
    standing_ones = [e for e in standing(entries) if e in sake and e.attempt == number]
    wanted = stop_words(standing_ones[0]) if standing_ones else None
    if session.stopped_reason not in (None, *(stop_words(e) for e in sake)):
        return  # a person wrote a stop of their own
    if session.stopped_reason != wanted:
        set_reason(db, wording.from_the_day(sorted({e.entered_by for e in mine})))
        session.stopped_reason = wanted


def locked_session(db: Session, visit: Visit, entry: DayEntry) -> StudySession | None:
    """Return the confirmed session of a locked visit that a stop is about; None where it is none, or another attempt was recorded."""
    if not visit.locked or not is_stop(entry):
        return None
    session = next((s for s in repository.sessions_in_place(db, entry.plan_id) if s.plan_item_id == entry.plan_item_id), None)
    if session is None or attempt_at(repository.entries(db, entry.plan_id), session.plan_item_id or 0, session.started_at) != entry.attempt:
        return None
    return session


def is_stop(entry: Entry) -> bool:
    """Return whether an entry says that a session was stopped for the participant's sake."""
    return bool(entry.kind == "stop_cause" and entry.payload["cause"] == "participant")


def stop_words(entry: Entry) -> str:
    """Return the reason of a stop in words."""
    return str(entry.payload["text"]).strip() or wording.STOPPED_FOR_PARTICIPANT


def _mild(db: Session, session: StudySession, entries: Sequence[DayEntry], number: int, caller: Caller) -> None:
    """Record mild side effects as adverse events of the session; severe ones are events since they arrived.

    One whose entry was corrected since becomes none.
    """
    valid = {e.uuid for e in standing(entries)}
    mine = [e for e in entries if (e.plan_item_id, e.attempt) == (session.plan_item_id, number)]
    for entry in mine:
        if entry.kind not in GRADED or entry.payload["grade"] != MILD:
            continue
        known = events.event_by_key(db, session.visit.participant_id, str(entry.uuid))
        if entry.uuid in valid and known is None:
            draft = AdverseEventIn.model_validate(
                {"kind": entry.kind, "severity": MILD, "session_id": session.id, "entry_key": str(entry.uuid)}
            )
            add_adverse_event(db, session.visit.participant, draft, caller)
        elif entry.uuid not in valid and known is not None:
            take_back_entry(db, known, wording.CORRECTED_ON_THE_DAY, caller)
