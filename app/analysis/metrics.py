"""The five metrics of every controller against cDBS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis import primary, primary_words
from app.analysis.evidence import Evidence, evidence
from app.analysis.facts import METRICS, BetaKind, Facts, comparable_beta, with_comparable_beta
from app.platform.kept import kept
from app.platform.numbers import counted, p_text
from app.study.blinding import CONTROLLER_NAMES
from app.study.sessions.stimulation import MEAN_FRACTION, fits
from app.tables.participants import Participant
from app.tables.sessions import Controller
from ml.energy import saving_percent
from ml.statistics.multiplicity import holm
from ml.statistics.ranksum import rank_sum

# One metric of every controller against cDBS: groups, Wilcoxon rank-sum tests, and when there is not enough data for one. No database.
#
# Source: Gao et al. 2023, section 6.1. Ours: the check of the numbers of sessions, Holm's adjustment, the difference with its interval.

ALPHA = 0.05
LEVEL = 0.95
"""Coverage of the intervals of differences."""


@dataclass(frozen=True)
class Group:
    """Values of one metric under one controller.

    Attributes:
        n: sessions with a value.
        median, q1, q3: None where n is 0.
        values, session_ids: aligned, in the order of the sessions.
    """

    controller: Controller
    label: str
    n: int
    median: float | None
    q1: float | None
    q3: float | None
    values: tuple[float, ...]
    session_ids: tuple[int, ...]


@dataclass(frozen=True)
class Comparison:
    """A controller against cDBS.

    Attributes:
        p_value: two-sided, unadjusted as in the paper; None where there is not enough data.
        p_holm: the same adjusted for all comparisons of the participant.
        method: `exact` or `normal approximation`.
        difference: Hodges-Lehmann estimate of controller less cDBS, in the metric's unit.
        low, high: its interval of `level`.
        note: the check that failed; empty where the test was made.
    """

    controller: Controller
    label: str
    n_controller: int
    n_cdbs: int
    p_value: float | None = None
    p_holm: float | None = None
    method: str | None = None
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    level: float = LEVEL
    note: str = ""


def group(controller: Controller, values: Mapping[int, float]) -> Group:
    """Summarise values by session id."""
    numbers = tuple(float(v) for v in values.values())
    q1, median, q3 = (float(q) for q in np.percentile(numbers, (25, 50, 75))) if numbers else (None, None, None)
    return Group(controller, CONTROLLER_NAMES[controller], len(numbers), median, q1, q3, numbers, tuple(values))


def compare(tested: Group, cdbs: Group) -> Comparison:
    """Compare a controller with cDBS by a two-sided Wilcoxon rank-sum test, or name the check that failed."""
    plain = Comparison(tested.controller, tested.label, tested.n, cdbs.n)
    missing = not_enough(tested, cdbs)
    if missing:
        return replace(plain, note=missing)
    result = rank_sum(tested.values, cdbs.values, level=LEVEL)
    return replace(plain, p_value=result.p_value, method=result.method, difference=result.shift, low=result.low, high=result.high)


def smallest_p(n_x: int, n_y: int) -> float:
    """Return the smallest two-sided p of the exact test of so many sessions: both most extreme of all equally likely rankings."""
    return min(1.0, 2 / comb(n_x + n_y, n_x))


def sessions_needed(n_other: int) -> int | None:
    """Return the fewest sessions that can reach p < .05 against `n_other` sessions; None where the other side has none."""
    if n_other < 1:
        return None
    n = 1
    while smallest_p(n, n_other) >= ALPHA:
        n += 1
    return n


def not_enough(tested: Group, cdbs: Group) -> str:
    """Explain why the test is not made: the numbers of sessions cannot give p < .05 whatever the values are. Empty where they can."""
    if smallest_p(tested.n, cdbs.n) < ALPHA:
        return ""
    found = f"{tested.label} has {tested.n}, {cdbs.label} {cdbs.n}"
    if min(tested.n, cdbs.n) == 0:
        return f"needs at least 4 sessions with this metric on each side; {found}"
    needed = sessions_needed(cdbs.n)
    unequal = "" if needed == cdbs.n else f", or {needed} against {cdbs.n}"
    return (
        f"needs at least 4 sessions on each side{unequal}; {found}. "
        f"So few cannot give a two-sided p below {p_text(smallest_p(tested.n, cdbs.n))}"
    )


def adjust(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Fill in `p_holm` over all tests that were made."""
    made = [c.p_value for c in comparisons if c.p_value is not None]
    adjusted = iter(holm(made))
    return [c if c.p_value is None else replace(c, p_holm=next(adjusted)) for c in comparisons]


