"""How a random session's amplitudes were drawn: by the design of the visit's approved plan, by a stated one, or as they themselves say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.study import blinding, repository
from app.study.sessions import logged
from app.study.traces import StepTable
from app.tables.sessions import Controller, SessionConditions, StudySession
from ml.designs import Hold, recognise, unstated_holds

Kind = Literal["paper", "stratified", "ladder", "near", "held", "unstated"]
"""The stated design; `held` where nobody stated one and the amplitudes are held; `unstated` where they are not: taken for the paper's."""

AGREEING_SHARE: Final = 0.9
"""A session followed a planned design as far as this share of its known steps has the planned amplitude."""
FEWEST_STEPS: Final = 30
"""Steps that must agree before a session is said to have followed a design."""
RESOLUTION_MA: Final = 0.1
"""What a stimulator rounds amplitudes to."""
ALIKE: Final = 0.02
"""Fractions closer than this are one amplitude where milliamperes are not known."""


@dataclass(frozen=True)
class Drawn:
    """How a random session's amplitudes were drawn.

    Attributes:
        kind: by which design. level: of the session, fraction. seed: of the design.
        holds: decisions that last; empty where each step is one.
    """

    kind: Kind
    level: float | None
    seed: int | None
    holds: tuple[Hold, ...]

    @property
    def density_told(self) -> bool:
        """Whether its bound and its holds say how each amplitude was drawn; False of a stated design of held draws without its holds."""
        return bool(self.holds) or self.kind in ("paper", "unstated")


def drawn(conditions: SessionConditions | None, table: StepTable) -> Drawn:
    """How the amplitudes of a random session were drawn, by its conditions, else by the amplitudes themselves.

    Args:
        conditions: of the session; None where nothing is known of them. table: its steps, and rows before it.
    """
    fraction = table.fraction[table.t_s > 0]
    if conditions is not None and conditions.design is not None:
        parameters: dict[str, Any] = conditions.design_parameters
        holds = tuple(Hold(h["start"], h["steps"], h["log_density"]) for h in parameters.get("holds", []))
        kind: Kind = conditions.design  # type: ignore[assignment]
        held = () if kind == "paper" else _until(holds, fraction.size) or _by_themselves(table)
        return Drawn(kind, parameters.get("level"), conditions.seed, held)
    found = _by_themselves(table)
    return Drawn("held" if found else "unstated", None, None, found)


def of_session(db: Session, session: StudySession, table: StepTable, caller: Caller) -> Drawn | None:
    """How a random session's amplitudes were drawn, also of a proposal that is not confirmed yet; None of another controller's.

    A proposal whose controller is open is read too: held amplitudes may say what it was.
    """
    arm = blinding.stated_arm(session, caller)
    if arm is not None and arm.controller is not Controller.RANDOM:
        return None
    if session.conditions is None and (plan := planned(db, session, table, session.visit.participant.current_settings.period_s)):
        parameters = plan["design_parameters"]
        holds = tuple(Hold(h["start"], h["steps"], h["log_density"]) for h in parameters["holds"])
        return Drawn(plan["design"], parameters["level"], plan["seed"], () if plan["design"] == "paper" else holds)
    found = drawn(session.conditions, table)
    return None if arm is None and len(found.holds) < 2 else found


def planned(db: Session, session: StudySession, table: StepTable, period_s: float) -> dict[str, Any] | None:
    """What its controller's log, else the visit's approved plan, says of how this random session was drawn, as members of its conditions.

    Without a log a session is held against every designed session of the plan, and belongs to the one whose amplitudes it followed longest;
    decisions after it left the design, such as a return to cDBS, are cut off. None where it followed none.

    Args:
        db: the session. session: whose visit. table: its steps. period_s: of these steps; designs of other steps are left out.
    """
    if (drawn_by_log := logged.design_of_session(session)) is not None:
        return drawn_by_log
    fraction = table.fraction[table.t_s > 0]
    best: dict[str, Any] | None = None
    longest = FEWEST_STEPS - 1
    for design in repository.planned_designs(db, session.visit_id):
        if design["period_s"] != period_s:
            continue
        steps = followed(fraction, design["holds"], tolerance(table.cdbs_ma))
        if steps > longest:
            longest, best = steps, design
    if best is None:
        return None
    holds = [h for h in best["holds"] if h["start"] < longest]
    holds[-1] = holds[-1] | {"steps": min(holds[-1]["steps"], longest - holds[-1]["start"])}
    return {
        "design": best["design"],
        "seed": best["seed"],
        "lower_bound": best["lower_bound"],
        "design_parameters": {"level": best["level"], "holds": holds},
    }


def followed(fraction: NDArray[np.float64], holds: list[dict[str, Any]], within: float) -> int:
    """Steps from the start on over which the amplitudes are the planned ones in at least `AGREEING_SHARE` of those that are known.

    Args:
        fraction: of the session's steps, [T]; NaN where unknown. holds: planned. within: fractions closer than this agree.
    """
    wanted = np.repeat([h["amplitude"] for h in holds], [h["steps"] for h in holds])[: fraction.size]
    own = fraction[: wanted.size]
    known = np.isfinite(own)
    agrees = known & (np.abs(np.where(known, own, 0.0) - wanted) <= within)
    share = np.cumsum(agrees) / np.maximum(np.cumsum(known), 1)
    ends = np.flatnonzero(agrees & (share >= AGREEING_SHARE))
    return int(ends[-1]) + 1 if ends.size else 0


def tolerance(cdbs_ma: float | None) -> float:
    """Fractions closer than this are one amplitude after rounding to the device's resolution."""
    return max(ALIKE, RESOLUTION_MA / cdbs_ma) if cdbs_ma else ALIKE


def _by_themselves(table: StepTable) -> tuple[Hold, ...]:
    fraction = table.fraction[table.t_s > 0]
    return unstated_holds(recognise(fraction, tolerance(table.cdbs_ma) / 2), fraction.size)


def _until(holds: tuple[Hold, ...], steps: int) -> tuple[Hold, ...]:
    """The holds of a session that ended after so many steps."""
    return tuple(Hold(h.start, min(h.steps, steps - h.start), h.log_density) for h in holds if h.start < steps)
