"""First answer of the ranking page: what to test, at what cost and risk, one row per distinct behaviour. Values only, no sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from app.evaluation.estimates.coverage import STORED
from app.evaluation.ranking.assessment import Assessed, Assessment
from app.evaluation.ranking.decisions import Decided
from app.study.margins import margins_of
from app.tables.evaluations import Evaluation
from ml.ope import (
    SAME_AMPLITUDE,
    Adaptation,
    BehaviourMap,
    Estimate,
    Gain,
    adaptation_of,
    chance_within,
    gain_by_following,
    interval,
    outcome_draws,
)
from ml.outcomes import FIELDS

ORDER = ("test", "test_with_care", "undecided", "cannot_tell", "likely_worse", "not_advised", "unsafe", "same_as_cdbs")
"""Rows by what to do with them, where the data cannot order policies."""

MAP = "map"
"""Member of what `check_coverage` found."""

SAME_SHARE = 0.02
"""Two policies do the same only where their shares of time nearly off differ by less, whatever they ask for on average."""

AS_THE_TEACHER = 0.02
"""Limit below which a student equals its teacher in mean amplitude and distance to cDBS, in rankings without a map of behaviours."""

OFF_SHARE = 0.8
"""A policy that is nearly off in more than this share of its steps acts like no stimulation."""

LEAST_SAVING = 0.05
"""Of the energy of cDBS; a behaviour that saves less is not worth further sessions to know of."""

Group = Literal["proposed", "open", "not_advised"]
GROUPS: dict[Group, tuple[str, ...]] = {
    "proposed": ("test", "test_with_care"),
    "open": ("undecided", "cannot_tell", "same_as_cdbs"),
    "not_advised": ("likely_worse", "not_advised", "unsafe"),
}
"""Verdicts by what to do with a policy; one that is retired is not advised, whatever its verdict."""

QUANTITIES = ("energy", *FIELDS)


@dataclass(frozen=True)
class Difference:
    """A predicted quantity less that under cDBS, with its 90 % interval; energy as a share of that of cDBS."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Fixed:
    """The best constant amplitude by the scores that rank, where that is another than cDBS: what a controller has to beat.

    Attributes:
        fraction: of the cDBS amplitude. ma: mA; None where the cDBS amplitude is not known.
        row: with the verdict by which a plan takes it.
        within: probability that no outcome is worse than under cDBS by more than its margin.
    """

    fraction: float
    ma: float | None
    row: Row
    within: float | None


@dataclass(frozen=True)
class Row:
    """One behaviour among the candidates.

    Attributes:
        twins: rows of the policies that do the same, each with its own numbers and without twins. decided: the verdict.
        differences: to cDBS, by quantity; a quantity is absent where it is not predicted.
        limit_ma: for a test with care, the lowest amplitude, mA (fraction in `limit` where the cDBS amplitude is not known).
        adapts: how far it adapts its amplitude to beta. adds: what that is estimated to add to its energy all the time. Each is None where
            it is not known.
    """

    one: Assessed
    twins: tuple[Row, ...]
    decided: Decided
    differences: dict[str, Difference]
    limit: float | None
    limit_ma: float | None
    adapts: Adaptation | None = None
    adds: Gain | None = None

    @property
    def within(self) -> float | None:
        """Probability that no outcome is worse than under cDBS by more than its margin."""
        return self.decided.verdict.within if self.decided.verdict else None

    @property
    def saving(self) -> float:
        """Energy that it is expected to save, as a share of that of cDBS; 0 where that is not predicted, or it spends more."""
        return max(0.0, -self.differences["energy"].value) if "energy" in self.differences else 0.0

    @property
    def may_be_picked(self) -> bool:
        """True where a visit may be planned with it without a clinician's reason, and would show anything."""
        return (
            self.decided.standing not in ("unsafe", "likely_worse", "not_advised", "same_as_cdbs")
            and self.one.policy.retired_reason is None
        )


