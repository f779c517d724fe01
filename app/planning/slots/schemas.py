"""API types of planned against done."""

from __future__ import annotations

from pydantic import Field

from app.planning.slots.matching import Deviation
from app.platform.web.schemas import Bool, Model
from app.tables.sessions import Controller
from ml.outcomes import FIELDS


class SlotRowOut(Model):
    """One slot of the plan, or one session that nobody planned."""

    position: int | None = Field(description="Of the slot; null for a session beside the plan.")
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
    """A visit as it was planned and as it was held."""

    plan_id: int
    planned: int
    found: int
    missing: list[str]
    rows: list[SlotRowOut]


class SlotConfirmation(Model):
    """Put every found session into its slot."""

    other_day: Bool = Field(False, description="Sessions that were held on another day than the visit's are meant all the same.")


class SlotsConfirmed(Model):
    """What became of it."""

    comparison: VisitComparisonOut
    notes: list[str]
