"""FastAPI dependencies: the participant, visit or session that a path names, within what the caller may read."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Path

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import RowId
from app.study import repository
from app.study.models import Participant, StudySession, Visit


def current_participant(code: Annotated[str, Path(max_length=40, pattern=r"^[^\x00]*$")], db: Db, caller: CurrentCaller) -> Participant:
    """The participant that the path names."""
    return repository.participant_by_code(db, code, caller)


def current_visit(visit_id: RowId, db: Db, caller: CurrentCaller) -> Visit:
    """The visit that the path names."""
    return repository.visit(db, visit_id, caller)


def current_session(session_id: RowId, db: Db, caller: CurrentCaller) -> StudySession:
    """The session that the path names."""
    return repository.session(db, session_id, caller)


CurrentParticipant = Annotated[Participant, Depends(current_participant)]


CurrentVisit = Annotated[Visit, Depends(current_visit)]


CurrentSession = Annotated[StudySession, Depends(current_session)]
