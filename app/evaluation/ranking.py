"""The ranking: newest evaluation, candidates from best to worst, references beside them, and whether it still fits the data."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Mapping, Sequence

from sqlalchemy.orm import Session

from app.accounts import policy as can
from app.accounts.policy import Caller
from app.evaluation import repository
from app.evaluation.actual import Actual, actual, mean_of
from app.evaluation.estimates import estimate_of
from app.evaluation.models import Evaluation
from app.evaluation.notes import ranking_notes
from app.evaluation.schemas import METHODS, EstimateOut, RankedPolicy, RankedSnapshot, RankingOut, TestedBefore
from app.learning import repository as learning
from app.learning.models import BufferSnapshot, Policy, SnapshotSession
from app.learning.snapshots import Collection, Member, collect
from app.platform.errors import Invalid, NotFound
from app.study import blinding
from app.study import repository as study_repository
from app.study import service as study
from app.study.models import Participant
from ml.ope.coverage import NO_CLOSED_LOOP
from ml.ope.estimate import Estimate
from ml.ope.ranking import rank_policies

Table = dict[int, dict[str, Estimate]]


def current_ranking(db: Session, participant: Participant, caller: Caller, method: str | None = None) -> RankingOut:
    """The ranking of the participant's newest evaluation: one snapshot, one settings version, never a mixture.

    Args:
        db: the session. participant: whose.
        caller: decides what may be said about sessions.
        method: whose estimates rank; the evaluation's default where not given.

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
    methods = [m for m in METHODS if any(m in by_method for by_method in table.values())]
    chosen = method or evaluation.default_method
    if chosen not in methods:
        raise Invalid(f"This ranking has no estimates by '{chosen}'.", f"Choose one of {', '.join(methods)}.")
    try:
        present: Collection | None = collect(db, participant)
        trouble = None
    except Invalid as error:
        present, trouble = None, str(error)
    policies = repository.policies_by_id(db, list(table))
    tested = _tested(db, evaluation, present, caller)
    rows = _rows(evaluation, table, policies, chosen, tested)
    candidates, references = [r for r in rows if r.reference is None], [r for r in rows if r.reference is not None]
    reasons = [trouble] if trouble else []
    reasons += _staleness(db, participant, evaluation, present)
    return RankingOut(
        participant=participant.code,
        evaluation_id=evaluation.id,
        created_at=evaluation.created_at,
        default_method=chosen,
        methods=methods,
        failed_methods=evaluation.diagnostics.get("failed", {}),
        horizon_steps=evaluation.horizon_steps,
        gamma=evaluation.gamma,
        snapshot=_snapshot_out(db, evaluation.snapshot_id),
        stale=bool(reasons),
        stale_reasons=reasons,
        stale_reason="; ".join(reasons) or None,
        notes=ranking_notes(candidates, references, chosen),
        policies=candidates,
        references=references,
    )


def evaluation_notes(db: Session, evaluation: Evaluation) -> list[str]:
    """The notes of an evaluation's ranking by its own method, whether or not it is the newest."""
    table = _table(evaluation)
    rows = _rows(evaluation, table, repository.policies_by_id(db, list(table)), evaluation.default_method, {})
    candidates, references = [r for r in rows if r.reference is None], [r for r in rows if r.reference is not None]
    return ranking_notes(candidates, references, evaluation.default_method)


_PREDICTED = ("energy", "mean_amplitude", "mean_beta", "grasp_hz", "rating", "tremor_percent")
_NUMBERS = ("value", "low", "high", "level", "standard_error", "step_return", "end_reward")
_OF_RANKING = ("participant", "evaluation_id", "default_method", "horizon_steps", "gamma", "stale")
_OF_POLICY = ("rank", "policy_id", "name", "kind", "reference", "probability_best", "supported")


def to_csv(ranking: RankingOut) -> str:
    """The ranking as CSV: one row per policy and method; rank and probability of being best are by the default method."""
    sink = io.StringIO()
    out = csv.writer(sink, lineterminator="\n")
    tested = ("tested_sessions", "tested_mean_return")
    out.writerow([*_OF_RANKING, "snapshot_id", *_OF_POLICY, "method", *_NUMBERS, *_PREDICTED, "flags", *tested])
    for p in (*ranking.policies, *ranking.references):
        whole = [getattr(ranking, n) for n in _OF_RANKING] + [ranking.snapshot.id]
        of_policy = [_safe(getattr(p, n)) for n in _OF_POLICY]
        results = [p.tested.sessions, p.tested.mean_return] if p.tested else [0, None]
        for method, e in p.estimates.items():
            numbers = [getattr(e, n) for n in _NUMBERS] + [e.predicted.get(n) for n in _PREDICTED]
            out.writerow([*whole, *of_policy, method, *numbers, "; ".join(e.flags), *results])
    return sink.getvalue()


