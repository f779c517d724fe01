"""What the visits so far say of the next one: how many more would settle whether a controller saves energy without loss."""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis import wording
from app.analysis.primary.service import verdicts_of
from app.tables.participants import Participant
from ml.statistics.noninferiority import PLANNED_SESSIONS


def outlook(db: Session, participant: Participant, caller: Caller) -> list[str]:
    """One sentence for every learned controller that was tested, by its confirmatory verdict where margins are locked."""
    found: dict[str, str] = {}
    for result in verdicts_of(db, participant, caller):
        found.setdefault(result.controller.value, wording.outlook(result, PLANNED_SESSIONS))
    return list(found.values())
