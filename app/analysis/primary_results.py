"""Controllers and policies against the same visit's cDBS: what is computed of one participant's sessions. No database.

The planned family, stated before any data: the five metrics of RL and of distilled RL. Holm's adjustment covers it. Everything else (other
controllers, single policies) is exploration, with the share of false discoveries by Benjamini and Hochberg.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from functools import cached_property

from app.analysis.facts import METRICS, Chosen, Facts, choose_each, of_controller
from app.tables.sessions import LEARNED, Controller
from ml.statistics.effects import Saving, cliffs_delta, energy_saving
from ml.statistics.multiplicity import benjamini_hochberg, holm
from ml.statistics.ranksum import RankSum, as_in_the_paper
from ml.statistics.within_visits.averages import order_imbalance, primary
from ml.statistics.within_visits.contrasts import Average, Measurements, Unavailable, VisitContrasts, visit_contrasts
from ml.statistics.within_visits.sensitivity import Sensitivity, sensitivities
from ml.statistics.within_visits.stratified import StratifiedTest, van_elteren

ALPHA = 0.05
LEVEL = 0.95
"""Controllers of the planned family."""


class Role(StrEnum):
    """Purpose of a comparison."""

    PLANNED = "planned"
    EXPLORATION = "exploration"


class Disagreement(StrEnum):
    """Difference between the paper's test and the primary one."""

    PAPER_ONLY = "paper_only"
    PRIMARY_ONLY = "primary_only"
    NO_PRIMARY = "no_primary"


class Basis(StrEnum):
    """Sessions of a policy that a comparison rests on: those after it was last picked, or those that may have picked it."""

    ALL = "all"
    CONFIRMATION = "confirmation"
    SELECTION = "selection"


@dataclass(frozen=True)
class Tested:
    """A controller, or one policy of it; `basis` and `sessions` are of the sessions that its comparisons rest on."""

    controller: Controller
    policy_id: int | None
    policy_name: str | None
    role: Role
    basis: Basis
    sessions: tuple[int, ...]
    selection_sessions: tuple[int, ...]

    @property
    def key(self) -> str:
        """A short name for addresses: `rl`, `policy-7`."""
        return self.controller.value if self.policy_id is None else f"policy-{self.policy_id}"


@dataclass(frozen=True)
class VisitRow:
    """One visit of a comparison: its contrast (None where an arm is missing) and the sessions behind it."""

    visit: int
    contrast: float | None
    tested: tuple[int, ...]
    cdbs: tuple[int, ...]


@dataclass(frozen=True)
class Comparison:
    """One metric of one controller. What only the page of its visits shows is computed when it is first asked for.

    Attributes:
        data: what it is computed of. result: the primary average over visits, or why there is none.
        p_adjusted: by Holm (planned) or Benjamini-Hochberg (exploration). paper: the paper's test.
        imbalance: of the order, in SDs of the place. rows: every visit with a session of the controller or of cDBS.
        disagreement: of the paper's test with the primary one; None where they agree.
    """

    metric: str
    data: Measurements = field(repr=False, compare=False)
    result: Average | Unavailable
    p_adjusted: float | None
    paper: RankSum | Unavailable
    imbalance: float | None
    rows: tuple[VisitRow, ...]
    disagreement: Disagreement | None

    @cached_property
    def delta(self) -> Average | Unavailable:
        """Cliff's delta over visits."""
        return cliffs_delta(self.data, LEVEL)

    @cached_property
    def saving(self) -> Saving | Unavailable | None:
        """Energy saved; None of other metrics."""
        return energy_saving(self.data, LEVEL) if self.metric == "energy" else None

    @cached_property
    def exact(self) -> StratifiedTest | Unavailable:
        """Van Elteren's test."""
        return van_elteren(self.data)

    @cached_property
    def sensitivity(self) -> tuple[Sensitivity, ...]:
        """Alternative analyses."""
        return sensitivities(self.data, LEVEL)

    @property
    def evidence_visits(self) -> tuple[int, ...]:
        """Visits with both arms."""
        return tuple(r.visit for r in self.rows if r.contrast is not None)

    @property
    def lacking_visits(self) -> tuple[int, ...]:
        """Visits at which the controller ran and that lack one of the arms with this metric: they give no primary evidence."""
        return tuple(r.visit for r in self.rows if r.contrast is None and r.tested)


@dataclass(frozen=True)
class ControllerResult:
    """All metrics of a controller or policy."""

    tested: Tested
    comparisons: tuple[Comparison, ...]

    def of(self, metric: str) -> Comparison:
        """Return the comparison of a metric."""
        return next(c for c in self.comparisons if c.metric == metric)


