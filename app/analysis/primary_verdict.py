"""Test of energy saving without loss: non-inferiority on the participant's margins, then the saving. No database.

A verdict confirms where the margins were locked before every session that it rests on; else it explores. A newer lock does not undo an
older one. Visits that began between the two keep their verdict under the older, so that each is judged by the margins in force at its time.
Where a margin is a share of the value under cDBS, the cDBS values are made worse by it. The test is then "no worse than 1 - share of the
same visit's cDBS", with the spread of that reference in the error. A scale without equal steps is ordinal: made better by its margin, a
value must win at least half of the pairs with the same visit's cDBS.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from app.analysis.facts import Facts, choose_each, of_controller
from app.tables.sessions import Controller
from ml.outcomes import JUDGED, KEYS
from ml.outcomes.records import Outcome
from ml.qoc import Margins, Qoc
from ml.statistics.noninferiority import LEAST_VISITS, Assessment, assess
from ml.statistics.noninferiority import Outcome as JudgedOutcome
from ml.statistics.within_visits.contrasts import Measurements


class NoVerdict(StrEnum):
    """Reason why nothing was assessed."""

    NO_VISIT_AFTER_LOCK = "no_visit_after_lock"
    NO_REFERENCE = "no_reference"


@dataclass(frozen=True)
class LockedMargins:
    """Margins as they were locked, or the present ones where none are locked.

    Attributes:
        reason: of the lock. until: when a newer lock followed; None of the lock in force.
        declared_at, declared_by: of a policy's confirmation by these margins; None of an arm's.
    """

    margins: Margins
    version: int
    locked_at: datetime | None
    locked_by: str | None
    reason: str | None = None
    until: datetime | None = None
    declared_at: datetime | None = None
    declared_by: str | None = None


@dataclass(frozen=True)
class VerdictResult:
    """The verdict on one controller.

    Attributes:
        locked: the margins that it goes by. confirmatory: every session that it rests on began, and was recorded, after their lock.
        assessment: of those sessions; None for the reason in `no_verdict`.
        visits: with both arms, among the sessions that it rests on. drawn_from: all visits of these sessions.
        left_to_exploration: visits before the lock.
        margin: by outcome, in its unit. stopped: sessions of the controller that were stopped for the patient's sake.
        late_stops: so, but known only after their visit was locked: they count as measured.
        policy_shares: of decisions by the policy, in the sessions with a log.
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
    late_stops: tuple[int, ...] = ()
    policy_shares: tuple[float, ...] = ()


def opened_at(session: Facts) -> datetime:
    """Return when a session could first be known: when it began, or when its record was made."""
    return min(session.created_at, session.started_at) if session.started_at else session.created_at


def verdicts(sessions: Sequence[Facts], controllers: Sequence[Controller], locked: LockedMargins, failed: Qoc) -> list[VerdictResult]:
    """Compute the confirmatory verdict of every controller where there is a lock. Add the exploratory one where the first lacks visits that
    earlier sessions could add.

    Args:
        sessions: that count. locked: margins to judge by. failed: what a stopped session of the participant counts as.
    """
    found = []
    for controller in controllers:
        confirmed = _after(sessions, locked.locked_at)
        if locked.locked_at is not None:
            found.append(_judge(sessions, confirmed, controller, locked, failed, confirmatory=True))
            if len(found[-1].visits) >= LEAST_VISITS or len(confirmed) == len(sessions):
                continue
        found.append(_judge(sessions, sessions, controller, locked, failed, confirmatory=False))
    return found


def confirmed_policies(
    sessions: Sequence[Facts], controllers: Mapping[int, Controller], by_policy: Mapping[int, LockedMargins], failure: Qoc
) -> dict[int, VerdictResult]:
    """Return by policy the verdict on all sessions after its confirmation was declared, by the margins that were locked then.

    Args:
        sessions: that count. controllers: that run the declared policies. by_policy: margins and moment of each declaration.
        failure: what a stopped session of the participant counts as.
    """
    return {
        i: _judge(
            [s for s in sessions if s.controller is Controller.CDBS or s.arm.policy_id == i],
            [s for s in _begun_after(sessions, margins.declared_at) if s.controller is Controller.CDBS or s.arm.policy_id == i],
            controllers[i],
            margins,
            failure,
            confirmatory=True,
        )
        for i, margins in by_policy.items()
    }


