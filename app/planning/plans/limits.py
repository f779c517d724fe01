"""The limits of a planned session in milliamperes: set with the plan and signed with it, not when a bundle is taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.planning.plans import repository
from app.platform.errors import Conflict, Invalid
from app.study import cdbs_amplitude
from app.tables.participants import Hemisphere, Participant
from app.tables.plans import PlanItem
from app.tables.sessions import Controller
from app.tables.visits import Visit

_TOLERANCE_MA = 1e-6
_ROUNDING_MA = 0.01
"""By how much limits that follow from B are rounded up at most."""


@dataclass(frozen=True)
class DeviceLimits:
    """Amplitude limits that a recording of the participant's stimulator holds: the strictest of its enabled programs, mA."""

    min_ma: float
    max_ma: float


@dataclass(frozen=True)
class StatedLimits:
    """Limits that a clinician states for the controllers of a plan; None takes the default.

    The default range is from the stimulator's own lower limit (0 mA where no recording has one) to the cDBS amplitude. The default ramp
    covers the cDBS amplitude within one period.
    """

    min_ma: float | None = None
    max_ma: float | None = None
    ramp_ma_per_s: float | None = None

    @property
    def any(self) -> bool:
        """True where anything was stated."""
        return any(v is not None for v in (self.min_ma, self.max_ma, self.ramp_ma_per_s))


@dataclass(frozen=True)
class SlotLimits:
    """Limits of one planned session.

    Attributes:
        cdbs_ma: the clinical amplitude, to which every fault leads back. min_ma, max_ma: no amplitude leaves them. Both are the cDBS
            amplitude in a cDBS session, and 0 without stimulation. ramp_ma_per_s: fastest change.
    """

    cdbs_ma: float
    min_ma: float
    max_ma: float
    ramp_ma_per_s: float


def device_limits(db: Session, participant: Participant, hemisphere: Hemisphere | None) -> DeviceLimits | None:
    """Return limits of the newest recording that has any, of this side where one is named; None where no recording does."""
    for recording in repository.recordings_newest_first(db, participant.id, hemisphere):
        programs = [p for group in (recording.details.get("limits") or {}).values() for p in group.values()]
        if programs:
            return DeviceLimits(max(p["lower_ma"] for p in programs), min(p["upper_ma"] for p in programs))
    return None


def planned_cdbs_ma(visit: Visit, hemisphere: Hemisphere | None) -> float:
    """Return the cDBS amplitude of a visit's plan, mA: what the visit states, else the participant's settings.

    Raises:
        Invalid: it is not stated; the visit states both sides and none is named; or the settings differ from the newest visit that states
            one. Which of the two is right is then unknown.
    """
    settings = visit.participant.current_settings
    found = cdbs_amplitude.in_force(visit, hemisphere, settings)
    if found is None:
        raise Invalid(
            f"The cDBS amplitude of visit {visit.number} is not known.", "State it at the visit or in the participant's settings, in mA."
        )
    if cdbs_amplitude.stated_at(visit, hemisphere) is None:
        newest = cdbs_amplitude.in_force_now(visit.participant, hemisphere)
        if abs(newest - found) > _TOLERANCE_MA:
            raise Invalid(
                f"Visit {visit.number} states no cDBS amplitude; the settings say {found:g} mA, and the newest visit that states one "
                f"{newest:g} mA.",
                f"State the amplitude at visit {visit.number}.",
            )
    return found