def results(sessions: Sequence[Facts], names: Mapping[int, str], picked_at: Mapping[int, datetime]) -> tuple[ControllerResult, ...]:
    """Compute the result of every controller, then of every policy.

    Args:
        sessions: that count, with comparable beta. names: of policies. picked_at: when each policy was last put on an approved plan.
            Earlier sessions may have picked it.
    """
    controllers = [c for c in Controller if c is not Controller.CDBS and any(s.controller is c for s in sessions)]
    found = [_of_controller(sessions, c) for c in controllers]
    policies = sorted({(s.arm.policy_id, s.controller) for s in sessions if s.arm.policy_id is not None}, key=lambda p: (p[1].value, p[0]))
    found += [_of_policy(sessions, c, i, names.get(i), picked_at.get(i)) for i, c in policies if i is not None]
    return tuple(_adjusted(found))


def planned_results(sessions: Sequence[Facts]) -> tuple[ControllerResult, ...]:
    """Compute the controllers of the planned family that ran, without policies and adjusted p-values."""
    return tuple(_of_controller(sessions, c) for c in LEARNED if any(s.controller is c for s in sessions))


def _of_controller(sessions: Sequence[Facts], controller: Controller) -> ControllerResult:
    mine = tuple(s.session_id for s in sessions if s.controller is controller)
    role = Role.PLANNED if controller in LEARNED else Role.EXPLORATION
    return _compared(sessions, Tested(controller, None, None, role, Basis.ALL, mine, ()), of_controller(controller))


def _of_policy(
    sessions: Sequence[Facts], controller: Controller, policy_id: int, name: str | None, picked_at: datetime | None
) -> ControllerResult:
    """Compare a policy; sessions that may have begun before it was last picked confirm nothing where later ones are there."""
    mine = [s for s in sessions if s.arm.policy_id == policy_id and s.controller is controller]
    before = [s for s in mine if picked_at is not None and not s.began_after(picked_at)]
    after = [s for s in mine if s not in before]
    basis, used = (Basis.CONFIRMATION, after) if after else (Basis.SELECTION, before)
    ids = {s.session_id for s in used}
    tested = Tested(
        controller, policy_id, name, Role.EXPLORATION, basis, tuple(sorted(ids)), tuple(s.session_id for s in before) if after else ()
    )
    return _compared(sessions, tested, lambda s: s.session_id in ids)


def _compared(sessions: Sequence[Facts], tested: Tested, is_tested: Callable[[Facts], bool]) -> ControllerResult:
    return ControllerResult(tested, tuple(_comparison(chosen, m) for m, chosen in choose_each(sessions, METRICS, is_tested).items()))


def _comparison(chosen: Chosen, metric: str) -> Comparison:
    data = chosen.data
    found, paper = primary(data, LEVEL), as_in_the_paper(data, LEVEL)
    return Comparison(
        metric=metric,
        data=data,
        result=found,
        p_adjusted=None,
        paper=paper,
        imbalance=order_imbalance(data),
        rows=_rows(chosen, visit_contrasts(data)),
        disagreement=_disagreement(found, paper),
    )


def _rows(chosen: Chosen, contrasts: VisitContrasts | Unavailable) -> tuple[VisitRow, ...]:
    known = {} if isinstance(contrasts, Unavailable) else dict(zip(contrasts.visit.tolist(), contrasts.contrast.tolist(), strict=True))
    visits: dict[int, tuple[list[int], list[int], list[int]]] = {}
    for s, tested, value in zip(chosen.sessions, chosen.data.tested.tolist(), chosen.data.value.tolist(), strict=True):
        measured, cdbs, ran = visits.setdefault(s.visit, ([], [], []))
        if tested:
            ran.append(s.session_id)
        if value == value:
            (measured if tested else cdbs).append(s.session_id)
    return tuple(VisitRow(v, known.get(v), tuple(one or ran), tuple(two)) for v, (one, two, ran) in sorted(visits.items()))


def _disagreement(found: Average | Unavailable, paper: RankSum | Unavailable) -> Disagreement | None:
    shown = isinstance(paper, RankSum) and paper.p_value < ALPHA
    if isinstance(found, Unavailable):
        return Disagreement.NO_PRIMARY if shown else None
    if shown != (found.p_value < ALPHA):
        return Disagreement.PAPER_ONLY if shown else Disagreement.PRIMARY_ONLY
    return None


def _adjusted(found: Sequence[ControllerResult]) -> list[ControllerResult]:
    """Fill in the adjusted p-values of both families."""
    adjusted: dict[tuple[int, int], float] = {}
    for role, adjust in ((Role.PLANNED, holm), (Role.EXPLORATION, benjamini_hochberg)):
        places = [
            (i, k, c.result.p_value)
            for i, r in enumerate(found)
            if r.tested.role is role
            for k, c in enumerate(r.comparisons)
            if isinstance(c.result, Average)
        ]
        if places:
            adjusted |= {(i, k): p for (i, k, _), p in zip(places, adjust([p for _, _, p in places]), strict=True)}
    return [
        replace(r, comparisons=tuple(replace(c, p_adjusted=adjusted.get((i, k))) for k, c in enumerate(r.comparisons)))
        for i, r in enumerate(found)
    ]