# Five metrics of every controller against cDBS, as in the paper's results. Source: Gao et al. 2023, section 6.1.

LIMITS = (
    "Sessions of one visit are not independent: they share the day, the medication and what the session before left. The test treats "
    "them as independent, so that its p-values may be too small.",
    "A p of .05 or more does not show that two controllers do equally well; the difference and its interval say what the data leave open.",
    "Energy is the mean squared amplitude fraction of the session's steps, at the pulse width and rate of cDBS. Every session counts once, "
    "whatever its length, and all policies of one kind are taken together.",
)


@dataclass(frozen=True)
class AmplitudeMismatch:
    """A session whose mean amplitude fraction is not that of its controller; it counts all the same until it is corrected."""

    session_id: int
    visit: int
    ordinal: int
    controller: Controller
    mean_fraction: float
    text: str


@dataclass(frozen=True)
class MissingValue:
    """A metric that a session which counts does not have."""

    session_id: int
    visit: int
    ordinal: int
    metric: str
    reason: str


@dataclass(frozen=True)
class PolicyResult:
    """One metric of one policy, and its comparison with cDBS."""

    policy_id: int
    group: Group
    comparison: Comparison


@dataclass(frozen=True)
class Excluded:
    """A session that the analysis leaves out altogether."""

    session_id: int
    visit: int
    ordinal: int
    reason: str


@dataclass(frozen=True)
class ControllerSummary:
    """One controller's share of the study (the paper's table of trial time), and what it saves.

    Attributes:
        energy_saving_percent: against the mean energy of the cDBS sessions; None without both, and for cDBS itself.
        session_ids: of its sessions that count.
    """

    controller: Controller
    label: str
    sessions: int
    minutes: float
    energy_saving_percent: float | None
    session_ids: tuple[int, ...]


@dataclass(frozen=True)
class MetricResult:
    """One metric by controller, each compared with cDBS.

    Attributes:
        policies: the same by policy. notes: sessions that this metric leaves out, and why.
    """

    metric: str
    title: str
    unit: str
    groups: list[Group]
    comparisons: list[Comparison]
    policies: list[PolicyResult]
    notes: list[str]

    @property
    def n(self) -> int:
        """Sessions with a value."""
        return sum(g.n for g in self.groups)


@dataclass(frozen=True)
class FiveMetrics:
    """The analysis of one participant."""

    participant: str
    sessions: int
    controllers: list[ControllerSummary]
    metrics: list[MetricResult]
    excluded: list[Excluded]
    missing: list[MissingValue]
    warnings: list[AmplitudeMismatch]
    limits: list[str]


def five_metrics(db: Session, participant: Participant, caller: Caller, held: Evidence | None = None) -> FiveMetrics:
    """Compute energy, mean beta and outcomes of every session, by controller and by policy, each compared with cDBS.

    `held`: the evidence, where it is at hand.
    """
    return of_all(db, [participant], [held or evidence(db, participant, caller)])[0]


def of_all(db: Session, participants: Sequence[Participant], held: Sequence[Evidence]) -> list[FiveMetrics]:
    """Compute the five metrics of several participants, whose evidence is `held`."""
    names = primary.find_policy_names(db, [p.id for p in participants])
    return [_of(h, names[p.id]) for p, h in zip(participants, held, strict=True)]


def _of(held: Evidence, names: Mapping[int, str]) -> FiveMetrics:
    return kept(("metrics", held.key, tuple(sorted(names.items()))), lambda: _compute(held, names))


def _compute(held: Evidence, names: Mapping[int, str]) -> FiveMetrics:
    kind = comparable_beta(held.sessions, held.beta_unit, held.beta_source)
    included = with_comparable_beta(held.sessions, kind)
    present = [c for c in Controller if any(s.controller is c for s in included)]
    metrics = _adjusted([_metric(name, included, present, kind, names, held.sessions) for name in METRICS])
    tests = sum(c.p_value is not None for m in metrics for c in m.comparisons)
    holm = f"p-values are unadjusted, as in the paper; Holm's adjustment beside them covers all {tests} comparisons of this page."
    controllers = [_summary(c, [s for s in included if s.controller is c], metrics[0]) for c in present]
    excluded = [Excluded(e.session_id, e.visit, e.ordinal, primary_words.left_out(e)) for e in held.excluded]
    missing = [
        MissingValue(s.session_id, s.visit, s.ordinal, name, primary_words.MISSING[why])
        for s in included
        for name, why in s.missing.items()
    ]
    return FiveMetrics(held.participant, len(included), controllers, metrics, excluded, missing, _mismatches(included), [*LIMITS, holm])


