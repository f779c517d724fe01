"""Rules of visit plans: drafted from a ranking, approved by a clinician, then fixed. The caller commits."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation import repository as evaluations
from app.evaluation import wording
from app.evaluation.estimates.rows import estimate_of
from app.evaluation.models import Evaluation
from app.evaluation.ranking.assessment import Assessment
from app.evaluation.ranking.service import assessment_of, evaluation_notes
from app.evaluation.ranking.staleness import stale_reasons
from app.learning import repository as learning
from app.learning.models import Policy
from app.planning import wording as plan_wording
from app.planning.plans import repository
from app.planning.plans.designs import Planned, bounds_of, planned_sessions
from app.planning.plans.limits import StatedLimits
from app.planning.plans.models import Plan, PlanItem
from app.planning.plans.safeguards import Safeguard, refuse_approval, safeguards
from app.planning.plans.schedule import Candidate, Rules, schedule
from app.planning.plans.schemas import PlanIn, PlanOptions
from app.planning.plans.sign_off import SignatureState, sign_plan, signature_of
from app.planning.plans.slots import count_repeats, require_limits, set_limits
from app.platform.database import now, set_reason
from app.platform.errors import BetaloopError, Conflict, Invalid, NotFound
from app.platform.signatures.models import Signature
from app.study import service as study
from app.study.models import Controller, Participant, Visit
from app.study.schemas import VisitIn
from app.study.sessions.logged import CONTROLLER_OF_KIND
from ml.ope.estimate import Estimate

MAX_SEED = 2**31 - 1


@dataclass(frozen=True)
class PlanLine:
    """One session of a plan with what is known about it.

    Attributes:
        start_minute: from the first session's start.
        estimate: of the pinned evaluation's method, as it was; None for what was not ranked.
        predicted_energy: mean squared amplitude fraction; 1 for cDBS and 0 for no-DBS by definition, else as the estimate predicts.
        design: what a random session shall try, in a draft with the bounds of today; None for other sessions.
    """

    item: PlanItem
    start_minute: float
    policy: Policy | None
    estimate: Estimate | None
    predicted_energy: float | None

    design: Planned | None


@dataclass(frozen=True)
class PlanView:
    """A plan with its visit, its sessions, the ranking it rests on, and what speaks against it today."""

    plan: Plan
    visit: Visit
    lines: list[PlanLine]
    evaluation: Evaluation | None
    stale_reasons: list[str]
    warnings: list[str]
    signature: Signature | None
    signature_state: SignatureState

    @property
    def total_minutes(self) -> float:
        """From the first session's start to the last one's end."""
        return self.lines[-1].start_minute + self.lines[-1].item.minutes


def read_plan(db: Session, visit: Visit, caller: Caller) -> PlanView:
    """The plan of a visit. Raises NotFound when there is none."""
    study.require(caller, can.READ, visit.participant)
    plan = repository.live_plan(db, visit.id)
    if plan is None:
        raise NotFound(
            f"Visit {visit.number} of participant {visit.participant.code} has no plan yet.",
            "Choose policies in the ranking and draft one, or post their ids here.",
        )
    return _view(db, plan, visit, caller)


def draft_plan(db: Session, visit: Visit, draft: PlanIn, caller: Caller) -> PlanView:
    """Lay out a visit day from chosen policies. An earlier plan is superseded; an approved one only by who may approve, with a reason.

    Raises:
        NotFound: a policy or ranking that the participant does not have. Forbidden: an approved plan, or an unsafe policy, and a caller
            who may not approve. Invalid: a retired policy, a day that does not fit, no reason why an approved plan is replaced, or what
            `safeguards` refuses.
    """
    participant = visit.participant
    study.require(caller, can.DRAFT_PLAN, participant)
    chosen = testable_policies(db, participant, draft.policy_ids)
    rules = rules_of(draft)
    seed = secrets.randbelow(MAX_SEED) if draft.seed is None else draft.seed
    day = schedule([Candidate(p.id, controller_of(p)) for p in chosen], rules, seed)
    evaluation = _evaluation(db, participant, draft.evaluation_id)
    found = assessment_of(db, participant, evaluation) if evaluation else None
    overrides, limits = {o.policy_id: o.reason for o in draft.overrides}, {v.policy_id: v.min_fraction for v in draft.limits}
    guarded = safeguards(found, chosen, overrides, limits, may_override=study.may(caller, can.APPROVE_PLAN, participant))
    repository.lock_visit(db, visit.id)
    _supersede(db, visit, draft.reason, caller)
    plan = Plan(
        visit_id=visit.id,
        evaluation_id=evaluation.id if evaluation else None,
        status="draft",
        seed=seed,
        rules=asdict(rules),
        note=draft.note,
        created_by=caller.label,
    )
    to_try = iter(_random_sessions(db, visit, rules))
    stated = StatedLimits(draft.min_ma, draft.max_ma, draft.ramp_ma_per_s)
    plan.items = [
        PlanItem(
            position=i,
            controller=s.controller,
            policy_id=s.policy_id,
            minutes=s.minutes,
            washout_minutes=s.washout_minutes,
            note="",
            **asdict(Safeguard() if s.policy_id is None else guarded[s.policy_id]),
            design=next(to_try).as_json() if s.controller is Controller.RANDOM else None,
        )
        for i, s in enumerate(day, start=1)
    ]
    count_repeats(plan.items)
    set_limits(db, visit, plan.items, stated, draft.hemisphere)
    db.add(plan)
    db.flush()
    return _view(db, plan, visit, caller)


def approve_plan(db: Session, visit: Visit, caller: Caller, password: str, plan_id: int | None = None) -> PlanView:
    """Sign the draft of a visit as approved for use in this participant; from then on it is fixed.

    Args:
        db: the session. visit: whose plan. caller: the clinician. password: the clinician's own, asked for again.
        plan_id: the draft that was looked at; None for whatever is there.

    Raises:
        NotFound: no plan. Conflict: approved already, replaced meanwhile, with a policy that was retired since it was drafted, limits that
            were set for another cDBS amplitude, or what `safeguards.refuse_approval` refuses.
        Invalid: no cDBS amplitude by which limits are ones in milliamperes. Forbidden, TooMany: as `sign_off.sign_plan`.
    """
    study.require(caller, can.APPROVE_PLAN, visit.participant)
    repository.lock_visit(db, visit.id)
    view = read_plan(db, visit, caller)
    plan = view.plan
    if plan_id is not None and plan.id != plan_id:
        raise Conflict(f"Plan {plan_id} was replaced by plan {plan.id} of {plan.created_by}.", "Look at the new draft, then approve it.")
    if plan.status == "approved":
        raise Conflict(f"Plan {plan.id} was approved by {plan.approved_by} already.", "Draft the visit anew to change it.")
    refuse_withdrawn(view)
    policies = {line.policy.id: line.policy for line in view.lines if line.policy}
    stated = [(v.policy, Safeguard(v.item.verdict, v.item.min_fraction, v.item.override_reason)) for v in view.lines if v.policy]
    refuse_approval(assessment_of(db, visit.participant, view.evaluation) if view.evaluation else None, stated)
    _fix_designs(visit, plan)
    require_limits(visit, plan.items)
    signature = sign_plan(db, visit, plan, policies, caller, password)
    plan.status, plan.approved_at, plan.approved_by = "approved", signature.signed_at, caller.label
    db.flush()
    return replace(view, signature=signature, signature_state=SignatureState.STANDS)


def refuse_withdrawn(view: PlanView) -> None:
    """Raises Conflict for a plan with a policy that was retired after it was drafted."""
    for line in view.lines:
        if line.policy and line.policy.retired_reason:
            raise Conflict(
                f"Policy '{line.policy.name}' was retired after this plan was drafted: {line.policy.retired_reason}.",
                "Draft the visit anew.",
            )


def refuse_running(view: PlanView) -> None:
    """Hold a plan against what may run in a participant: signed, unchanged since, no policy withdrawn, the cDBS amplitude that was signed.

    Raises:
        Conflict: one of these fails; it says which. Invalid: nobody knows the cDBS amplitude any more.
    """
    if view.plan.status != "approved" or view.signature_state is not SignatureState.STANDS:
        why = {
            SignatureState.NONE: "is not signed yet",
            SignatureState.BROKEN: "was changed after it was signed",
            SignatureState.NOT_KEPT: "was approved by an earlier version, which kept no signature",
            SignatureState.STANDS: "was replaced",
        }[view.signature_state]
        raise Conflict(f"Plan {view.plan.id} of visit {view.visit.number} {why}.", "Draft the visit anew, and have a clinician sign it.")
    refuse_withdrawn(view)
    require_limits(view.visit, view.plan.items)


def rules_of(options: PlanOptions) -> Rules:
    """The rules of a visit day as the caller wants them."""
    return Rules(
        session_minutes=options.minutes_per_session,
        washout_minutes=options.washout_minutes,
        total_minutes=options.total_minutes,
        no_dbs=options.no_dbs,
        random_sessions=options.random_sessions,
    )


def today() -> date:
    """The day on which it is decided whether a visit is past (UTC)."""
    return now().date()


def testable_policies(db: Session, participant: Participant, ids: Sequence[int]) -> list[Policy]:
    """The named policies of this participant, in that order.

    Raises:
        NotFound: one that the participant does not have. Invalid: one that is named twice, or retired.
    """
    twice = sorted({i for i in ids if list(ids).count(i) > 1})
    if twice:
        raise Invalid(f"Policy {twice[0]} is named twice.", "Name each policy once; a visit tests each in one session.")
    found = learning.policies_named(db, participant.id, ids)
    for policy in found:
        if policy.retired_reason:
            raise Invalid(f"Policy '{policy.name}' was retired: {policy.retired_reason}.", "Leave it out, or take it back first.")
    return found


def controller_of(policy: Policy) -> Controller:
    """What a session of this policy counts as: students are `distilled`, reference policies `other`, all others `rl`."""
    return CONTROLLER_OF_KIND.get(policy.kind, Controller.RL)


def visit_for_draft(
    db: Session, participant: Participant, visit_id: int | None, number: int | None, day: date | None, caller: Caller
) -> Visit:
    """The visit that a draft is for: an open one by its id, or a new one.

    With neither id nor number: the first open visit whose plan is not approved, or a new one with the next number.

    Raises:
        Invalid: the visit is not open: another participant's, past, or with sessions. Conflict: the number is taken.
    """
    open_visits = repository.open_visits(db, participant.id, today())
    if visit_id is not None:
        for visit in open_visits:
            if visit.id == visit_id:
                return visit
        raise Invalid(
            f"Visit {visit_id} cannot be planned from here: it has sessions, lies in the past, or is another participant's.",
            "Choose another.",
        )
    if number is None:
        if day is None:
            approved = repository.visits_with_approved_plan(db, participant.id)
            free = [visit for visit in open_visits if visit.id not in approved]
            if free:
                return free[0]
        number = repository.next_visit_number(db, participant.id)
    return study.add_visit(db, participant, VisitIn(number=number, date=day), caller)


def _evaluation(db: Session, participant: Participant, evaluation_id: int | None) -> Evaluation | None:
    if evaluation_id is None:
        return evaluations.newest_evaluation(db, participant.id)
    found = evaluations.evaluation(db, participant.id, evaluation_id)
    if found is None:
        raise NotFound(f"Participant {participant.code} has no evaluation {evaluation_id}.", "Name one of the participant's, or none.")
    return found


def _supersede(db: Session, visit: Visit, reason: str | None, caller: Caller) -> None:
    """Retire the visit's present plan; the audit trail says why where it was approved."""
    earlier = repository.live_plan(db, visit.id)
    if earlier is None:
        return
    if earlier.status == "approved":
        study.require(caller, can.APPROVE_PLAN, visit.participant)
        why = (reason or "").strip()
        if not why:
            raise Invalid(
                f"Plan {earlier.id} of visit {visit.number} is approved; no reason is given why it is replaced.",
                "Say why the approved plan is replaced (`reason`), or leave it as it is.",
            )
        set_reason(db, f"approved plan {earlier.id} superseded by a new draft: {why}")
    earlier.status = "superseded"
    db.flush()
    set_reason(db, None)