def _safe(value: object) -> object:
    """A cell that spreadsheets do not run as a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in set("=+-@\t\r") else value


def _table(evaluation: Evaluation) -> Table:
    table: Table = defaultdict(dict)
    for row in evaluation.estimates:
        table[row.policy_id][row.method] = estimate_of(row)
    return table


def _rows(
    evaluation: Evaluation, table: Table, policies: Mapping[int, Policy], method: str, tested: Mapping[int, TestedBefore]
) -> list[RankedPolicy]:
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
    rows = []
    for i in order:
        policy, place, chosen = policies[i], places.get(i), by_method.get(i)
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
                estimates={m: _estimate_out(table[i][m]) for m in METHODS if m in table[i]},
                predicted=chosen.predicted if chosen else {},
                flags=_flags(chosen, i in references),
                tested=tested.get(i),
            )
        )
    return rows


def _flags(estimate: Estimate | None, is_reference: bool) -> list[str]:
    """What to know of a policy. That a reference holds one amplitude is its purpose and no warning."""
    if estimate is None:
        return []
    return [f for f in estimate.flags if not (is_reference and f.startswith(NO_CLOSED_LOOP))]


def _reference(policy: Policy) -> str:
    if policy.algorithm != "constant":
        return policy.algorithm
    return "cdbs" if policy.config.get("amplitude") == 1.0 else "constant"


def _estimate_out(e: Estimate) -> EstimateOut:
    return EstimateOut(
        value=e.value,
        low=e.low,
        high=e.high,
        level=e.level,
        standard_error=e.standard_error,
        step_return=e.step_return,
        end_reward=e.end_reward,
        supported=e.supported,
        flags=list(e.flags),
        predicted=e.predicted,
        n=e.n,
    )


def _snapshot_out(db: Session, snapshot_id: int) -> RankedSnapshot:
    row = db.get_one(BufferSnapshot, snapshot_id)
    return RankedSnapshot(
        id=row.id,
        created_at=row.created_at,
        sessions=row.sessions,
        steps=row.steps,
        beta_unit=row.beta_unit,
        beta_source=row.beta_source,
        settings_version=study_repository.settings_version(db, row.settings_version_id).version,
    )


def _tested(db: Session, evaluation: Evaluation, present: Collection | None, caller: Caller) -> dict[int, TestedBefore]:
    """Actual results by policy, under the evaluation's settings, horizon and discount."""
    if present is None:
        return {}
    settings = study.mdp_settings(study_repository.settings_version(db, evaluation.settings_version_id))
    results: dict[int, list[Actual]] = defaultdict(list)
    for member in present.members:
        policy_id = blinding.arm(member.session, caller).policy_id
        if policy_id is not None and member.trajectory is not None:
            results[policy_id].append(actual(member.trajectory, settings, evaluation.horizon_steps))
    return {
        policy_id: TestedBefore(
            sessions=len(found),
            sessions_with_return=sum(a.value is not None for a in found),
            mean_return=mean_of([a.value for a in found]),
            mean_step_return=mean_of([a.step_return for a in found]),
            mean_end_reward=mean_of([a.end_reward for a in found]),
            energy=mean_of([a.energy for a in found]),
        )
        for policy_id, found in results.items()
    }


def _staleness(db: Session, participant: Participant, evaluation: Evaluation, present: Collection | None) -> list[str]:
    """Why the ranking no longer speaks about the study as it is, in words; empty when it does."""
    reasons = []
    snapshot = learning.snapshot_members(db, evaluation.snapshot_id)
    if evaluation.settings_version_id != participant.current_settings.id:
        old = study_repository.settings_version(db, evaluation.settings_version_id).version
        reasons.append(f"settings version {participant.current_settings.version} is in force; this ranking used version {old}")
    row = db.get_one(BufferSnapshot, evaluation.snapshot_id)
    if present is not None and present.pins_sha256 != row.pins_sha256:
        changes = _changes(snapshot, present.members)
        if changes or not reasons:
            reasons += changes or ["the data of its sessions have changed since"]
    ranked = set(evaluation.diagnostics.get("candidates", []))
    missing = [p.name for p in learning.candidates(db, participant.id) if p.id not in ranked]
    if missing:
        listed = ", ".join(missing[:5]) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        reasons.append(f"{_count(len(missing), 'policy', 'policies')} not in it: {listed}")
    return reasons


def _changes(old: Sequence[SnapshotSession], new: Sequence[Member]) -> list[str]:
    """What happened to the sessions since a snapshot."""
    before = {m.session_id: m for m in old}
    inside = {m.session.id: m for m in new}
    both = [(before[i], inside[i]) for i in before.keys() & inside.keys()]
    added = [m for i, m in inside.items() if i not in before]
    found = {
        f"newer: {_visits(added)}": len(added),
        "no longer confirmed": len(before.keys() - inside.keys()),
        "with corrected QoCs": sum((n.session.qoc.id if n.session.qoc else None) != o.qoc_id for o, n in both),
        "newly left out": sum(n.left_out is not None and o.left_out_reason is None for o, n in both),
        "newly included": sum(n.left_out is None and o.left_out_reason is not None for o, n in both),
        "decoded anew": sum((n.table.beta_trace.id if n.table and n.table.beta_trace else None) != o.beta_trace_id for o, n in both),
        "with another cDBS amplitude": sum((n.table.cdbs_ma if n.table else None) != o.cdbs_amplitude_ma for o, n in both),
    }
    return [f"{_count(n, 'session', 'sessions')} {what}" for what, n in found.items() if n]


def _visits(members: Sequence[Member]) -> str:
    return "visit " + ", ".join(str(n) for n in sorted({m.session.visit.number for m in members}))


def _count(n: int, one: str, many: str) -> str:
    return f"{n} {one if n == 1 else many}"