def _mismatches(sessions: Sequence[Facts]) -> list[AmplitudeMismatch]:
    """Find sessions whose stimulation differs from what their controller implies."""
    found = []
    for s in sessions:
        mean = s.mean_fraction
        if mean is None or fits(s.controller, mean):
            continue
        low, high = MEAN_FRACTION[s.controller]
        asked = f"{low:g} to {high:g}" if low > 0 else f"at most {high:g}"
        text = (
            f"Session {s.session_id} (visit {s.visit}, place {s.ordinal}) is a {CONTROLLER_NAMES[s.controller]} session, but its mean "
            f"amplitude fraction is {mean:.2f}; {asked} is expected. It counts until its controller or the cDBS amplitude is corrected."
        )
        found.append(AmplitudeMismatch(s.session_id, s.visit, s.ordinal, s.controller, mean, text))
    return found


def _metric(
    name: str,
    sessions: Sequence[Facts],
    present: Sequence[Controller],
    kind: BetaKind | None,
    names: Mapping[int, str],
    everything: Sequence[Facts],
) -> MetricResult:
    title, unit = primary_words.TITLES[name]
    used, notes = [s for s in sessions if name in s.values], []
    lacking = sum(name not in s.values for s in everything)
    if lacking:
        notes.append(f"{_sessions(lacking)} without this metric.")
    if name == "mean_beta" and kind is not None:
        notes += _beta_notes([s for s in everything if name in s.values], used, kind)
        unit = kind.unit
    groups = [group(c, {s.session_id: s.values[name] for s in used if s.controller is c}) for c in present]
    cdbs = next((g for g in groups if g.controller is Controller.CDBS), group(Controller.CDBS, {}))
    comparisons = [compare(g, cdbs) for g in groups if g.controller is not Controller.CDBS]
    return MetricResult(name, title, unit, groups, comparisons, _by_policy(name, used, names, cdbs), notes)


def _by_policy(name: str, sessions: Sequence[Facts], names: Mapping[int, str], cdbs: Group) -> list[PolicyResult]:
    found = []
    driven = sorted({(s.controller.value, s.arm.policy_id) for s in sessions if s.arm.policy_id is not None})
    for controller, policy_id in driven:
        mine = {s.session_id: s.values[name] for s in sessions if s.arm.policy_id == policy_id and s.controller == controller}
        of_policy = replace(group(Controller(controller), mine), label=names.get(policy_id, f"policy {policy_id}"))
        found.append(PolicyResult(policy_id, of_policy, compare(of_policy, cdbs)))
    return found


def _beta_notes(measured: Sequence[Facts], comparable: Sequence[Facts], kind: BetaKind) -> list[str]:
    notes = []
    if len(comparable) < len(measured):
        others = sorted({f"{s.beta_kind.unit} ({s.beta_kind.source})" for s in measured if s.beta_kind and s.beta_kind != kind})
        left_out = _sessions(len(measured) - len(comparable))
        notes.append(f"{left_out} in {', '.join(others)} left out: only beta in {kind.unit} ({kind.source}) is compared.")
    if len({s.hemisphere for s in comparable if s.hemisphere}) > 1:
        notes.append("Both hemispheres are taken together.")
    return notes


def _adjusted(metrics: Sequence[MetricResult]) -> list[MetricResult]:
    adjusted = iter(adjust([c for m in metrics for c in m.comparisons]))
    return [replace(m, comparisons=[next(adjusted) for _ in m.comparisons]) for m in metrics]


def _summary(controller: Controller, sessions: Sequence[Facts], energy: MetricResult) -> ControllerSummary:
    means = {g.controller: float(np.mean(g.values)) for g in energy.groups if g.n}
    saving, reference = None, means.get(Controller.CDBS, 0.0)
    if controller is not Controller.CDBS and controller in means and reference > 0:
        saving = saving_percent(means[controller], reference)
    seconds = sum(s.duration_s for s in sessions)
    of_these = tuple(s.session_id for s in sessions)
    return ControllerSummary(controller, CONTROLLER_NAMES[controller], len(sessions), seconds / 60, saving, of_these)


def _sessions(count: int) -> str:
    return counted(count, "session")