def _view(db: Session, plan: Plan, visit: Visit, caller: Caller) -> PlanView:
    evaluation = repository.evaluation(db, plan.evaluation_id) if plan.evaluation_id else None
    found = assessment_of(db, visit.participant, evaluation) if evaluation else None
    estimates = {e.policy_id: estimate_of(e) for e in evaluation.estimates if e.method == evaluation.default_method} if evaluation else {}
    policies = evaluations.policies_by_id(db, [i.policy_id for i in plan.items if i.policy_id is not None])
    lines, start = [], 0.0
    for item in plan.items:
        estimate = estimates.get(item.policy_id) if item.policy_id else None
        policy = policies.get(item.policy_id) if item.policy_id else None
        lines.append(PlanLine(item, start, policy, estimate, _energy(item, estimate), _design(visit, item)))
        start += item.minutes + item.washout_minutes
    stale = _stale_reasons(db, visit.participant, evaluation)
    state, signature = signature_of(db, visit, plan, policies)
    return PlanView(plan, visit, lines, evaluation, stale, _warnings(db, visit, plan, lines, found, stale), signature, state)


def _random_sessions(db: Session, visit: Visit, rules: Rules) -> list[Planned]:
    """What the visit's random sessions shall try, by the participant's settings of today."""
    participant = visit.participant
    earlier = repository.earlier_designed_visits(db, visit)
    return planned_sessions(participant.current_settings, participant.code, earlier, rules.random_sessions, rules.session_minutes)


