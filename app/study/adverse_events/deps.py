"""The adverse event that a path names, within what the caller may read."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import RowId
from app.study.adverse_events import repository
from app.tables.adverse_events import AdverseEvent


def current_event(event_id: RowId, db: Db, caller: CurrentCaller) -> AdverseEvent:
    """The event that the path names."""
    return repository.event(db, event_id, caller)


CurrentEvent = Annotated[AdverseEvent, Depends(current_event)]
