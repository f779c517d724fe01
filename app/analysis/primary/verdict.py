"""Is energy saved without loss? Non-inferiority on the participant's margins, then the saving. No database.

A verdict confirms where the margins were locked before every session that it rests on; else it explores. A newer lock does not undo an
older one: the visits that began between the two keep their verdict under the older, so that each is judged by the margins in force at its
time. The margin of grasp is a share of the frequency under cDBS: the cDBS values are lowered by it, so that what is tested is "no slower
than 1 - share of the same visit's cDBS", with the spread of that reference in the error. A rating has no equal steps: made better by its
margin it must win at least half of the pairs with the same visit's cDBS ratings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from app.analysis.evidence.facts import Facts
from app.analysis.evidence.measurements import HIGHER_IS_BETTER, choose_each, of_controller
from app.study.models import Controller
from ml.qoc import Margins
from ml.statistics.noninferiority import LEAST_VISITS, Assessment, Outcome, assess
from ml.statistics.within_visits.contrasts import Measurements, Scale

SCALE: dict[str, Scale] = {"grasp": "difference", "rating": "ordinal", "tremor": "difference"}
FAILURE = {"grasp": None, "rating": 1.0, "tremor": 100.0}
"""What a stopped session counts as; of grasp, the worst frequency measured."""


class NoVerdict(StrEnum):
    """Why nothing was assessed."""

    NO_VISIT_AFTER_LOCK = "no_visit_after_lock"
    NO_GRASP_REFERENCE = "no_grasp_reference"


@dataclass(frozen=True)
class LockedMargins:
    """Margins as they were locked, or the present ones where nobody locked any.

    Attributes:
        reason: of the lock. until: when a newer lock followed; None of the lock in force.
    """

    margins: Margins
    version: int
    locked_at: datetime | None
    locked_by: str | None
    reason: str | None = None
    until: datetime | None = None


@dataclass(frozen=True)
class VerdictResult:
    """The verdict on one controller.

    Attributes:
        locked: the margins that it goes by. confirmatory: every session that it rests on began, and was recorded, after their lock.
        assessment: of those sessions; None for the reason in `no_verdict`.
        visits: with both arms, among the sessions that it rests on. drawn_from: all visits of these sessions.
        left_to_exploration: visits of before the lock.
        margin: by outcome, in its unit. stopped: sessions of the controller that were stopped for the patient's sake.
    """

    controller: Controller
    locked: LockedMargins
    confirmatory: bool
    assessment: Assessment | None
    no_verdict: NoVerdict | None
    visits: tuple[int, ...]
    drawn_from: tuple[int, ...]
    left_to_exploration: tuple[int, ...]
    margin: dict[str, float]
    stopped: tuple[int, ...]


def opened_at(session: Facts) -> datetime:
    """When somebody could first know of a session: it began, or its record was made."""
    return min(session.created_at, session.started_at) if session.started_at else session.created_at


def verdicts(sessions: Sequence[Facts], controllers: Sequence[Controller], locked: LockedMargins) -> list[VerdictResult]:
    """For every controller its confirmatory verdict where there is a lock, and its exploratory one where the other lacks visits that
    earlier sessions could add."""
    found = []
    for controller in controllers:
        confirmed = _after(sessions, locked.locked_at)
        if locked.locked_at is not None:
            found.append(_judge(sessions, confirmed, controller, locked, confirmatory=True))
            if len(found[-1].visits) >= LEAST_VISITS or len(confirmed) == len(sessions):
                continue
        found.append(_judge(sessions, sessions, controller, locked, confirmatory=False))
    return found


def earlier_verdicts(sessions: Sequence[Facts], controllers: Sequence[Controller], locks: Sequence[LockedMargins]) -> list[VerdictResult]:
    """What earlier locks concluded, by lock and controller: of the visits that began under each, by its margins; without planning.

    Args:
        locks: that a newer one followed, oldest first.
    """
    found = []
    for lock in locks:
        later = {s.visit for s in _after(sessions, lock.until)}
        mine = [s for s in _after(sessions, lock.locked_at) if s.visit not in later]
        before = [s for s in sessions if s.visit not in later]
        found += [_judge(before, mine, controller, lock, confirmatory=True, plan=False) for controller in controllers]
    return found


def _after(sessions: Sequence[Facts], moment: datetime | None) -> list[Facts]:
    """Sessions of the visits of which nothing was there before a moment."""
    if moment is None:
        return []
    early = {s.visit for s in sessions if opened_at(s) <= moment}
    return [s for s in sessions if s.visit not in early]


def _judge(
    everything: Sequence[Facts],
    sessions: Sequence[Facts],
    controller: Controller,
    locked: LockedMargins,
    *,
    confirmatory: bool,
    plan: bool = True,
) -> VerdictResult:
    tested = of_controller(controller)
    chosen = choose_each(sessions, ("energy", *FAILURE), tested)
    energy = chosen["energy"]
    outcomes = [outcome_of(name, chosen[name].data, chosen[name].stopped, locked.margins) for name in FAILURE]
    used = {s.visit for s in sessions}
    seen = {s.visit for s in sessions if tested(s)} & {s.visit for s in sessions if s.controller is Controller.CDBS}
    result, lacking = None, NoVerdict.NO_GRASP_REFERENCE if used else NoVerdict.NO_VISIT_AFTER_LOCK
    if all(o is not None for o in outcomes):
        result = assess([o for o in outcomes if o is not None], energy.data, energy.stopped, plan=plan)
    return VerdictResult(
        controller,
        locked,
        confirmatory,
        result,
        lacking if result is None else None,
        tuple(sorted(seen)),
        tuple(sorted(used)),
        tuple(sorted({s.visit for s in everything if tested(s)} - used)),
        {o.name: o.margin for o in outcomes if o is not None},
        tuple(s.session_id for s in sessions if tested(s) and s.stopped is not None),
    )


def outcome_of(name: str, data: Measurements, stopped: NDArray[np.bool_], margins: Margins) -> Outcome | None:
    """An outcome as verdicts judge it, with its margin; None where no cDBS session tells what a share of the grasp frequency is.

    Args:
        name: grasp, rating or tremor. data: its values in both arms, n sessions. stopped: for the patient's sake, [n].
    """
    margin = {"rating": margins.rating_points, "tremor": margins.tremor_points}.get(name)
    if margin is None:
        cells = data.cells
        by_visit = cells.means(data.value[cells.rows])[:, 1]
        cdbs = data.value[~data.tested & np.isfinite(data.value)]
        reference = float(by_visit.mean()) if by_visit.size else float(cdbs.mean()) if cdbs.size else 0.0
        if not reference > 0:
            return None
        margin = margins.grasp_share * reference
        # lowered by the share and lifted by the margin: the average contrast stays, its spread gains that of the reference
        data = replace(data, value=np.where(data.tested, data.value, (1 - margins.grasp_share) * data.value + margin))
    return Outcome(name, data, stopped, margin, HIGHER_IS_BETTER[name], SCALE[name], FAILURE[name])