def policy_verdicts(sessions: Sequence[Facts], margins: LockedMargins, failure: Qoc) -> dict[int, VerdictResult]:
    """Return by policy the verdict on all of its own sessions, by the margins in force, without planning.

    None confirms: earlier sessions decided which policies ran on. Arguments as of `verdicts`, whose `locked` and `failed` these are.
    """
    ran = sorted({(s.arm.policy_id, s.controller) for s in sessions if s.arm.policy_id is not None})
    return {
        i: _judge(
            sessions,
            [s for s in sessions if s.controller is Controller.CDBS or s.arm.policy_id == i],
            controller,
            margins,
            failure,
            confirmatory=False,
            plan=False,
        )
        for i, controller in ran
        if i is not None
    }


def earlier_verdicts(
    sessions: Sequence[Facts], controllers: Sequence[Controller], locks: Sequence[LockedMargins], failed: Qoc
) -> list[VerdictResult]:
    """Compute the conclusions of earlier locks, by lock and controller: of the visits that began under each, by its margins; without
    planning.

    Args:
        locks: that a newer one followed, oldest first. failed: what a stopped session of the participant counts as, as in every verdict.
    """
    found = []
    for lock in locks:
        later = {s.visit for s in _after(sessions, lock.until)}
        mine = [s for s in _after(sessions, lock.locked_at) if s.visit not in later]
        before = [s for s in sessions if s.visit not in later]
        found += [_judge(before, mine, controller, lock, failed, confirmatory=True, plan=False) for controller in controllers]
    return found


def _after(sessions: Sequence[Facts], moment: datetime | None) -> list[Facts]:
    """Select sessions of visits of which nothing existed before a moment."""
    if moment is None:
        return []
    early = {s.visit for s in sessions if opened_at(s) <= moment}
    return [s for s in sessions if s.visit not in early]


def _begun_after(sessions: Sequence[Facts], moment: datetime | None) -> list[Facts]:
    """Return the sessions of the visits that are known to have begun after a moment, by starts or else by the visit's day."""
    early = {s.visit for s in sessions if moment is None or not s.began_after(moment)}
    return [s for s in sessions if s.visit not in early]


def _judge(
    everything: Sequence[Facts],
    sessions: Sequence[Facts],
    controller: Controller,
    locked: LockedMargins,
    failed: Qoc,
    *,
    confirmatory: bool,
    plan: bool = True,
) -> VerdictResult:
    tested = of_controller(controller)
    chosen = choose_each(sessions, ("energy", *KEYS), tested)
    energy = chosen["energy"]
    outcomes = [
        judged_outcome(o, chosen[o.key].data, chosen[o.key].stopped, locked.margins.of(o), getattr(failed, o.field)) for o in JUDGED
    ]
    used = {s.visit for s in sessions}
    seen = {s.visit for s in sessions if tested(s)} & {s.visit for s in sessions if s.controller is Controller.CDBS}
    result, lacking = None, NoVerdict.NO_REFERENCE if used else NoVerdict.NO_VISIT_AFTER_LOCK
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
        tuple(s.session_id for s in sessions if tested(s) and s.late_stop),
        tuple(s.policy_share for s in sessions if tested(s) and s.policy_share is not None),
    )


def judged_outcome(
    outcome: Outcome, data: Measurements, stopped: NDArray[np.bool_], margin: float, failure: float | None
) -> JudgedOutcome | None:
    """Return an outcome as verdicts judge it; None where no cDBS session gives the reference for a share.

    Args:
        outcome: its record. data: its values in both arms, n sessions. stopped: for the patient's sake, [n].
        margin: of the margin's kind. failure: what a stopped session counts as; None where it is unknown.
    """
    if outcome.margin.kind == "share":
        cells = data.cells
        by_visit = cells.means(data.value[cells.rows])[:, 1]
        cdbs = data.value[~data.tested & np.isfinite(data.value)]
        reference = float(by_visit.mean()) if by_visit.size else float(cdbs.mean()) if cdbs.size else 0.0
        if not reference > 0:
            return None
        # made worse by the share and better by the margin: the average contrast stays, its spread gains that of the reference
        share, margin = margin, outcome.margin.amount(margin, reference)
        shifted = outcome.less_margin(data.value, share) + (margin if outcome.higher_is_better else -margin)
        data = replace(data, value=np.where(data.tested, data.value, shifted))
    return JudgedOutcome(outcome.key, data, stopped, margin, outcome.higher_is_better, outcome.scale, failure, outcome.worst_possible)
