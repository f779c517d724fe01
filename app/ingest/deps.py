"""FastAPI dependency: the proposed session that a path names, within what the caller may read."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request

from app.accounts.deps import CurrentCaller
from app.ingest import repository
from app.platform.database import Db
from app.platform.web.schemas import RowId
from app.study.deps import current_session
from app.tables.sessions import StudySession


def current_proposal(request: Request, session_id: RowId, db: Db, caller: CurrentCaller) -> StudySession:
    """Find the session that the path names, confirmed or still proposed."""
    repository.proposal(db, session_id, caller)
    return current_session(request, session_id, db, caller)


CurrentProposal = Annotated[StudySession, Depends(current_proposal)]
