"""The clinic day as API types, with no more than the reader may know of what runs."""

from __future__ import annotations

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.planning.plans.designs import Planned
from app.planning.plans.sign_off import common_limits, sealed
from app.planning.plans.wording import STOP_RULES, design_name
from app.planning.visit_day.schemas import DayDoseOut, DayOut, EntryOut, LimitsOut, SlotOut
from app.planning.visit_day.service import Day
from app.planning.visit_day.wording import MAY_NOT_RUN
from app.platform.database import now
from app.study import access
from app.study.access import may
from app.study.blinding import CONTROLLER_NAMES, may_know
from app.study.characteristics import fields_of
from app.tables.plans import PlanItem
from app.tables.sessions import Controller


def day_out(day: Day, caller: Caller) -> DayOut:
    """Convert a clinic day for its page."""
    visit, plan = day.visit, day.plan
    blinded = not may_know(visit, caller) or sealed(plan)
    shared = common_limits(plan.items)
    common = LimitsOut.model_validate(shared) if shared else None
    return DayOut(
        visit_id=visit.id,
        visit=visit.number,
        date=visit.date,
        participant=visit.participant.code,
        plan_id=plan.id,
        blinded=blinded,
        locked=visit.locked,
        not_runnable=MAY_NOT_RUN if blinded and day.not_runnable else day.not_runnable,
        note="" if blinded else plan.note,
        stop_rules=[STOP_RULES],
        slots=[_slot(item, day, common if blinded else limits_of(item), blinded) for item in plan.items],
        entries=[EntryOut.model_validate(row) for row in day.entries],
        doses=[DayDoseOut.model_validate(row) for row in visit.doses],
        planned_doses=fields_of(visit.participant.current_characteristics).medication,
        reader=caller.label,
        may_enter=may(caller, can.WRITE_QOC, visit.participant) and not visit.locked,
        may_dose=may(caller, can.WRITE_STUDY, visit.participant) and not visit.locked and visit.participant.status != access.WITHDRAWN,
        server_time=now(),
    )


def limits_of(item: PlanItem) -> LimitsOut | None:
    """Return the limits within which a session of the plan stays; None where the plan does not state any."""
    if item.min_ma is None or item.max_ma is None:
        return None
    return LimitsOut(min_ma=item.min_ma, max_ma=item.max_ma, ramp_ma_per_s=item.ramp_ma_per_s)


def _slot(item: PlanItem, day: Day, limits: LimitsOut | None, blinded: bool) -> SlotOut:
    controller = Controller(item.controller)
    detail = ""
    if item.policy_id is not None:
        detail = day.policies[item.policy_id].name
    elif item.design is not None:
        detail = design_name(Planned.from_json(item.design))
    return SlotOut(
        plan_item_id=item.id,
        position=item.position,
        label=_label(item) if blinded else CONTROLLER_NAMES[controller],
        controller=None if blinded else controller.value,
        detail="" if blinded else detail,
        minutes=item.minutes,
        washout_minutes=item.washout_minutes,
        limits=limits,
        note="" if blinded else item.note,
    )


def _label(item: PlanItem) -> str:
    return f"Session {item.label}" if item.label else f"Session {item.position}"
