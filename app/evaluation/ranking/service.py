"""The ranking: newest evaluation, candidates from best to worst, references besides them, and whether it still fits the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation import repository, wording
from app.evaluation.estimates.coverage import coverage_failed
from app.evaluation.ranking import verdict_wording
from app.evaluation.ranking.assessment import Assessed, Assessment
from app.evaluation.ranking.judged import Judged, judged
from app.evaluation.ranking.staleness import stale_reasons
from app.evaluation.schemas import CoverageOut, EstimateOut, FlagOut, GainOut, RankedPolicy, RankedSnapshot, RankingFilter, RankingOut
from app.evaluation.wording import estimate_out, flag_out, reason_out
from app.platform.errors import NotFound
from app.study import access
from app.study import repository as study_repository
from app.study.sessions.repository import ReadOnce
from app.tables.learning import BufferSnapshot
from app.tables.participants import Participant
from ml.ope import Estimate, Flag, distinct, gain_over, method_keys


def current_ranking(
    db: Session, participant: Participant, caller: Caller, method: str | None = None, shown: RankingFilter | None = None
) -> RankingOut:
    """Return the ranking of the participant's newest evaluation: one snapshot, one settings version, never a mixture.

    Args:
        db: the session. participant: whose.
        caller: decides what may be shown of sessions.
        method: whose estimates rank; the evaluation's default where not given. Verdicts are the posterior's all the same.
        shown: which candidates to give; all where not given.

    Raises:
        NotFound: nothing was evaluated yet. Invalid: the method is not in this evaluation.
    """
    return ranking_of(current(db, participant, caller, method), shown)


def current(db: Session, participant: Participant, caller: Caller, method: str | None = None) -> Judged:
    """Judge the newest evaluation by the margins in force now, with its policies' results in sessions. Raises as `current_ranking`."""
    access.require(caller, can.READ, participant)
    evaluation = repository.newest_evaluation(db, participant.id)
    if evaluation is None:
        raise NotFound(
            f"Participant {participant.code} has no ranking yet.", "Start a job of kind 'pipeline', or 'evaluate' where there are policies."
        )
    return judged(db, participant, evaluation, method, caller, ReadOnce(db, participant.id))


def ranking_of(found: Judged, shown: RankingFilter | None = None) -> RankingOut:
    """Convert a judged evaluation for the interface.

    Args:
        found: the evaluation. shown: which candidates to give; all where not given.
    """
    db, evaluation, participant = found.db, found.evaluation, found.participant
    ranked = _kept(found)
    reasons = [wording.sentence(reason) for reason in stale_reasons(db, participant, evaluation, found.sessions)]
    return RankingOut(
        participant=participant.code,
        evaluation_id=evaluation.id,
        job_id=evaluation.job_id,
        first_answer=evaluation.first_answer,
        created_at=evaluation.created_at,
        default_method=found.method,
        methods=ranked.methods,
        failed_methods=evaluation.diagnostics.get("failed", {}),
        horizon_steps=evaluation.horizon_steps,
        gamma=evaluation.gamma,
        snapshot=_snapshot_out(db, db.get_one(BufferSnapshot, evaluation.snapshot_id)),
        stale=bool(reasons),
        stale_reasons=reasons,
        stale_reason="; ".join(reasons) or None,
        notes=ranked.notes,
        policies=[p for p in ranked.candidates if _passes(p, shown)],
        references=ranked.references,
        coverage_failed=coverage_failed(evaluation),
        choice=None,
        hidden=sum(not _passes(p, shown) for p in ranked.candidates),
    )


def evaluation_notes(found: Judged) -> list[str]:
    """Return the notes of an evaluation's ranking by its own method, whether or not it is the newest."""
    return _kept(found).notes


@dataclass(frozen=True)
class _Ranked:
    """Policies of an evaluation for the interface; cached, and so never changed."""

    candidates: list[RankedPolicy]
    references: list[RankedPolicy]
    methods: list[str]
    notes: list[str]


def _kept(found: Judged) -> _Ranked:
    return found.kept("ranked", lambda: _read(found.with_draws))


def _read(found: Assessment) -> _Ranked:
    candidates, references = [_ranked(found, a) for a in found.candidates], [_ranked(found, a) for a in found.references]
    methods = [m for m in method_keys() if any(m in a.estimates for a in found.assessed)]
    return _Ranked(candidates, references, methods, [wording.sentence(n) for n in ranking_notes(candidates, references, found.method)])


