"""Rules of entering and correcting a visit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Invalid
from app.study import repository
from app.study.access import require
from app.study.schemas import CdbsAmplitudeModel, VisitChange, VisitIn
from app.study.usual import questions
from app.study.usual.values import Question, question
from app.study.visits.service import require_unlocked
from app.tables.participants import Participant
from app.tables.visits import CdbsAmplitude, Visit


def add_visit(db: Session, participant: Participant, draft: VisitIn, caller: Caller) -> Visit:
    """Add a visit. Raises Conflict when its number is taken, Unusual for an amplitude outside the usual that nobody has confirmed."""
    require(caller, can.WRITE_STUDY, participant)
    if repository.visit_by_number(db, participant.id, draft.number):
        raise Conflict(f"Participant {participant.code} already has a visit {draft.number}.", "Choose the next number.", field="number")
    _each_once(draft.cdbs_amplitudes)
    questions.refuse(q for a in draft.cdbs_amplitudes if (q := _asked(a)))
    visit = Visit(participant_id=participant.id, number=draft.number, date=draft.date, note=draft.note)
    visit.cdbs_amplitudes = [CdbsAmplitude(**a.model_dump(exclude={"sure"})) for a in draft.cdbs_amplitudes]
    db.add(visit)
    db.flush()
    return visit


def change_visit(db: Session, visit: Visit, change: VisitChange, caller: Caller) -> Visit:
    """Correct a visit's date, note or cDBS amplitudes; its sessions' fractions follow, the audit trail keeps what stood before and why."""
    require(caller, can.WRITE_STUDY, visit.participant)
    require_unlocked(visit)
    set_reason(db, change.reason)
    given = change.model_fields_set
    if "date" in given:
        visit.date = change.date
    if "note" in given:
        visit.note = change.note or ""
    if "cdbs_amplitudes" in given:
        wanted = change.cdbs_amplitudes or []
        _each_once(wanted)
        standing = {(a.hemisphere, a.program, a.amplitude_ma) for a in visit.cdbs_amplitudes}
        questions.refuse(q for a in wanted if (a.hemisphere, a.program, a.amplitude_ma) not in standing and (q := _asked(a)))
        stated = {(a.hemisphere, a.program): a.amplitude_ma for a in wanted}
        for row in list(visit.cdbs_amplitudes):
            amplitude = stated.pop((row.hemisphere, row.program), None)
            if amplitude is None:
                row.removed_at = now()
            else:
                row.amplitude_ma = amplitude
        visit.cdbs_amplitudes += [CdbsAmplitude(hemisphere=h, program=p, amplitude_ma=ma) for (h, p), ma in stated.items()]
    db.flush()
    db.refresh(visit, ["cdbs_amplitudes"])
    return visit


def _each_once(amplitudes: Sequence[CdbsAmplitudeModel]) -> None:
    keys = [(a.hemisphere, a.program) for a in amplitudes]
    if len(set(keys)) < len(keys):
        raise Invalid("The same hemisphere and program stand twice in cdbs_amplitudes.", "Give each once.")


def _asked(amplitude: CdbsAmplitudeModel) -> Question | None:
    """What there is to ask about an amplitude of a visit; None where it is usual, or nobody can be asked."""
    asked = question("cdbs_amplitude_ma", amplitude.amplitude_ma)
    if asked is None or amplitude.sure is None:
        return None
    side, program = amplitude.hemisphere.value, amplitude.program
    return replace(asked, field="cdbs_amplitudes", hemisphere=side, program=program, confirmed=amplitude.sure)