def _design(visit: Visit, item: PlanItem) -> Planned | None:
    if item.design is None:
        return None
    design = Planned.from_json(item.design)
    if design.bounds or not design.holds:
        return design
    try:
        return replace(design, bounds=bounds_of(visit, visit.participant.current_settings, design.lower_bound))
    except Invalid:
        return design  # a warning of the plan says what is missing, and approving it is refused


def _fix_designs(visit: Visit, plan: Plan) -> None:
    """Fix the bounds of held draws in milliamperes."""
    for item in plan.items:
        if item.design is not None and item.design["holds"]:
            design = Planned.from_json(item.design)
            bounds = bounds_of(visit, visit.participant.current_settings, design.lower_bound)
            item.design = replace(design, bounds=bounds).as_json()


def _energy(item: PlanItem, estimate: Estimate | None) -> float | None:
    fixed = {Controller.CDBS: 1.0, Controller.NO_DBS: 0.0}.get(Controller(item.controller))
    if fixed is not None or estimate is None:
        return fixed
    predicted = estimate.predicted.get("energy")
    return None if predicted is None else float(predicted)


def _stale_reasons(db: Session, participant: Participant, evaluation: Evaluation | None) -> list[str]:
    newest = evaluations.newest_evaluation(db, participant.id)
    if evaluation is None or newest is None:
        return []
    if newest.id != evaluation.id:
        return [f"there is a newer ranking (evaluation {newest.id}); this plan rests on evaluation {evaluation.id}"]
    return [wording.sentence(reason) for reason in stale_reasons(db, participant, evaluation)]


