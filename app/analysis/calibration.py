"""Calibration: estimates made before a visit against what the visit brought."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.analysis.calibration_accuracy import (
    AccuracyOut,
    CalibrationOut,
    Pair,
    PredictionOut,
    QuantityErrorOut,
    QuantityOut,
    TestedPolicyOut,
    accuracies,
    mean_interval,
)
from app.evaluation import repository
from app.evaluation.estimates.service import estimate_of
from app.evaluation.ranking.assessment import QUANTITIES, Actual, actual
from app.evaluation.ranking.results import DrivenSession, driven_sessions
from app.planning.plans import repository as plans
from app.platform.numbers import counted
from app.study import access, blinding
from app.study import repository as study_repository
from app.study.settings import mdp_settings
from app.tables.evaluations import Evaluation
from app.tables.learning import BufferSnapshot, Policy
from app.tables.participants import Participant
from app.tables.sessions import StudySession
from app.tables.visits import Visit
from ml.mdp import MdpSettings
from ml.ope import LEVEL, Estimate, method_keys
from ml.returns import KNOWN_SHARE

# The calibration: estimates made before a visit against what the visit brought, policy by policy and method by method.
#
# The prediction of a visit is that of its signed plan: the evaluation which that pins; of a visit without one the newest. Nothing peeks:
# only an evaluation counts that was stored before the service knew of any of the visit's sessions. Its own settings version, horizon H
# and discount are applied to the sessions. Sessions longer than H count to H; shorter ones by the mean of the steps that they have
# (`actual.actual`).


@dataclass(frozen=True)
class _Before:
    """An evaluation that can predict, with what is needed to hold it against sessions."""

    evaluation: Evaluation
    settings: MdpSettings
    policies: Mapping[int, Policy]
    estimates: Mapping[int, Mapping[str, Estimate]]
    ran: Sequence[DrivenSession]

    @property
    def cdbs(self) -> int | None:
        """Id of its cDBS reference."""
        return next((i for i, p in self.policies.items() if repository.head_of(p).is_cdbs), None)


def calibration(db: Session, participant: Participant, caller: Caller) -> CalibrationOut:
    """Compare predictions with results, for every policy that ran at a visit after an evaluation of it."""
    access.require(caller, can.READ, participant)
    made = repository.evaluation_times(db, participant.id)
    planned = plans.pinned_evaluations(db, participant.id)
    by_visit: dict[Visit, list[StudySession]] = defaultdict(list)
    for session in study_repository.sessions_of_participant(db, participant.id):
        by_visit[session.visit].append(session)
    loaded: dict[int, _Before] = {}
    policies: list[TestedPolicyOut] = []
    left_out: list[str] = []
    for visit, sessions in by_visit.items():
        if not blinding.unsealed(sessions):
            left_out.append(f"visit {visit.number}: the key of its blinded plan is sealed")
            continue
        known_from = min(s.created_at for s in sessions)
        own = planned.get(visit.id)
        before = own if own is not None and made[own] < known_from else newest_before(made, known_from)
        if before is None:
            if any(blinding.arm(s, caller).policy_id is not None for s in sessions):
                left_out.append(f"visit {visit.number}: no evaluation had been made before its sessions")
            continue
        if before not in loaded:
            loaded[before] = _load(db, participant, before, caller)
        found, missed = _of_visit(loaded[before], visit)
        policies += found
        left_out += missed
    methods = [m for m in method_keys() if any(m == q.method for p in policies for q in p.predictions)]
    unit = next((db.get_one(BufferSnapshot, b.evaluation.snapshot_id).beta_unit for b in loaded.values()), None)
    return CalibrationOut(
        participant=participant.code,
        beta_unit=unit,
        level=LEVEL,
        methods=methods,
        policies=policies,
        metrics=[row for m in methods for row in _metrics(m, policies)],
        quantities=_quantity_errors(methods, policies),
        missing=_missing(made, bool(by_visit), policies),
        left_out=left_out,
    )


def newest_before(made: Mapping[int, datetime], known_from: datetime) -> int | None:
    """Return the newest evaluation that was stored before a moment."""
    earlier = [i for i, at in made.items() if at < known_from]
    return max(earlier, key=lambda i: (made[i], i)) if earlier else None


def _load(db: Session, participant: Participant, evaluation_id: int, caller: Caller) -> _Before:
    evaluation = repository.evaluation(db, participant.id, evaluation_id)
    assert evaluation is not None
    estimates: dict[int, dict[str, Estimate]] = defaultdict(dict)
    for row in evaluation.estimates:
        estimates[row.policy_id][row.method] = estimate_of(row)
    settings = mdp_settings(study_repository.settings_version(db, evaluation.settings_version_id))
    ran = driven_sessions(db, db.get_one(BufferSnapshot, evaluation.snapshot_id), caller)
    return _Before(evaluation, settings, repository.policies_by_id(db, list(estimates)), estimates, ran)


def _of_visit(before: _Before, visit: Visit) -> tuple[list[TestedPolicyOut], list[str]]:
    """Compare every policy of a visit that the evaluation contains; list what of the visit cannot be compared with it."""
    by_policy: dict[int, list[DrivenSession]] = defaultdict(list)
    missed: list[str] = []
    for session in (r for r in before.ran if r.visit == visit.number):
        policy_id = session.policy_id if session.policy_id is not None else before.cdbs
        if policy_id is None or policy_id not in before.estimates:
            what = f"policy {policy_id}" if policy_id is not None else "cDBS"
            missed.append(f"visit {visit.number}, session {session.session_id}: evaluation {before.evaluation.id} had not estimated {what}")
        else:
            by_policy[policy_id].append(session)
    found = [_tested(before, visit, policy_id, ran) for policy_id, ran in by_policy.items()]
    missed += [f"visit {visit.number}, {reason}" for t in found for reason in t.sessions_left_out]
    return [t for t in found if t.predictions], missed


def _tested(before: _Before, visit: Visit, policy_id: int, ran: Sequence[DrivenSession]) -> TestedPolicyOut:
    policy, horizon = before.policies[policy_id], before.evaluation.horizon_steps
    results: list[Actual] = []
    reasons: list[str] = []
    for session in ran:
        if session.trajectory is None:
            reasons.append(f"session {session.session_id}: {session.left_out}")
            continue
        result = actual(session.trajectory, before.settings, horizon)
        results.append(result)
        if result.step_return is None:
            reasons.append(
                f"session {session.session_id}: too few of its first {horizon} steps are known "
                f"(they must hold {100 * KNOWN_SHARE:.0f} % of the discount weight)"
            )
        elif result.end_reward is None:
            reasons.append(f"session {session.session_id}: an outcome that r_end needs was not measured")
    predictions = [_prediction(m, before.estimates[policy_id][m], results) for m in method_keys() if m in before.estimates[policy_id]]
    return TestedPolicyOut(
        visit=visit.number,
        visit_date=visit.date,
        evaluation_id=before.evaluation.id,
        evaluated_at=before.evaluation.created_at,
        policy_id=policy_id,
        name=policy.name,
        kind=policy.kind,
        reference="cdbs" if policy_id == before.cdbs else None,
        horizon_steps=horizon,
        gamma=before.evaluation.gamma,
        sessions=len(ran),
        sessions_left_out=reasons,
        predictions=[p for p in predictions if p is not None],
    )


def _prediction(method: str, estimate: Estimate, results: Sequence[Actual]) -> PredictionOut | None:
    """Compare one method with the sessions; None where no session has the return that the method predicts."""
    whole = estimate.end_reward is not None
    values = [a.value if whole else a.step_return for a in results]
    returns = tuple(v for v in values if v is not None)
    if not returns:
        return None
    interval = mean_interval(returns, estimate.level)
    shown = {name: [a.shown[name] for a in results if name in a.shown] for name in QUANTITIES if name in estimate.predicted}
    return PredictionOut(
        method=method,
        supported=estimate.supported,
        parts="return" if whole else "steps",
        predicted=estimate.value,
        # as stored: an interval of a skewed bootstrap is widened to hold the estimate itself
        low=estimate.low,
        high=estimate.high,
        level=estimate.level,
        actual=float(np.mean(returns)),
        actual_low=interval[0] if interval else None,
        actual_high=interval[1] if interval else None,
        sessions=len(returns),
        session_returns=list(returns),
        quantities=[
            QuantityOut(name=name, predicted=estimate.predicted[name], actual=float(np.mean(seen)), sessions=len(seen))
            for name, seen in shown.items()
            if seen
        ],
    )


def _metrics(method: str, policies: Sequence[TestedPolicyOut]) -> list[AccuracyOut]:
    """Compute the metrics of a method over candidate policies; cDBS, which is never chosen by an estimate, is shown and not counted."""
    pairs = [
        Pair(p.visit, q.predicted, q.low, q.high, tuple(q.session_returns))
        for p in policies
        if p.reference is None
        for q in p.predictions
        if q.method == method
    ]
    return accuracies(method, pairs) if pairs else []


def _quantity_errors(methods: Sequence[str], policies: Sequence[TestedPolicyOut]) -> list[QuantityErrorOut]:
    errors: dict[tuple[str, str], list[float]] = defaultdict(list)
    for p in policies:
        for q in p.predictions if p.reference is None else ():
            for quantity in q.quantities:
                errors[q.method, quantity.name].append(abs(quantity.predicted - quantity.actual))
    return [
        QuantityErrorOut(method=m, name=name, mae=float(np.mean(errors[m, name])), policies=len(errors[m, name]))
        for m in methods
        for name in QUANTITIES
        if (m, name) in errors
    ]


def _missing(made: Mapping[int, datetime], visited: bool, policies: Sequence[TestedPolicyOut]) -> str | None:
    """Name the first check that failed; None where there is something to compare."""
    if any(p.reference is None for p in policies):
        return None
    if not made:
        return "an evaluation of this participant's policies"
    if not visited:
        return "a visit with confirmed sessions"
    return "a session of a ranked policy at a visit whose sessions all arrived after that ranking"


# What a calibration says of predictions, in sentences that name no method: how far off, in which order, what going by them cost.

CHANCE = 0.05
"""Permutation p-value below which an order is called better than chance."""

FEW_PAIRS = 8
"""Pairs of a policy and a visit below which the sentences say that they are few."""


def in_sentences(found: CalibrationOut, method: str) -> list[str]:
    """Describe the method's record over all visits; empty where nothing of it could be compared.

    Args:
        found: the calibration. method: one of its methods.
    """
    overall = next((m for m in found.metrics if m.method == method and m.visit is None), None)
    if overall is None:
        return []
    pairs = [q for p in found.policies if p.reference is None for q in p.predictions if q.method == method]
    visits = len({p.visit for p in found.policies if p.reference is None})
    return [
        _distance(overall, pairs, visits),
        _order(overall),
        *_choice(overall),
        _honesty(overall, found.level),
        *_few(overall),
    ]


def _distance(m: AccuracyOut, pairs: list[PredictionOut], visits: int) -> str:
    shift = float(np.mean([q.predicted - q.actual for q in pairs]))
    side = f"on average {abs(shift):.1f} too {'high' if shift > 0 else 'low'}"
    share = f" ({100 * m.mae_of_range.value:.0f} % of the range of what was seen)" if m.mae_of_range.value is not None else ""
    error = f"{m.mae.value:.1f}" if m.mae.value is not None else "an unknown amount"
    return (
        f"What a session is worth was predicted {error} off in the mean{share}, over {counted(m.policies, 'test')} of a policy at "
        f"{counted(visits, 'visit')}, {side}."
    )


def _order(m: AccuracyOut) -> str:
    rank = m.rank_correlation
    if rank.value is None:
        return f"Whether policies were put in the right order cannot be said: {rank.missing}."
    p = "" if m.rank_p is None else f", p = {m.rank_p:.2f}" if m.rank_p >= 0.01 else ", p < 0.01"
    if m.rank_p is not None and m.rank_p < CHANCE:
        verdict = "Policies were put in the right order better than by chance" if rank.value > 0 else "Policies were put in the wrong order"
    else:
        verdict = "The order of policies cannot be told from chance"
    return f"{verdict} (rank correlation {rank.value:.2f}{p})."


def _choice(m: AccuracyOut) -> list[str]:
    if m.regret.value is None:
        return [f"What going by it cost cannot be said: {m.regret.missing}."]
    if m.regret.value <= 0:
        return ["At every visit the policy put first was worth the most."]
    share = f", {100 * m.regret_of_range.value:.0f} % of the visit's range" if m.regret_of_range.value is not None else ""
    return [f"The policy put first was worth {m.regret.value:.1f} less than the best of its visit{share}, averaged over the visits."]


def _honesty(m: AccuracyOut, level: float) -> str:
    held = round((m.coverage.value or 0.0) * m.policies)
    return f"The {100 * level:.0f} % intervals held the truth in {held} of {counted(m.policies, 'test')}."


def _few(m: AccuracyOut) -> list[str]:
    if m.policies >= FEW_PAIRS:
        return []
    return [f"{counted(m.policies, 'test of a policy is', 'tests of a policy are')} few: much of this may be chance."]
