"""Rules of characteristics. The caller commits."""

from __future__ import annotations

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.study import access
from app.study import repository as study_repository
from app.study.characteristics import repository
from app.study.characteristics.schemas import CharacteristicsFields
from app.study.outcomes import service as outcomes
from app.tables.participants import CharacteristicsVersion, Hemisphere, Participant


def fields_of(row: CharacteristicsVersion | None) -> CharacteristicsFields:
    """What a version says; nothing where there is none yet."""
    return CharacteristicsFields.model_validate({n: getattr(row, n) for n in CharacteristicsFields.model_fields} if row else {})


def change_characteristics(
    db: Session, participant: Participant, seen: int, wanted: CharacteristicsFields, reason: str, caller: Caller
) -> CharacteristicsVersion:
    """Store a version of what is wanted; the present one where nothing differs. Another hand derives grasp frequencies anew.

    Args:
        seen: version that the caller has read, 0 for none.

    Raises:
        Forbidden: the caller enters no data of this participant. Conflict: somebody else was faster.
        Invalid: no reason, or nothing was ever stated.
    """
    access.require(caller, can.WRITE_STUDY, participant)
    current = participant.current_characteristics
    if seen != (current.version if current else 0):
        raise Conflict("Somebody else changed these characteristics after you opened them; nothing was saved.", "Load them again.")
    wanted = wanted.model_copy(update={"medication": sorted(wanted.medication, key=lambda d: (d.at, d.drug))})
    if wanted == fields_of(current):
        if current is None:
            raise Invalid("Nothing was stated.", "Give a lead, a symptom, the hand or a dose.")
        return current
    if not reason.strip():
        raise Invalid("A reason is missing.", "Say why in a sentence; it is kept with the version.", field="reason")
    set_reason(db, reason.strip())
    row = CharacteristicsVersion(
        participant_id=participant.id, version=seen + 1, created_by=caller.label, reason=reason.strip(), **wanted.model_dump(mode="json")
    )
    participant.characteristics.append(row)
    try:
        db.flush()
    except IntegrityError as error:
        db.rollback()
        raise Conflict("Somebody else changed these characteristics at the same time.", "Load them again.") from error
    if row.hand != (current.hand if current else None):
        for session in repository.sessions_with_grasp_tests(db, participant.id):
            outcomes.derive_for_session(db, session)
    return row


def suggested_hand(db: Session, participant: Participant) -> Hemisphere | None:
    """The hand contralateral to the hemisphere that was stimulated; None where that is not one hemisphere. A person decides."""
    sides = {Hemisphere(s.hemisphere) for s in study_repository.sessions_of_participant(db, participant.id) if s.hemisphere}
    if not sides:
        leads = fields_of(participant.current_characteristics).leads
        sides = {lead.hemisphere for lead in leads if lead.stimulating} or {lead.hemisphere for lead in leads}
    return sides.pop().opposite if len(sides) == 1 else None
