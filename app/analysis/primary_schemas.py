"""API types of the primary analyses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime

from fastapi import Response
from pydantic import Field

from app.analysis import primary_words
from app.analysis.figures import csv_of
from app.analysis.primary import PolicyVerdict, Primary
from app.analysis.primary_results import LEVEL, Comparison, ControllerResult
from app.analysis.primary_verdict import LockedMargins, VerdictResult
from app.platform.web.csv_files import download
from app.platform.web.schemas import Model
from app.study.outcome_fields import VersionOfMargins
from app.tables.sessions import Controller
from ml.outcomes import BY_KEY
from ml.statistics.effects import Saving
from ml.statistics.noninferiority import Inconclusive, Inferior, NonInferiorAndSaving
from ml.statistics.ranksum import RankSum
from ml.statistics.within_visits.contrasts import Average, Unavailable
from ml.statistics.within_visits.stratified import StratifiedTest


class AverageOut(Model):
    """An average contrast to cDBS over visits; without visits to estimate it, `reason` says why."""

    estimate: float | None
    low: float | None
    high: float | None
    p_value: float | None = Field(description="Two-sided, unadjusted.")
    visits: int
    adjustment: str | None = Field(description="What the contrast is freed from.")
    reason: str | None = Field(description="Code of why there is no number.")
    text: str = Field(description="The same in words; empty where there is a number.")


class VisitRowOut(Model):
    """One visit of a comparison."""

    visit: int
    contrast: float | None = Field(description="Mean of the controller's sessions less that of cDBS; null without both arms.")
    session_ids: list[int]
    cdbs_session_ids: list[int]


class SensitivityOut(Model):
    """An alternative analysis."""

    adjustment: str
    result: AverageOut


class PrimaryComparisonOut(Model):
    """One metric of a controller against the same visit's cDBS."""

    metric: str
    title: str
    unit: str
    primary: AverageOut
    p_adjusted: float | None = Field(description="Holm within the planned family, Benjamini-Hochberg in exploration.")
    cliffs_delta: AverageOut
    energy_saving_percent: AverageOut | None
    van_elteren_p: float | None
    paper_p: float | None = Field(description="The paper's rank-sum test of all sessions, whatever their visit.")
    disagreement: str | None = Field(description="paper_only, primary_only or no_primary.")
    order_imbalance: float | None = Field(description="How much later the controller came, in SDs of the place in the visit.")
    sensitivity: list[SensitivityOut]
    by_visit: list[VisitRowOut]


class TestedOut(Model):
    """A controller or policy with its comparisons."""

    controller: Controller
    policy_id: int | None
    name: str
    role: str = Field(description="planned or exploration.")
    basis: str = Field(description="all, confirmation or selection: which sessions of a policy count.")
    session_ids: list[int]
    selection_session_ids: list[int] = Field(description="Sessions that may have picked the policy, and do not count.")
    comparisons: list[PrimaryComparisonOut]


class OutcomeVerdictOut(Model):
    """Non-inferiority of one outcome; contrasts are turned so that higher is better."""

    outcome: str
    margin: float
    scale: str = Field(
        description="difference: of the visits' means. ordinal: share of pairs that the controller's values win once the margin is added."
    )
    excluded: float = Field(description="What `estimate` must be shown to exceed.")
    estimate: float | None
    low: float | None
    high: float | None
    p_non_inferior: float | None
    failures: int
    missing: int
    text: str


class MarginsLockedOut(VersionOfMargins):
    """The margins that a verdict goes by."""

    locked_at: datetime | None
    locked_by: str | None
    superseded_at: datetime | None = Field(description="When a newer lock followed.")


class VerdictOut(Model):
    """The verdict on one controller."""

    controller: Controller
    policy_id: int | None = Field(description="Null for all policies of the controller.")
    declared_at: datetime | None = Field(description="When the confirmation of the policy was declared; null where it was not.")
    confirmatory: bool
    verdict: str = Field(description="non_inferior_and_saving, inferior, inconclusive or not_available.")
    sentence: str
    basis: str
    margins: MarginsLockedOut
    visits: list[int]
    more_visits: int | None
    outcomes: list[OutcomeVerdictOut]
    energy_saving_percent: AverageOut | None
    stopped_session_ids: list[int]
    policy_shares: list[float] = Field(description="Of decisions by the policy, in the sessions with a log.")
    late_stop_session_ids: list[int] = Field(description="Stopped too, but known only after the lock of the visit: counted as measured.")


