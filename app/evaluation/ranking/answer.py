"""What the ranking page answers first: what to test, at what cost and risk, one row per distinct behaviour. Values only, no sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.evaluation.ranking.assessment import Assessed, Assessment
from app.evaluation.ranking.decisions import Decided
from ml.ope.estimate import Estimate
from ml.ope.posterior.verdict import interval, outcome_draws

ORDER = ("test", "test_with_care", "cannot_tell", "not_advised", "unsafe", "same_as_cdbs")
"""Rows by what to do with them; within a verdict as the ranking has them."""

SAME_BEHAVIOUR = 0.02
"""A student whose mean amplitude and distance to cDBS differ from its teacher's by less does what its teacher does."""

OFF_SHARE = 0.8
"""A policy that is nearly off in more than this share of its steps acts like no stimulation."""

LEAST_SAVING = 0.05
"""Of the energy of cDBS; a behaviour that saves less is not worth further sessions to know of."""

QUANTITIES = ("energy", "grasp_hz", "rating", "tremor_percent")


@dataclass(frozen=True)
class Difference:
    """A predicted quantity less that under cDBS, with its 90 % interval; energy as a share of that of cDBS."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Row:
    """One behaviour among the candidates.

    Attributes:
        twins: policies that do the same, such as its students. decided: the verdict.
        differences: to cDBS, by quantity; a quantity is absent where it is not predicted.
        limit_ma: for a test with care, the lowest amplitude, mA (fraction in `limit` where the cDBS amplitude is not known).
    """

    one: Assessed
    twins: tuple[Assessed, ...]
    decided: Decided
    differences: dict[str, Difference]
    limit: float | None
    limit_ma: float | None

    @property
    def within(self) -> float | None:
        """Probability that grasp, rating and tremor are all no worse than cDBS by more than their margins."""
        return self.decided.verdict.within if self.decided.verdict else None

    @property
    def saving(self) -> float:
        """Energy that it is expected to save, as a share of that of cDBS; 0 where that is not predicted, or it spends more."""
        return max(0.0, -self.differences["energy"].value) if "energy" in self.differences else 0.0

    @property
    def may_be_picked(self) -> bool:
        """Whether a visit may be planned with it, without a clinician's reason, and would show anything."""
        return self.decided.standing not in ("unsafe", "not_advised", "same_as_cdbs") and self.one.policy.retired_reason is None


@dataclass(frozen=True)
class Answer:
    """The candidates for a reader: what is worth a visit, what is not, and what is cDBS or no stimulation by another name.

    Attributes:
        rows: distinct behaviours, what to test first. like_cdbs, like_off: folded away.
        ordered: whether the data can order policies. under_cdbs: what is expected under cDBS itself, by quantity, less energy.
    """

    rows: tuple[Row, ...]
    like_cdbs: tuple[Row, ...]
    like_off: tuple[Row, ...]
    ordered: bool
    under_cdbs: dict[str, float]

    def of(self, code: str) -> list[Row]:
        """Rows that stand so and are not retired."""
        return [r for r in self.rows if r.decided.standing == code and r.one.policy.retired_reason is None]

    @property
    def hazards(self) -> list[Row]:
        """What is not to be run without a clinician's word, whatever its verdict; less what `off` holds."""
        return [r for r in (*self.rows, *self.like_off) if _held_back(r) and r not in self.off]

    @property
    def off(self) -> list[Row]:
        """What is not to be run without a clinician's word because it is no stimulation by another name, and for nothing that happened."""
        return [r for r in self.like_off if _held_back(r) and all(reason.code != "adverse_event" for reason in r.decided.reasons)]

    @property
    def undecided(self) -> list[Row]:
        """What may be run and yet is not worth a visit now."""
        return [r for r in self.rows if r.decided.standing == "cannot_tell" and r.one.policy.retired_reason is None]

    @property
    def pickable(self) -> bool:
        """Whether there is a candidate that a visit may be planned with, without a clinician's reason."""
        return any(r.may_be_picked for r in (*self.rows, *self.like_cdbs, *self.like_off))

    @property
    def tested(self) -> bool:
        """Whether some candidate that was trained here ran in a session, so that a next generation can go on from it."""
        everyone = (a for row in (*self.rows, *self.like_cdbs, *self.like_off) for a in (row.one, *row.twins))
        return any(a.tested is not None and a.policy.kind in ("trained", "distilled") for a in everyone)

    def everyone(self) -> dict[int, Row]:
        """Every candidate's row by the id of its policy, what to test first; twins have the row of what they do the same as."""
        rows = (*self.rows, *self.like_cdbs, *self.like_off)
        return {a.policy.id: r for r in rows for a in (r.one, *r.twins)}

    @property
    def cheapest(self) -> list[Row]:
        """The rows that the fewest further sessions would tell, what saves most and is likely within the margins first.

        What is expected to save less than `LEAST_SAVING` is left out, unless nothing else is there: to know of it helps nobody.
        """
        told = [(n, r) for r in self.undecided for n in [_needed(r)] if n is not None]
        worth = [(n, r) for n, r in told if r.saving >= LEAST_SAVING] or told
        fewest = min((n for n, _ in worth), default=None)
        return sorted((r for n, r in worth if n == fewest), key=lambda r: (-(r.within or 0.0) * r.saving, -(r.within or 0.0)))


