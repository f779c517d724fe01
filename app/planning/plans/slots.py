"""The sessions of a plan as slots: their limits in milliamperes, their count within the visit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from sqlalchemy.orm import Session

from app.planning.plans.limits import StatedLimits, device_limits, planned_cdbs_ma, slot_limits
from app.planning.plans.models import PlanItem
from app.platform.errors import Conflict, Invalid
from app.study.models import Controller, Hemisphere, Visit

_TOLERANCE_MA = 1e-6


def count_repeats(items: Sequence[PlanItem]) -> None:
    """Number the sessions of each policy, and of each controller without one, from 1 in their order."""
    seen: Counter[tuple[Controller, int | None]] = Counter()
    for item in items:
        arm = (Controller(item.controller), item.policy_id)
        seen[arm] += 1
        item.repeat = seen[arm]


def set_limits(db: Session, visit: Visit, items: Sequence[PlanItem], stated: StatedLimits, hemisphere: Hemisphere | None) -> None:
    """Set the limits of every session; where nobody knows the cDBS amplitude they stay open, and the plan cannot be signed.

    Raises:
        Invalid: limits were stated that cannot be used, or that no known cDBS amplitude stands behind.
    """
    try:
        cdbs_ma = planned_cdbs_ma(visit, hemisphere)
    except Invalid:
        if stated.any or hemisphere is not None:
            raise
        return  # a warning of the plan says what is missing, and signing it is refused
    device = device_limits(db, visit.participant, hemisphere)
    period_s = visit.participant.current_settings.period_s
    for item in items:
        least = item.design["lower_bound"] if item.design is not None else item.min_fraction
        found = slot_limits(cdbs_ma, Controller(item.controller), period_s, stated, device, least or 0.0)
        item.hemisphere = hemisphere
        item.cdbs_ma, item.min_ma, item.max_ma, item.ramp_ma_per_s = found.cdbs_ma, found.min_ma, found.max_ma, found.ramp_ma_per_s


def require_limits(visit: Visit, items: Sequence[PlanItem]) -> None:
    """Hold the limits of a plan against the cDBS amplitude of today.

    Raises:
        Conflict: they are open, or were set for another amplitude. Invalid: nobody knows the amplitude.
    """
    for item in items:
        cdbs_ma = planned_cdbs_ma(visit, item.hemisphere)
        if item.cdbs_ma is None:
            raise Conflict(
                f"Session {item.position} has no limits in mA: the cDBS amplitude was not known when the plan was drafted.",
                "Draft the visit anew.",
            )
        if abs(item.cdbs_ma - cdbs_ma) > _TOLERANCE_MA:
            raise Conflict(
                f"The limits of session {item.position} were set for a cDBS amplitude of {item.cdbs_ma:g} mA; it is {cdbs_ma:g} mA now.",
                "Draft the visit anew, so that its limits are set for the amplitude of today.",
            )
