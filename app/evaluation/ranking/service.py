"""The ranking: newest evaluation, candidates from best to worst, references beside them, and whether it still fits the data."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation import repository, wording
from app.evaluation.decision import Decided, decide, gain_over
from app.evaluation.estimates.choice import stored_reasons
from app.evaluation.estimates.coverage import coverage_by_policy, coverage_failed
from app.evaluation.estimates.rows import estimate_of
from app.evaluation.models import Evaluation
from app.evaluation.ranking.notes import ranking_notes
from app.evaluation.ranking.results import driven_sessions, results_by_policy
from app.evaluation.ranking.staleness import stale_reasons
from app.evaluation.schemas import (
    ChoiceOut,
    CoverageOut,
    EstimateOut,
    FlagOut,
    GainOut,
    RankedPolicy,
    RankedSnapshot,
    RankingFilter,
    RankingOut,
    TestedBefore,
)
from app.evaluation.shown import estimate_out, flag_out, reason_out
from app.learning.models import BufferSnapshot, Policy
from app.platform.errors import Invalid, NotFound
from app.study import repository as study_repository
from app.study import service as study
from app.study.models import Participant
from app.study.threshold import mdp_settings
from ml.ope.compare.ranking import rank_policies
from ml.ope.estimate import Estimate
from ml.ope.flags import TEXT, distinct
from ml.ope.registry import method_keys

Table = dict[int, dict[str, Estimate]]


def current_ranking(
    db: Session, participant: Participant, caller: Caller, method: str | None = None, shown: RankingFilter | None = None
) -> RankingOut:
    """The ranking of the participant's newest evaluation: one snapshot, one settings version, never a mixture.

    Args:
        db: the session. participant: whose.
        caller: decides what may be said about sessions.
        method: whose estimates rank; the evaluation's default where not given.
        shown: which candidates to give; all where not given.

    Raises:
        NotFound: nothing was evaluated yet. Invalid: the method is not in this evaluation.
    """
    study.require(caller, can.READ, participant)
    evaluation = repository.newest_evaluation(db, participant.id)
    if evaluation is None:
        raise NotFound(
            f"Participant {participant.code} has no ranking yet.", "Start a job of kind 'pipeline', or 'evaluate' where there are policies."
        )
    table = _table(evaluation)
    methods = [m for m in method_keys() if any(m in by_method for by_method in table.values())]
    chosen = method or evaluation.default_method
    if chosen not in methods:
        raise Invalid(f"This ranking has no estimates by '{chosen}'.", f"Choose one of {', '.join(methods)}.")
    policies = repository.policies_by_id(db, list(table))
    snapshot = db.get_one(BufferSnapshot, evaluation.snapshot_id)
    settings = mdp_settings(study_repository.settings_version(db, evaluation.settings_version_id))
    cdbs = next((i for i, p in policies.items() if is_cdbs(p)), None)
    tested = results_by_policy(driven_sessions(db, snapshot, caller), settings, evaluation.horizon_steps, cdbs)
    rows = _rows(evaluation, table, policies, chosen, tested)
    candidates, references = [r for r in rows if r.reference is None], [r for r in rows if r.reference is not None]
    reasons = [wording.sentence(reason) for reason in stale_reasons(db, participant, evaluation)]
    return RankingOut(
        participant=participant.code,
        evaluation_id=evaluation.id,
        job_id=evaluation.job_id,
        created_at=evaluation.created_at,
        default_method=chosen,
        methods=methods,
        failed_methods=evaluation.diagnostics.get("failed", {}),
        horizon_steps=evaluation.horizon_steps,
        gamma=evaluation.gamma,
        snapshot=_snapshot_out(db, snapshot),
        stale=bool(reasons),
        stale_reasons=reasons,
        stale_reason="; ".join(reasons) or None,
        notes=[wording.sentence(n) for n in ranking_notes(candidates, references, chosen)],
        policies=[p for p in candidates if _passes(p, shown)],
        references=references,
        coverage_failed=coverage_failed(evaluation),
        choice=_choice_out(evaluation),
        hidden=sum(not _passes(p, shown) for p in candidates),
    )


def _passes(policy: RankedPolicy, shown: RankingFilter | None) -> bool:
    """Whether a candidate is among those asked for."""
    if shown is None:
        return True
    tested = "yes" if policy.tested else "no"
    return (policy.supported or not shown.supported) and shown.kind in (None, policy.kind) and shown.tested in (None, tested)


def evaluation_notes(db: Session, evaluation: Evaluation) -> list[str]:
    """The notes of an evaluation's ranking by its own method, whether or not it is the newest."""
    table = _table(evaluation)
    rows = _rows(evaluation, table, repository.policies_by_id(db, list(table)), evaluation.default_method, {})
    candidates, references = [r for r in rows if r.reference is None], [r for r in rows if r.reference is not None]
    return [wording.sentence(n) for n in ranking_notes(candidates, references, evaluation.default_method)]


