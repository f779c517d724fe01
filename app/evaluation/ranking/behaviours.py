"""Which candidates do the same: one row of the ranking is one behaviour, whoever was trained to it, by which algorithm and from what."""

from __future__ import annotations

from app.evaluation.estimates.coverage import STORED
from app.evaluation.models import Evaluation
from app.evaluation.ranking.assessment import Assessed, Assessment
from ml.ope.estimate import Estimate
from ml.ope.posterior.verdict import SAME_AMPLITUDE
from ml.ope.support.behaviour_map import BehaviourMap

MAP = "map"
"""Member of what `check_coverage` found."""

SAME_SHARE = 0.02
"""Two policies do the same only where their shares of time nearly off differ by less, whatever they ask for on average."""

AS_THE_TEACHER = 0.02
"""Of a ranking of before distances were stored: a student whose mean amplitude and distance to cDBS differ from its teacher's by less does
what its teacher does; of other pairs nothing is known there."""


def map_of(evaluation: Evaluation) -> BehaviourMap | None:
    """What its policies ask for at which beta, and how far they are apart; None of an evaluation of before it was stored."""
    stored = (evaluation.diagnostics.get(STORED) or {}).get(MAP)
    return BehaviourMap.from_json(stored) if stored else None


def behaviours(found: Assessment) -> list[list[Assessed]]:
    """The candidates by what they do, in the order of the assessment; first in each group the one that stands for it.

    A policy joins a group where it does the same as the one that stands for it: the same verdict for the same hazards, amplitudes that are
    at most `SAME_AMPLITUDE` of cDBS apart on average over the recorded states, by which *same as cDBS* is judged too, and as much time
    nearly off. One that was tested stands before one that was not, and a teacher before its student.
    """
    known = map_of(found.evaluation)
    candidates = [a for a in found.candidates if a.decided is not None]
    places = {a.policy.id: k for k, a in enumerate(candidates)}
    groups: list[list[Assessed]] = []
    for a in sorted(candidates, key=lambda a: (a.tested is None, a.policy.teacher_id is not None, places[a.policy.id])):
        own = next((group for group in groups if _same(a, group[0], known)), None)
        if own is None:
            groups.append([a])
        else:
            own.append(a)
    return sorted(groups, key=lambda group: places[group[0].policy.id])


def nearly_off(estimate: Estimate | None) -> float:
    """Share of time in which a policy asks for less than 20 % of cDBS; 0 where it is not known."""
    return float(_behaviour(estimate).get("below_cdbs_20_percent") or 0.0)


def _same(a: Assessed, b: Assessed, known: BehaviourMap | None) -> bool:
    if a.decided is None or b.decided is None or a.decided.standing != b.decided.standing:
        return False
    if {h.code for h in a.decided.hazards} != {h.code for h in b.decided.hazards}:
        return False
    if (a.policy.retired_reason is None) != (b.policy.retired_reason is None):
        return False
    distance = known.distance(str(a.policy.id), str(b.policy.id)) if known is not None else None
    if distance is None:
        return _as_its_teacher(a, b) or _as_its_teacher(b, a)
    return distance <= SAME_AMPLITUDE and abs(nearly_off(a.posterior) - nearly_off(b.posterior)) < SAME_SHARE


def _as_its_teacher(student: Assessed, teacher: Assessed) -> bool:
    if student.policy.teacher_id != teacher.policy.id:
        return False
    ours, theirs = _behaviour(student.posterior), _behaviour(teacher.posterior)
    names = ("mean_amplitude", "closeness_to_cdbs", "below_cdbs_20_percent")
    return all(
        ours.get(name) is not None and theirs.get(name) is not None and abs(float(ours[name]) - float(theirs[name])) < AS_THE_TEACHER
        for name in names
    )


def _behaviour(estimate: Estimate | None) -> dict[str, float]:
    return (estimate.details.get("behaviour") or {}) if estimate is not None else {}
