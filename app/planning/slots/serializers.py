"""API types of planned against done."""

from __future__ import annotations

from pydantic import Field

from app.planning.plans import wording
from app.planning.plans.view import shown
from app.planning.slots.matching import Deviation
from app.planning.slots.service import Comparison, Row
from app.platform.web.schemas import Bool, Model
from app.tables.sessions import Controller
from ml.outcomes import FIELDS


class SlotRowOut(Model):
    """One slot of the plan, or one unplanned session."""

    position: int | None = Field(description="Of the slot; null for a session outside the plan.")
    name: str = Field(description="Of the slot; its letter while the key of a blinded plan is sealed.")
    controller: Controller | None
    policy_id: int | None
    session_id: int | None = Field(description="That fills it; null where none was found.")
    confirmed: bool = Field(description="Whether a person has put the session there.")
    deviations: list[Deviation]
    differences: list[str] = Field(description="What the clinic day says otherwise than the session, in sentences.")
    predicted: dict[str, float] = Field(description=f"Energy (mean squared fraction of cDBS), {', '.join(FIELDS)}; known ones.")
    done: dict[str, float]


class VisitComparisonOut(Model):
    """A visit as planned and as done."""

    plan_id: int
    planned: int
    found: int
    missing: list[str]
    rows: list[SlotRowOut]


class SlotConfirmation(Model):
    """Confirmation that puts every found session into its slot."""

    other_day: Bool = Field(False, description="Sessions of another day than the visit's are meant all the same.")


class SlotsConfirmed(Model):
    """Result of the confirmation."""

    comparison: VisitComparisonOut
    notes: list[str]


# Planned against done as API types, with no more of a sealed plan than may be shown.


def comparison_out(found: Comparison) -> VisitComparisonOut:
    """Convert a comparison for the API and the page."""
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