def _table(evaluation: Evaluation) -> Table:
    table: Table = defaultdict(dict)
    for row in evaluation.estimates:
        table[row.policy_id][row.method] = estimate_of(row)
    return table


def _rows(
    evaluation: Evaluation, table: Table, policies: Mapping[int, Policy], method: str, tested: Mapping[int, TestedBefore]
) -> list[RankedPolicy]:
    coverage, unchecked = coverage_by_policy(evaluation), coverage_failed(evaluation)
    references = {i: _reference(p) for i, p in policies.items() if p.kind == "baseline"}
    by_method = {i: by[method] for i, by in table.items() if method in by}
    constants = {i: by_method[i] for i, r in references.items() if r in ("cdbs", "constant") and i in by_method and by_method[i].supported}
    if constants:
        best = max(constants, key=lambda i: constants[i].value)
        if references[best] == "constant":
            references[best] = "best_constant"
    candidates = {str(i): e for i, e in by_method.items() if i not in references}
    places = {int(r.policy): r for r in rank_policies({method: candidates}, method)} if candidates else {}
    order = sorted(places, key=lambda i: places[i].rank) + sorted(
        references, key=lambda i: -(by_method[i].value if i in by_method else 0.0)
    )
    cdbs = next((table[i] for i, r in references.items() if r == "cdbs"), {})
    rows = []
    for i in order:
        policy, place, chosen = policies[i], places.get(i), by_method.get(i)
        gain = gain_over(chosen, cdbs[method]) if chosen and method in cdbs and table[i] is not cdbs else None
        decided: Decided | None = None
        if i in places:
            decided = decide(table[i], cdbs, method, retired_reason=policy.retired_reason, tested=tested.get(i), unchecked=unchecked)
        rows.append(
            RankedPolicy(
                policy_id=i,
                name=policy.name,
                kind=policy.kind,
                algorithm=policy.algorithm,
                teacher_id=policy.teacher_id,
                rank=place.rank if place else None,
                reference=references.get(i),
                supported=chosen.supported if chosen else False,
                probability_best=place.probability_best if place else None,
                retired=policy.retired_reason is not None,
                estimates={m: estimate_out(table[i][m], EstimateOut) for m in method_keys() if m in table[i]},
                predicted=chosen.predicted if chosen else {},
                flags=_flags(chosen, coverage.get(i), i in references),
                coverage=coverage.get(i),
                tested=tested.get(i),
                gain=GainOut.model_validate(gain) if gain else None,
                decision=decided.decision if decided else None,
                decision_reasons=[reason_out(r) for r in decided.reasons] if decided else [],
                decision_reason=wording.decision(decided.reasons) if decided else "",
            )
        )
    return rows


def _flags(estimate: Estimate | None, coverage: CoverageOut | None, is_reference: bool) -> list[FlagOut]:
    """What to know of a policy. That a reference holds one amplitude is its purpose and no warning."""
    own = distinct(estimate.flags) if estimate else ()
    shown = [flag_out(f) for f in own if not (is_reference and f.code == "no_closed_loop")]
    return shown + [note for note in (coverage.notes if coverage else ()) if note not in shown]


def _reference(policy: Policy) -> str:
    if policy.algorithm != "constant":
        return policy.algorithm
    return "cdbs" if is_cdbs(policy) else "constant"


def is_cdbs(policy: Policy) -> bool:
    """Whether a policy is the reference that holds the cDBS amplitude."""
    return policy.kind == "baseline" and policy.algorithm == "constant" and policy.config.get("amplitude") == 1.0


def _choice_out(evaluation: Evaluation) -> ChoiceOut | None:
    choice = evaluation.diagnostics.get("choice")
    if not choice:
        return None
    reasons = stored_reasons(choice)
    shown = [reason_out(r) for r in reasons if r.code != TEXT]
    return ChoiceOut.model_validate(choice | {"reasons": shown, "reason": wording.choice(reasons)})


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
