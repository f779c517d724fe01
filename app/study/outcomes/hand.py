"""Change of a participant's characteristics: what was derived from grasp tests rests on the hand that they name."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.study import access
from app.study.characteristics import CharacteristicsFields, fields_of
from app.study.outcomes.service import derive_for_session
from app.tables.outcomes import GraspTest
from app.tables.participants import CharacteristicsVersion, Participant
from app.tables.sessions import StudySession
from app.tables.visits import Visit


def sessions_with_grasp_tests(db: Session, participant_id: int) -> Sequence[StudySession]:
    """Load confirmed sessions of a participant that have a grasp test from a file, by number."""
    tested = select(GraspTest.session_id).where(GraspTest.removed_at.is_(None))
    mine = (Visit.participant_id == participant_id) & (StudySession.status == "confirmed") & StudySession.id.in_(tested)
    return db.scalars(select(StudySession).join(StudySession.visit).where(mine).order_by(StudySession.id)).all()


def change_characteristics(
    db: Session, participant: Participant, seen: int, wanted: CharacteristicsFields, reason: str, caller: Caller
) -> CharacteristicsVersion:
    """Store a version of what is wanted; the present one where nothing differs. Another hand derives grasp frequencies again.

    Args:
        seen: version that the caller has read, 0 for none.

    Raises:
        Forbidden: the caller enters no data of this participant. Conflict: another person was faster.
        Invalid: no reason, or nothing was ever stated.
    """
    access.require(caller, can.WRITE_STUDY, participant)
    current = participant.current_characteristics
    if seen != (current.version if current else 0):
        raise Conflict("Another person changed these characteristics after you opened them; nothing was saved.", "Load them again.")
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
        raise Conflict("Another person changed these characteristics at the same time.", "Load them again.") from error
    if row.hand != (current.hand if current else None):
        for session in sessions_with_grasp_tests(db, participant.id):
            derive_for_session(db, session)
    return row