class StandingOut(Model):
    """Standing of a policy, in the words of every page."""

    policy_id: int
    sentence: str


class PrimaryOut(Model):
    """Controllers and policies against the same visit's cDBS."""

    participant: str
    synthetic: bool = Field(description="A simulation and no person: no verdict is evidence of a patient.")
    level: float
    family: str
    margins: MarginsLockedOut
    verdicts: list[VerdictOut]
    policy_verdicts: list[VerdictOut] = Field(
        description="Of each policy by itself: the confirmatory one where its confirmation was declared, then the exploratory one."
    )
    earlier_verdicts: list[VerdictOut] = Field(
        description="Under locks that a newer one followed, oldest first: of the visits that began between the two."
    )
    results: list[TestedOut]
    standings: list[StandingOut] = Field(description="Of each policy: its harms, its own sessions, its prediction.")


# Primary results as API types and as rows of a table.

CSV_COLUMNS = (
    "participant", "controller", "policy_id", "name", "role", "basis", "metric", "unit", "estimate", "low", "high", "level", "p",
    "p_adjusted", "cliffs_delta", "cliffs_delta_low", "cliffs_delta_high", "van_elteren_p", "paper_p", "visits", "sessions",
    "cdbs_sessions", "adjustment", "not_available",
)  # fmt: skip
VERDICT_NAMES = {NonInferiorAndSaving: "non_inferior_and_saving", Inferior: "inferior", Inconclusive: "inconclusive"}


def primary_out(found: Primary, synthetic: bool, policies: Sequence[PolicyVerdict], standings: Mapping[int, str]) -> PrimaryOut:
    """Convert the results of one participant; `standings` has a sentence by policy."""
    return PrimaryOut(
        participant=found.evidence.participant,
        synthetic=synthetic,
        level=LEVEL,
        family=primary_words.FAMILY,
        margins=margins_out(found.locked),
        verdicts=[verdict_out(v) for v in found.verdicts],
        policy_verdicts=[verdict_out(v.result, v.policy_id, v.name) for v in policies],
        earlier_verdicts=[verdict_out(v) for v in found.earlier],
        results=[_tested(r, found) for r in found.results],
        standings=[StandingOut(policy_id=i, sentence=text) for i, text in standings.items()],
    )


def margins_out(locked: LockedMargins) -> MarginsLockedOut:
    """Convert margins with their lock."""
    return MarginsLockedOut(
        version=locked.version,
        **asdict(locked.margins),
        locked_at=locked.locked_at,
        locked_by=locked.locked_by,
        superseded_at=locked.until,
    )


def average_out(found: Average | Unavailable) -> AverageOut:
    """Convert an average over visits, or the reason why there is none."""
    if isinstance(found, Unavailable):
        return AverageOut(
            estimate=None,
            low=None,
            high=None,
            p_value=None,
            visits=0,
            adjustment=None,
            reason=found.reason,
            text=primary_words.unavailable(found),
        )
    return AverageOut(
        estimate=found.estimate,
        low=found.low,
        high=found.high,
        p_value=found.p_value,
        visits=found.visits,
        adjustment=found.adjustment,
        reason=None,
        text="",
    )


def saving_out(found: Saving | Unavailable) -> AverageOut:
    """Convert an energy saving, per cent, or the reason why there is none."""
    if isinstance(found, Unavailable):
        return average_out(found)
    return AverageOut(
        estimate=found.percent,
        low=found.low,
        high=found.high,
        p_value=found.p_value,
        visits=len(found.visits),
        adjustment="none",
        reason=None,
        text="",
    )