@dataclass(frozen=True)
class Answer:
    """The candidates for a reader: what is worth a visit, what is not, and what is cDBS or no stimulation by another name.

    Attributes:
        rows: distinct behaviours, by value, those with a hazard last. like_cdbs, like_off: folded away.
        ordered: whether the data can order policies. under_cdbs: what is expected under cDBS itself, by quantity, less energy.
        cdbs_ma: its amplitude, mA; None where it is not known. sessions: that the estimates rest on; None without any.
        fixed: the best fixed amplitude; None where that is cDBS, or none was evaluated.
    """

    rows: tuple[Row, ...]
    like_cdbs: tuple[Row, ...]
    like_off: tuple[Row, ...]
    ordered: bool
    under_cdbs: dict[str, float]
    cdbs_ma: float | None = None
    sessions: int | None = None
    fixed: Fixed | None = None

    @property
    def groups(self) -> dict[Group, list[Row]]:
        """Distinct behaviours by what to do with them, each group in the order of `rows`; empty groups are absent.

        A value orders policies and is no safety: the first by value may be likely worse. So what is proposed comes before what is not.
        """
        found: dict[Group, list[Row]] = {name: [] for name in GROUPS}
        for row in self.rows:
            retired = row.one.policy.retired_reason is not None
            own = next(name for name, codes in GROUPS.items() if row.decided.standing in codes)
            found["not_advised" if retired else own].append(row)
        return {name: rows for name, rows in found.items() if rows}

    def of(self, code: str) -> list[Row]:
        """Return the rows of a standing that are not retired."""
        return [r for r in self.rows if r.decided.standing == code and r.one.policy.retired_reason is None]

    @property
    def hazards(self) -> list[Row]:
        """Rows that need a clinician's clearance to run, whatever their verdict, events first; without those of `off`."""
        found = [r for r in (*self.rows, *self.like_off) if _held_back(r) and r not in self.off]
        return sorted(found, key=lambda r: (not _happened(r), not r.decided.hazards))

    @property
    def off(self) -> list[Row]:
        """Rows that need a clinician's clearance to run because they are no stimulation by another name, and for nothing that happened."""
        return [r for r in self.like_off if _held_back(r) and not _happened(r)]

    @property
    def undecided(self) -> list[Row]:
        """Rows that may be run and yet are not worth a visit now."""
        return [r for r in self.rows if r.decided.standing in ("undecided", "cannot_tell") and r.one.policy.retired_reason is None]

    @property
    def pickable(self) -> bool:
        """True where a visit may be planned with a candidate without a clinician's reason."""
        return any(r.may_be_picked for r in (*self.rows, *self.like_cdbs, *self.like_off))

    @property
    def tested(self) -> bool:
        """True where some candidate that was trained here ran in a session, so that a next generation can go on from it."""
        everyone = (row.one for row in self.everyone().values())
        return any(a.tested is not None and a.policy.kind in ("trained", "distilled") for a in everyone)

    @staticmethod
    def counted(rows: Sequence[Row]) -> int:
        """Count the policies of rows, those that do the same among them."""
        return sum(1 + len(row.twins) for row in rows)

    def everyone(self) -> dict[int, Row]:
        """Map every candidate's own row by the id of its policy, as ordered, twins after what they do the same as."""
        rows = (*self.rows, *self.like_cdbs, *self.like_off)
        return {own.one.policy.id: own for r in rows for own in (r, *r.twins)}

    def heads(self) -> dict[int, int]:
        """Map the id of every candidate to that of the one whose row it is in."""
        rows = (*self.rows, *self.like_cdbs, *self.like_off)
        return {own.one.policy.id: r.one.policy.id for r in rows for own in (r, *r.twins)}

    @property
    def cheapest(self) -> list[Row]:
        """Rows that the fewest further sessions would decide, what saves most and is likely within the margins first.

        What is expected to save less than `LEAST_SAVING` is excluded, unless nothing else is there: to know of it helps no patient.
        """
        told = [(n, r) for r in self.undecided for n in [_needed(r)] if n is not None]
        worth = [(n, r) for n, r in told if r.saving >= LEAST_SAVING] or told
        fewest = min((n for n, _ in worth), default=None)
        return sorted((r for n, r in worth if n == fewest), key=lambda r: (-(r.within or 0.0) * r.saving, -(r.within or 0.0)))


