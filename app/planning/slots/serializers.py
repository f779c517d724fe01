"""Planned against done as API types, with no more of a sealed plan than may be shown."""

from __future__ import annotations

from app.planning.plans import wording
from app.planning.plans.view import shown
from app.planning.slots.matching import Deviation
from app.planning.slots.schemas import SlotRowOut, VisitComparisonOut
from app.planning.slots.service import Comparison, Row
from app.tables.sessions import Controller


def comparison_out(found: Comparison) -> VisitComparisonOut:
    """For the API and the page."""
    lines = shown(found.view).lines
    names = {line.item.position: wording.session_name(line.item, line.policy.name if line.policy else None) for line in lines}
    return VisitComparisonOut(
        plan_id=found.view.plan.id,
        planned=found.planned,
        found=found.found,
        missing=[names[line.item.position] for line in found.missing],
        rows=[_row(row, names, found.view.sealed) for row in found.rows],
    )


def _row(row: Row, names: dict[int, str], sealed: bool) -> SlotRowOut:
    item = row.line.item if row.line else None
    known = item is not None and not sealed
    return SlotRowOut(
        position=item.position if item else None,
        name=names[item.position] if item else "planned before" if Deviation.EARLIER_PLAN in row.deviations else "not planned",
        controller=Controller(item.controller) if item is not None and known else None,
        policy_id=item.policy_id if item is not None and known else None,
        session_id=row.session.id if row.session else None,
        confirmed=row.confirmed,
        deviations=list(row.deviations),
        differences=list(row.differences),
        predicted=row.predicted if known else {},
        # 100 % of cDBS would name the cDBS sessions
        done={name: value for name, value in row.done.items() if name != "energy"} if sealed else row.done,
    )