def _warnings(
    db: Session, visit: Visit, plan: Plan, lines: Sequence[PlanLine], found: Assessment | None, stale: Sequence[str]
) -> list[str]:
    warnings = [f"The ranking is out of date: {reason}." for reason in stale]
    if found:
        warnings += evaluation_notes(found)
    elif any(line.policy for line in lines):
        warnings.append("No ranking stands behind this plan: the participant's policies have not been evaluated.")
    for line in lines:
        if line.policy is None:
            continue
        cdbs_ma = found.cdbs_ma if found else None
        warnings += plan_wording.of_item(line.policy.name, line.item.min_fraction, line.item.override_reason, cdbs_ma)
        if found and line.estimate is None:
            warnings.append(f"Policy '{line.policy.name}' is not in the ranking.")
        flags = wording.joined(line.estimate.flags) if line.estimate else ""
        if line.estimate and not line.estimate.supported:
            warnings.append(f"The data do not support the estimate of policy '{line.policy.name}': {flags or 'no reason given'}.")
        elif flags:
            warnings.append(f"Policy '{line.policy.name}': {flags}.")
        if line.policy.retired_reason:
            warnings.append(f"Policy '{line.policy.name}' was retired: {line.policy.retired_reason}.")
    if plan.status == "draft":
        try:
            require_limits(visit, plan.items)
        except BetaloopError as error:
            warnings.append(f"The plan cannot be signed: {error}")
    held = repository.session_count(db, visit.id)
    if held:
        warnings.append(f"The visit already has {held} {'session' if held == 1 else 'sessions'}.")
    if plan.status == "draft" and visit.date and visit.date < today():
        warnings.append(f"The visit's date, {visit.date.isoformat()}, is past.")
    return warnings