def answer(found: Assessment) -> Answer:
    """Build the answer about an assessment's candidates."""
    known = map_of(found.evaluation)
    rows = [_row(found, known, one, tuple(_row(found, known, twin) for twin in twins)) for one, *twins in behaviours(found)]
    if not found.ordered:
        rows.sort(key=lambda r: ORDER.index(r.decided.standing))
    off = [r for r in rows if _nearly_off(r.one.posterior) > OFF_SHARE]
    same = [r for r in rows if r.decided.decision == "same_as_cdbs" and r not in off]
    distinct = tuple(r for r in rows if r not in off and r not in same)
    sessions = found.cdbs.posterior.n if found.cdbs and found.cdbs.posterior else None
    usual = _under_cdbs(found)
    return Answer(distinct, tuple(same), tuple(off), found.ordered, usual, found.cdbs_ma, sessions, _fixed(found))


def differences(own: Estimate | None, cdbs: Estimate | None) -> dict[str, Difference]:
    """Compute predicted quantities less those under cDBS, from aligned draws."""
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


def map_of(evaluation: Evaluation) -> BehaviourMap | None:
    """Read the map of what its policies request at which beta, and how far they are apart; None of an evaluation without a map."""
    stored = (evaluation.diagnostics.get(STORED) or {}).get(MAP)
    return BehaviourMap.from_json(stored) if stored else None


def behaviours(found: Assessment) -> list[list[Assessed]]:
    """Group the candidates by what they do, in the order of the assessment; the first of each group represents it.

    A policy joins a group where it does the same as the one that represents it. They have the same verdict for the same hazards, and as
    much time nearly off. Their amplitudes are at most `SAME_AMPLITUDE` of cDBS apart on average over the recorded states; *same as cDBS* is
    judged by that too. A tested policy comes before one that was not, and a teacher before its student.
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


def _nearly_off(estimate: Estimate | None) -> float:
    """Return the share of time in which a policy requests less than 20 % of cDBS; 0 where it is not known."""
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
    return distance <= SAME_AMPLITUDE and abs(_nearly_off(a.posterior) - _nearly_off(b.posterior)) < SAME_SHARE


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


def _row(found: Assessment, beta_map: BehaviourMap | None, one: Assessed, twins: tuple[Row, ...] = ()) -> Row:
    if one.decided is None:
        raise ValueError(f"policy {one.policy.id} is a reference and has no verdict")
    limit = one.decided.limit
    cdbs = found.cdbs.posterior if found.cdbs else None
    ma = None if limit is None or found.cdbs_ma is None else limit * found.cdbs_ma
    adapts = adaptation_of(beta_map, str(one.policy.id)) if beta_map is not None else None
    constants = [(a.policy.amplitude, a.posterior) for a in found.references if a.policy.amplitude is not None and a.posterior is not None]
    adds = gain_by_following(one.posterior, constants) if one.posterior is not None else None
    return Row(one, twins, one.decided, differences(one.posterior, cdbs), limit, ma, adapts, adds)


def _fixed(found: Assessment) -> Fixed | None:
    one = next((a for a in found.references if a.reference == "best_constant"), None)
    cdbs = found.cdbs.posterior if found.cdbs else None
    if one is None or one.posterior is None or cdbs is None or one.policy.amplitude is None or one.planned is None or not found.ordered:
        return None
    ma = None if found.cdbs_ma is None else one.policy.amplitude * found.cdbs_ma
    within = chance_within(one.posterior, cdbs, margins_of(found.participant.margins_in_force))
    # it adapts to nothing
    row = replace(_row(found, None, replace(one, decided=one.planned)), adds=None)
    return Fixed(one.policy.amplitude, ma, row, within)


def _held_back(row: Row) -> bool:
    return row.decided.needs_override and row.one.policy.retired_reason is None


def _under_cdbs(found: Assessment) -> dict[str, float]:
    own = found.cdbs.posterior if found.cdbs else None
    drawn = {name: outcome_draws(own, name) for name in QUANTITIES[1:]} if own is not None else {}
    return {name: float(draws.mean()) for name, draws in drawn.items() if draws is not None}


def _happened(row: Row) -> bool:
    return any(reason.code in ("adverse_event", "stopped") for reason in row.decided.reasons)


def _needed(row: Row) -> float | None:
    return next((r.value for r in row.decided.reasons if r.code == "sessions_needed"), None)