def verdict_out(result: VerdictResult, policy_id: int | None = None, name: str = "") -> VerdictOut:
    """Convert a verdict; `name` and `policy_id` where it is on one policy."""
    a = result.assessment
    outcomes = []
    for o in a.outcomes if a else ():
        average = o.average if isinstance(o.average, Average) else None
        outcomes.append(
            OutcomeVerdictOut(
                outcome=o.name,
                margin=o.margin,
                scale=BY_KEY[o.name].scale,
                excluded=o.loss,
                estimate=average and average.estimate,
                low=average and average.low,
                high=average and average.high,
                p_non_inferior=o.p_non_inferior,
                failures=o.failures,
                missing=o.missing,
                text="" if average else primary_words.unavailable(o.average) if isinstance(o.average, Unavailable) else "",
            )
        )
    return VerdictOut(
        controller=result.controller,
        policy_id=policy_id,
        declared_at=result.locked.declared_at,
        confirmatory=result.confirmatory,
        verdict=VERDICT_NAMES[type(a.verdict)] if a else "not_available",
        sentence=primary_words.verdict(result, name),
        basis=primary_words.verdict_kind(result),
        margins=margins_out(result.locked),
        visits=list(result.visits),
        policy_shares=list(result.policy_shares),
        more_visits=a.verdict.more_visits if a and isinstance(a.verdict, Inconclusive) else None,
        outcomes=outcomes,
        energy_saving_percent=saving_out(a.saving) if a else None,
        stopped_session_ids=list(result.stopped),
        late_stop_session_ids=list(result.late_stops),
    )


def csv_rows(found: Primary) -> list[tuple[object, ...]]:
    """List one row per controller or policy and metric, in the order of CSV_COLUMNS."""
    rows: list[tuple[object, ...]] = []
    for r in found.results:
        for c in r.comparisons:
            out = _comparison(c, found)
            p, d = out.primary, out.cliffs_delta
            both = [row for row in out.by_visit if row.contrast is not None]
            counts = [sum(len(v.session_ids) for v in both), sum(len(v.cdbs_session_ids) for v in both)]
            t = r.tested
            named = (found.evidence.participant, t.controller.value, t.policy_id, primary_words.tested_name(t), t.role.value, t.basis.value)
            average = (c.metric, out.unit, p.estimate, p.low, p.high, LEVEL, p.p_value, out.p_adjusted)
            others = (d.estimate, d.low, d.high, out.van_elteren_p, out.paper_p, p.visits, *counts, p.adjustment, p.reason)
            rows.append((*named, *average, *others))
    return rows


def unit_of(metric: str, found: Primary) -> str:
    """Return the unit of a metric; that of beta is the one that is compared."""
    return primary_words.TITLES[metric][1] or (found.beta_kind.unit if found.beta_kind else "")


def _tested(r: ControllerResult, found: Primary) -> TestedOut:
    t = r.tested
    return TestedOut(
        controller=t.controller,
        policy_id=t.policy_id,
        name=primary_words.tested_name(t),
        role=t.role,
        basis=t.basis,
        session_ids=list(t.sessions),
        selection_session_ids=list(t.selection_sessions),
        comparisons=[_comparison(c, found) for c in r.comparisons],
    )


def _comparison(c: Comparison, found: Primary) -> PrimaryComparisonOut:
    return PrimaryComparisonOut(
        metric=c.metric,
        title=primary_words.TITLES[c.metric][0],
        unit=unit_of(c.metric, found),
        primary=average_out(c.result),
        p_adjusted=c.p_adjusted,
        cliffs_delta=average_out(c.delta),
        energy_saving_percent=None if c.saving is None else saving_out(c.saving),
        van_elteren_p=c.exact.p_value if isinstance(c.exact, StratifiedTest) else None,
        paper_p=c.paper.p_value if isinstance(c.paper, RankSum) else None,
        disagreement=c.disagreement,
        order_imbalance=c.imbalance,
        sensitivity=[SensitivityOut(adjustment=s.adjustment, result=average_out(s.result)) for s in c.sensitivity],
        by_visit=[
            VisitRowOut(visit=v.visit, contrast=v.contrast, session_ids=list(v.tested), cdbs_session_ids=list(v.cdbs)) for v in c.rows
        ],
    )


# Primary results as a table for other programs.

_POLICY = CSV_COLUMNS.index("policy_id")


def primary_csv(found: Primary, standings: Mapping[int, str]) -> Response:
    """Write one row per controller or policy and metric; `standings` has a sentence by policy."""
    rows = [(*row, standings.get(row[_POLICY])) for row in csv_rows(found)]  # type: ignore[call-overload]
    return download(csv_of((*CSV_COLUMNS, "standing"), rows), f"{found.evidence.participant}-primary.csv")
