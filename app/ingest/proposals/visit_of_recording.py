"""A visit on the day of a recording, made in one step for every proposal of that day. The caller commits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.ingest import repository
from app.ingest.evidence import Evidence, Reason, Source
from app.ingest.proposals.service import locked, renew
from app.platform.errors import Conflict, Invalid
from app.study import access
from app.study import repository as study
from app.study import visits as study_visits
from app.study.schemas import VisitIn
from app.study.sessions.contradictions import control_recording, local_day
from app.tables.sessions import StudySession
from app.tables.uploads import SessionProposal
from app.tables.visits import Visit


def day_to_add(session: StudySession, proposal: SessionProposal, visits: Sequence[Visit]) -> date | None:
    """Find the day of a proposal whose visit is open and that no visit has. None where there is a visit to choose, or no date."""
    if not proposal.visit_open or session.started_at is None:
        return None
    day = local_day(control_recording(session), session.started_at)
    return None if any(v.date == day for v in visits) else day


@dataclass(frozen=True)
class VisitToAdd:
    """The visit that a recording would make.

    Attributes:
        day: on which it was recorded. number: of the visit.
        later: the visit of the latest day among those with a lower number and a later date; None where numbers go on following dates.
    """

    day: date
    number: int
    later: Visit | None


def visit_to_add(session: StudySession, proposal: SessionProposal, visits: Sequence[Visit]) -> VisitToAdd | None:
    """Find the visit of a proposal's day, as the page announces it; None as `day_to_add`."""
    day = day_to_add(session, proposal, visits)
    return None if day is None else _numbered(day, visits)


def _numbered(day: date, visits: Sequence[Visit]) -> VisitToAdd:
    """Choose a number that keeps numbers in the order of dates, where one is free there; else the one after the highest.

    Numbers in use stay as they are: plans, exports and analyses name visits by them.
    """
    before = max((v.number for v in visits if v.date is not None and v.date < day), default=0)
    after = min((v.number for v in visits if v.date is not None and v.date > day), default=None)
    taken = {v.number for v in visits}
    if after is not None:
        free = next((n for n in range(before + 1, after) if n not in taken), None)
        if free is not None:
            return VisitToAdd(day, free, None)
    later = [v for v in visits if v.date is not None and v.date > day]
    return VisitToAdd(day, max(taken, default=0) + 1, max(later, key=lambda v: (v.date or day, v.number), default=None))


def add_visit_of_recording(db: Session, session: StudySession, version: int, caller: Caller) -> tuple[Visit, list[StudySession]]:
    """Add the visit on whose day a proposal was recorded, and give it to every proposal of that day whose visit is open.

    Its number is the one that `visit_to_add` names.

    Returns:
        The visit, and the proposals that belong to it now.

    Raises:
        Conflict: the proposal was confirmed, or changed after the caller looked at it; the day has a visit already. Invalid: the proposal
            has a visit, or its recording states no date.
    """
    participant = session.visit.participant
    access.require(caller, can.WRITE_STUDY, participant)
    proposal = locked(db, session, version, caller)
    visits = study.visits(db, participant.id, 1000, 0)[0]
    if not proposal.visit_open:
        raise Invalid(f"Proposed session {session.id} has visit {session.visit.number} already.", "Correct it there, or leave it.")
    if session.started_at is None:
        raise Invalid(f"The recording of session {session.id} states no date.", "Add the visit yourself, or state the session's start.")
    day = day_to_add(session, proposal, visits)
    if day is None:
        raise Conflict("A visit on the day of this recording is there already.", "Choose it in the proposal.")
    visit = study_visits.add_visit(db, participant, VisitIn(number=_numbered(day, visits).number, date=day), caller)
    why = Evidence(Source.RECORDING, Reason.DAY_OF_VISIT, {"day": str(day), "visit": visit.number}).as_json()
    waiting = study.proposals_of_participant(db, participant.id)
    behind = repository.proposals(db, [s.id for s in waiting])
    moved = [s for s in waiting if s.id in behind and day_to_add(s, behind[s.id], visits) == day]
    for one in moved:
        row = behind[one.id]
        one.ordinal = study.next_ordinal(db, visit.id)
        one.visit = visit
        row.visit_open, row.changed_by = False, caller.label
        row.evidence = {**row.evidence, "visit": why}
        db.flush()
        renew(db, one)
    return visit, moved
