"""How far the visits with a signed plan are: sessions planned, held, and those whose logs are missing. What is to be done: `state`."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.planning.slots import repository as slots


@dataclass(frozen=True)
class VisitProgress:
    """One visit with a signed plan.

    Attributes:
        planned: sessions of the plan. held: those that a confirmed session fills.
        logs_missing: those that none fills although the day is past; 0 before it, of a visit without a date, and of a
            locked one, which takes no data any more.
        tested: those held that ran a policy, which nobody is told while the key is sealed (0). sealed: whether it is.
    """

    visit_id: int
    number: int
    date: dt.date | None
    planned: int
    held: int
    logs_missing: int
    tested: int
    sealed: bool = False


def visit_progress(db: Session, participant_ids: Sequence[int], today: dt.date) -> dict[int, list[VisitProgress]]:
    """By participant: its visits with a signed plan, by number; participants without one have none.

    Plans of versions that kept no limits have no slots to fill and are left out.
    """
    found: dict[int, list[VisitProgress]] = {i: [] for i in participant_ids}
    for row in slots.slots_filled(db, participant_ids):
        past = row.date is not None and row.date < today
        missing = row.slots - row.filled if past and not row.locked else 0
        tested = 0 if row.sealed else row.tested
        progress = VisitProgress(row.visit_id, row.number, row.date, row.slots, row.filled, missing, tested, row.sealed)
        found[row.participant_id].append(progress)
    return found