def _passes(policy: RankedPolicy, shown: RankingFilter | None) -> bool:
    """Check whether a candidate passes the filter."""
    if shown is None:
        return True
    tested = "yes" if policy.tested else "no"
    return (policy.supported or not shown.supported) and shown.kind in (None, policy.kind) and shown.tested in (None, tested)


def _ranked(found: Assessment, one: Assessed) -> RankedPolicy:
    policy, chosen, cdbs, decided = one.policy, one.estimate, found.cdbs_estimates.get(found.method), one.decided
    gain = gain_over(chosen, cdbs) if chosen and cdbs and policy.id != found.cdbs_id else None
    return RankedPolicy(
        policy_id=policy.id,
        name=policy.name,
        kind=policy.kind,
        algorithm=policy.algorithm,
        teacher_id=policy.teacher_id,
        rank=one.rank,
        reference=one.reference,
        supported=chosen.supported if chosen else False,
        probability_best=one.probability_best,
        retired=policy.retired_reason is not None,
        estimates={m: estimate_out(one.estimates[m], EstimateOut) for m in method_keys() if m in one.estimates},
        predicted=chosen.predicted if chosen else {},
        flags=_flags(chosen, one.coverage, one.reference is not None),
        coverage=one.coverage,
        tested=one.tested,
        gain=GainOut.model_validate(gain) if gain else None,
        decision=decided.decision if decided else None,
        decision_reasons=[reason_out(r) for r in decided.reasons] if decided else [],
        decision_reason=verdict_wording.decision(decided.reasons) if decided else "",
    )


def _flags(estimate: Estimate | None, coverage: CoverageOut | None, is_reference: bool) -> list[FlagOut]:
    """List the flags of a policy. A reference with one amplitude gets no warning for that: it is its purpose."""
    own = distinct(estimate.flags) if estimate else ()
    shown = [flag_out(f) for f in own if not (is_reference and f.code == "no_closed_loop")]
    return shown + [note for note in (coverage.notes if coverage else ()) if note not in shown]


def _snapshot_out(db: Session, row: BufferSnapshot) -> RankedSnapshot:
    return RankedSnapshot(
        id=row.id,
        created_at=row.created_at,
        sessions=row.sessions,
        steps=row.steps,
        beta_unit=row.beta_unit,
        beta_source=row.beta_source,
        settings_version=study_repository.settings_version(db, row.settings_version_id).version,
    )


def ranking_notes(policies: Sequence[RankedPolicy], references: Sequence[RankedPolicy], method: str) -> list[Flag]:
    """Collect the notes above a ranking.

    Args:
        policies: candidates; retired ones, and those without an estimate by the method, say nothing here.
        references: policies besides them, cDBS among them or not.
        method: whose estimates rank.
    """
    present = [(p, p.estimates[method]) for p in policies if method in p.estimates and not p.retired]
    supported = [(p, e) for p, e in present if p.supported]
    others = [(p, e) for p, e in present if not p.supported]
    notes = []
    if present and not supported:
        notes.append(Flag("none_supported"))
    cdbs = next((p.estimates[method] for p in references if p.reference == "cdbs" and method in p.estimates), None)
    if cdbs and supported:
        notes += _against_cdbs(cdbs, supported, all(e.value < cdbs.value for _, e in others))
    lowest = min((e.value for _, e in supported), default=float("inf"))
    passed = tuple(f"{p.name} ({e.value:.1f})" for p, e in others if e.value > lowest)
    if passed:
        notes.append(Flag.of("placed_below", policies=passed))
    return notes


def _against_cdbs(cdbs: EstimateOut, supported: Sequence[tuple[RankedPolicy, EstimateOut]], above_all: bool) -> list[Flag]:
    """Compare the best supported candidate with cDBS; empty where its whole interval is above that of cDBS."""
    best, e = max(supported, key=lambda pair: pair[1].value)
    overlap = e.low <= cdbs.high and cdbs.low <= e.high
    if cdbs.value >= e.value:
        known = cdbs.supported
        return [Flag.of("cdbs_above", e.value, cdbs.value, "reward", best=best.name, supported=known, overlap=overlap, above_all=above_all)]
    if overlap:
        return [Flag.of("cdbs_overlaps", e.value, cdbs.value, "reward", best=best.name, supported=cdbs.supported)]
    return []
