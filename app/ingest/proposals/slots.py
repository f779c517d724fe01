"""Slot that a controller's log names: the visit to which its session belongs."""

from __future__ import annotations

from collections.abc import Sequence

from app.ingest.proposals.evidence import Evidence, Reason, Source, VisitGuess
from app.ingest.sessions import StatedSession
from app.study.sessions.usable_steps import LoggedSlot
from app.tables.visits import Visit


def differs_from_slot(slot: LoggedSlot | None, stated: StatedSession) -> bool:
    """Decide whether a log is of another session of a plan than its sender states; False where it names none of this participant's."""
    if slot is None or slot.planned is None:
        return False
    planned = slot.planned
    if planned.sealed and (stated.controller is not None or stated.policy_id is not None):
        return True  # whether they agree would reveal what ran
    return (
        (stated.visit is not None and stated.visit.id != planned.visit_id)
        or (stated.controller is not None and stated.controller != planned.controller)
        or (stated.policy_id is not None and stated.policy_id != planned.policy_id)
    )


def visit_of_slot(visits: Sequence[Visit], slot: LoggedSlot | None, stated: Visit | None) -> VisitGuess | None:
    """Find the visit of the planned session that a log names; open where the sender states another one, but while its plan's key is sealed.

    None where it names none.
    """
    planned = slot.planned if slot is not None else None
    own = next((v for v in visits if planned is not None and v.id == planned.visit_id), None)
    if planned is None or own is None:
        return None
    facts = {"visit": own.number, "position": planned.position}
    if stated is not None and stated.id != own.id:
        if planned.sealed:  # at another visit everybody would be shown what its sealed plan hides
            return VisitGuess(own, False, Evidence(Source.RECORDING, Reason.SLOT, facts | {"stated": stated.number}))
        return VisitGuess(stated, True, Evidence(Source.RECORDING, Reason.OTHER_VISIT, facts | {"stated": stated.number}))
    return VisitGuess(own, False, Evidence(Source.RECORDING, Reason.SLOT, facts))