def slot_limits(
    cdbs_ma: float, controller: Controller, period_s: float, stated: StatedLimits, device: DeviceLimits | None, least_fraction: float = 0.0
) -> SlotLimits:
    """Compute the limits of one session.

    Args:
        cdbs_ma: as `planned_cdbs_ma`. period_s: between two decisions. stated: by the clinician. device: the stimulator's own.
        least_fraction: of cDBS, below which the session must not go: that of a test with care, or B of a random session.

    Raises:
        Invalid: limits that contradict each other, leave the stimulator's own, or go below what the verdict allows.
    """
    ramp = cdbs_ma / period_s if stated.ramp_ma_per_s is None else stated.ramp_ma_per_s
    if controller is Controller.NO_DBS:
        return SlotLimits(cdbs_ma, 0.0, 0.0, ramp)
    if controller is Controller.CDBS:
        return SlotLimits(cdbs_ma, cdbs_ma, cdbs_ma, ramp)
    # to the hundredth of a milliampere, upwards, so that rounding never goes below what is allowed
    least = math.ceil(100 * least_fraction * cdbs_ma - _TOLERANCE_MA) / 100
    default = max(least, device.min_ma if device else 0.0)
    low = default if stated.min_ma is None else max(stated.min_ma, least)
    high = cdbs_ma if stated.max_ma is None else stated.max_ma
    if not low <= cdbs_ma <= high:
        raise Invalid(
            f"Limits of {low:g} to {high:g} mA leave out the cDBS amplitude of {cdbs_ma:g} mA, to which every fault leads back.",
            "State limits that hold it.",
            field="min_ma" if low > cdbs_ma else "max_ma",
        )
    if device and (low < device.min_ma - _TOLERANCE_MA or high > device.max_ma + _TOLERANCE_MA):
        raise Invalid(
            f"Limits of {low:g} to {high:g} mA leave those of the stimulator, {device.min_ma:g} to {device.max_ma:g} mA.",
            "State limits within the stimulator's own.",
            field="min_ma" if low < device.min_ma - _TOLERANCE_MA else "max_ma",
        )
    return SlotLimits(cdbs_ma, low, high, ramp)


def lowest_draw(db: Session, visit: Visit, stated: StatedLimits, hemisphere: Hemisphere | None) -> float:
    """Return B of a visit's random sessions, fraction of cDBS: the participant's, or the plan's lowest amplitude where that is higher.

    Draws below a limit would be cut by the tablet. The sheet would name amplitudes that are not given, and a density that is not theirs.
    Where the cDBS amplitude is unknown it is the participant's, because the plan has no limits then.

    Raises:
        Invalid: as `slot_limits`.
    """
    settings = visit.participant.current_settings
    try:
        cdbs_ma = planned_cdbs_ma(visit, hemisphere)
    except Invalid:
        return settings.bound  # the limits of the plan say what is missing, and signing is refused
    device = device_limits(db, visit.participant, hemisphere)
    least = slot_limits(cdbs_ma, Controller.RANDOM, settings.period_s, stated, device, settings.bound).min_ma
    return least / cdbs_ma if least > settings.bound * cdbs_ma + _ROUNDING_MA else settings.bound


def set_limits(db: Session, visit: Visit, items: Sequence[PlanItem], stated: StatedLimits, hemisphere: Hemisphere | None) -> None:
    """Set the limits of every session; where the cDBS amplitude is unknown they stay open, and the plan cannot be signed.

    Raises:
        Invalid: limits were stated that cannot be used, or without a known cDBS amplitude.
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
    """Check the limits of a plan against today's cDBS amplitude.

    Raises:
        Conflict: they are open, or were set for another amplitude. Invalid: the amplitude is unknown.
    """
    for item in items:
        cdbs_ma = planned_cdbs_ma(visit, item.hemisphere)
        if item.cdbs_ma is None:
            raise Conflict(
                f"Session {item.position} has no limits in mA: the cDBS amplitude was not known when the plan was drafted.",
                "Draft the visit again.",
            )
        if abs(item.cdbs_ma - cdbs_ma) > _TOLERANCE_MA:
            raise Conflict(
                f"The limits of session {item.position} were set for a cDBS amplitude of {item.cdbs_ma:g} mA; it is {cdbs_ma:g} mA now.",
                "Draft the visit again, so that its limits are set for the amplitude of today.",
            )
