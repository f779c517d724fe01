"""What was entered on the clinic day becomes the outcome of the session that takes its place in the plan. The caller commits."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.planning import wording
from app.planning.visit_day import repository
from app.planning.visit_day.record import GRADED, MILD, SlotOutcome, SlotTimes, last_attempt, outcomes_of, standing, times_of
from app.study.adverse_events.schemas import AdverseEventIn
from app.study.adverse_events.service import add_adverse_event
from app.study.schemas import QocIn, SessionChange
from app.study.service import change_session, record_qoc
from app.tables.plans import DayEntry
from app.tables.sessions import StudySession


def take_outcomes(db: Session, session: StudySession, caller: Caller) -> list[str]:
    """Give a confirmed session the rating, the grasp frequency, the mild side effects and the early stop that were entered about its place.

    What the session has already, typed or derived from files, stays. Contradicting entries count for nothing. Again, it adds nothing.

    Args:
        db: the session of the database. session: confirmed, with `plan_item_id`; without one nothing is taken. caller: who confirms.

    Returns:
        Sentences on what the clinic day says otherwise than the session.

    Raises:
        Forbidden: the caller may not enter outcomes. Conflict: the visit is locked.
    """
    if session.plan_item_id is None:
        return []
    entries = repository.entries_beside(db, session.plan_item_id)
    outcome, times = outcomes_of(entries).get(session.plan_item_id), times_of(entries).get(session.plan_item_id)
    if outcome is None or times is None:
        return []
    differences = _qoc(db, session, outcome, caller)
    _early_stop(db, session, times, caller)
    _mild(db, session, entries, caller)
    return differences + [wording.open_contradiction(kind) for kind in outcome.contradictions]


def _qoc(db: Session, session: StudySession, outcome: SlotOutcome, caller: Caller) -> list[str]:
    known = {name: getattr(session.qoc, name, None) for name in ("rating", "grasp_hz")}
    entered = {name: value for name in known if (value := getattr(outcome, name)) is not None}
    new = {name: value for name, value in entered.items() if known[name] is None}
    if new:
        who = sorted(set(outcome.entered_by.values()))
        record_qoc(db, session, QocIn.model_validate(new | {"reason": wording.from_the_day(who), "sure": list(new)}), caller)
    both = [(name, value, before) for name, value in entered.items() if (before := known[name]) is not None]
    return [wording.day_differs(name, value, before) for name, value, before in both if value != before]


def _early_stop(db: Session, session: StudySession, times: SlotTimes, caller: Caller) -> None:
    if times.stop_cause == "participant" and session.stopped_reason is None:
        stopped = times.stop_text or wording.STOPPED_FOR_PARTICIPANT
        change_session(db, session, SessionChange(stopped_reason=stopped, reason=wording.from_the_day([])), caller)


def _mild(db: Session, session: StudySession, entries: Sequence[DayEntry], caller: Caller) -> None:
    """Mild side effects become adverse events of the session; severe ones are events since they arrived."""
    item = session.plan_item_id
    attempt = last_attempt(entries, item or 0)
    for entry in standing(entries):
        if entry.kind in GRADED and entry.payload["grade"] == MILD and (entry.plan_item_id, entry.attempt) == (item, attempt):
            draft = AdverseEventIn.model_validate(
                {"kind": entry.kind, "severity": MILD, "session_id": session.id, "entry_key": str(entry.uuid)}
            )
            add_adverse_event(db, session.visit.participant, draft, caller)