def answer(found: Assessment) -> Answer:
    """What to say of an assessment's candidates."""
    rows = _distinct(found)
    rows.sort(key=lambda r: ORDER.index(r.decided.standing))  # stable: within a verdict as ranked
    off = [r for r in rows if _like_off(r.one.posterior)]
    same = [r for r in rows if r.decided.decision == "same_as_cdbs" and r not in off]
    return Answer(tuple(r for r in rows if r not in off and r not in same), tuple(same), tuple(off), found.ordered, _under_cdbs(found))


def differences(own: Estimate | None, cdbs: Estimate | None) -> dict[str, Difference]:
    """Predicted quantities less those under cDBS, from aligned draws."""
    found: dict[str, Difference] = {}
    if own is None or cdbs is None:
        return found
    for name in QUANTITIES:
        ours, theirs = outcome_draws(own, name), outcome_draws(cdbs, name)
        if ours is None or theirs is None or ours.size != theirs.size:
            continue
        apart = (ours - theirs) / np.mean(theirs) if name == "energy" else ours - theirs
        found[name] = Difference(float(apart.mean()), *interval(apart))
    return found


def _distinct(found: Assessment) -> list[Row]:
    """Candidates with the students that do the same folded under their teacher."""
    candidates = [a for a in found.candidates if a.decided is not None]
    by_id = {a.policy.id: a for a in candidates}
    twins: dict[int, list[Assessed]] = {}
    for a in candidates:
        teacher = by_id.get(a.policy.teacher_id) if a.policy.teacher_id is not None else None
        if teacher is not None and _same(a, teacher):
            twins.setdefault(teacher.policy.id, []).append(a)
    folded = {a.policy.id for group in twins.values() for a in group}
    return [_row(found, a, twins.get(a.policy.id, ())) for a in candidates if a.policy.id not in folded]


def _row(found: Assessment, one: Assessed, twins: Sequence[Assessed]) -> Row:
    if one.decided is None:
        raise ValueError(f"policy {one.policy.id} is a reference and has no verdict")
    limit = one.decided.limit
    cdbs = found.cdbs.posterior if found.cdbs else None
    ma = None if limit is None or found.cdbs_ma is None else limit * found.cdbs_ma
    return Row(one, tuple(twins), one.decided, differences(one.posterior, cdbs), limit, ma)


def _same(student: Assessed, teacher: Assessed) -> bool:
    if student.decided is None or teacher.decided is None or student.decided.decision != teacher.decided.decision:
        return False
    if student.decided.needs_override != teacher.decided.needs_override:
        return False
    if (student.policy.retired_reason is None) != (teacher.policy.retired_reason is None):
        return False
    ours, theirs = _behaviour(student.posterior), _behaviour(teacher.posterior)
    return bool(ours) and bool(theirs) and all(abs(a - b) < SAME_BEHAVIOUR for a, b in zip(ours, theirs, strict=True))


def _behaviour(estimate: Estimate | None) -> tuple[float, ...]:
    known = (estimate.details.get("behaviour") or {}) if estimate is not None else {}
    names = ("mean_amplitude", "closeness_to_cdbs", "below_cdbs_20_percent")
    return tuple(float(known[name]) for name in names) if all(known.get(name) is not None for name in names) else ()


def _like_off(estimate: Estimate | None) -> bool:
    known = (estimate.details.get("behaviour") or {}) if estimate is not None else {}
    return float(known.get("below_cdbs_20_percent") or 0.0) > OFF_SHARE


def _held_back(row: Row) -> bool:
    return row.decided.needs_override and row.one.policy.retired_reason is None


def _under_cdbs(found: Assessment) -> dict[str, float]:
    own = found.cdbs.posterior if found.cdbs else None
    drawn = {name: outcome_draws(own, name) for name in QUANTITIES[1:]} if own is not None else {}
    return {name: float(draws.mean()) for name, draws in drawn.items() if draws is not None}


def _needed(row: Row) -> float | None:
    return next((r.value for r in row.decided.reasons if r.code == "sessions_needed"), None)
