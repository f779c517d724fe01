"""Rules of visit plans: drafted from a ranking, approved by a clinician, then fixed. The caller commits."""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation import repository as evaluations
from app.learning import repository as learning
from app.planning import releases
from app.planning.grounds import grounds
from app.planning.plans import repository
from app.planning.plans.designs import Planned, bounds_of, is_held, near_sessions, planned_sessions, seed_of
from app.planning.plans.limits import StatedLimits, lowest_draw, planned_cdbs_ma, require_limits, set_limits
from app.planning.plans.safeguards import Safeguard, refuse_approval, safeguards
from app.planning.plans.schemas import HeldIn, Move, PlanIn, PlanOptions
from app.planning.plans.sign_off import label_sessions, sealed, sign_plan
from app.planning.plans.view import PlanView, medication_due, read_plan, refuse_after_events, refuse_withdrawn, view_of
from app.planning.protocol.schedule import Candidate, Order, Rules, require_controls, schedule
from app.platform.audit.signatures import SignatureState
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid, NotFound
from app.study import access
from app.study.recordings.controller_log import CONTROLLER_OF_KIND
from app.tables.evaluations import Evaluation
from app.tables.learning import Policy
from app.tables.participants import Hemisphere, Participant
from app.tables.plans import Plan, PlanItem
from app.tables.sessions import Controller
from app.tables.visits import Visit

MAX_SEED = 2**31 - 1


def draft_plan(db: Session, visit: Visit, draft: PlanIn, caller: Caller) -> PlanView:
    """Lay out a visit day from chosen policies. An earlier plan is superseded. Replacing an approved one takes the right to approve, and a
    reason.

    Raises:
        NotFound: a policy or ranking that the participant does not have. Forbidden: an approved plan, or an unsafe policy, and a caller who
            may not approve. Invalid: a retired policy, a day that does not fit, or no reason why an approved plan is replaced. Also a
            session near an amplitude that the participant's bound forbids, or what `safeguards` refuses.
    """
    participant = visit.participant
    access.require(caller, can.DRAFT_PLAN, participant)
    chosen = testable_policies(db, participant, draft.policy_ids)
    held = sum(wish.sessions for wish in draft.held)
    rules = replace(rules_of(draft), held_sessions=held, block=repository.earlier_planned_visits(db, visit))
    seed = _seed(participant, rules) if draft.seed is None else draft.seed
    day = schedule([Candidate(p.id, controller_of(p)) for p in chosen], rules, seed)
    evaluation = _evaluation(db, participant, draft.evaluation_id)
    found = grounds(db, participant, evaluation)
    overrides, limits = {o.policy_id: o.reason for o in draft.overrides}, {v.policy_id: v.min_fraction for v in draft.limits}
    guarded = safeguards(found, chosen, overrides, limits, may_override=access.may(caller, can.SIGN_PLAN, participant))
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
        blinded=draft.blinded,
        starts_at=draft.starts_at,
    )
    to_try = iter(_to_try(db, visit, rules, draft, seed))
    stated = StatedLimits(draft.min_ma, draft.max_ma, draft.ramp_ma_per_s)
    plan.items = [
        PlanItem(
            position=i,
            controller=s.controller,
            policy_id=s.policy_id,
            minutes=s.minutes,
            washout_minutes=s.washout_minutes,
            break_minutes=s.break_minutes,
            note="",
            **asdict(Safeguard() if s.policy_id is None else guarded[s.policy_id]),
            design=next(to_try).as_json() if s.controller is Controller.RANDOM else None,
        )
        for i, s in enumerate(day, start=1)
    ]
    count_repeats(plan.items)
    if plan.blinded:
        label_sessions(plan.items, seed)
    set_limits(db, visit, plan.items, stated, draft.hemisphere)
    _set_medication(visit, plan)
    db.add(plan)
    db.flush()
    return view_of(db, plan, visit)


def approve_plan(db: Session, visit: Visit, caller: Caller, password: str, plan_id: int | None = None, code: str = "") -> PlanView:
    """Sign the draft of a visit as approved for use in this participant; from then on it is fixed.

    Args:
        db: the session. visit: whose plan. caller: the clinician. password: the clinician's own, asked for again.
        plan_id: the draft that was looked at; None for whatever is there. code: of the second factor, where the clinician has one.

    Raises:
        NotFound: no plan. Conflict: approved already, replaced meanwhile, a policy retired since, or limits that were set for another cDBS
            amplitude. Also a serious adverse event after the reason why its policy is tested all the same, and what
            `safeguards.refuse_approval` or `releases.refuse_unreleased` refuse.
        Invalid: no cDBS amplitude by which limits are ones in milliamperes. Forbidden, TooMany: as `sign_off.sign_plan`.
    """
    access.require(caller, can.SIGN_PLAN, visit.participant)
    repository.lock_visit(db, visit.id)
    view = read_plan(db, visit, caller)
    plan = view.plan
    if plan_id is not None and plan.id != plan_id:
        raise Conflict(f"Plan {plan_id} was replaced by plan {plan.id} of {plan.created_by}.", "Look at the new draft, then approve it.")
    if plan.status == "approved":
        raise Conflict(f"Plan {plan.id} was approved by {plan.approved_by} already.", "Draft the visit again to change it.")
    refuse_withdrawn(view)
    policies = {line.policy.id: line.policy for line in view.lines if line.policy}
    stated = [(v.policy, Safeguard(v.item.verdict, v.item.min_fraction, v.item.override_reason)) for v in view.lines if v.policy]
    refuse_approval(grounds(db, visit.participant, view.evaluation), stated)
    refuse_after_events(view)
    releases.refuse_unreleased(db, visit.participant, [(line.policy, line.item) for line in view.lines if line.policy])
    _fix_designs(visit, plan)
    require_limits(visit, plan.items)
    signature = sign_plan(db, visit, plan, policies, caller, password, code)
    plan.status, plan.approved_at, plan.approved_by = "approved", signature.signed_at, caller.label
    db.flush()
    return replace(view, signature=signature, signature_state=SignatureState.STANDS)


def rules_of(options: PlanOptions) -> Rules:
    """Build the rules of a visit day as the caller wants them."""
    return Rules(
        session_minutes=options.minutes_per_session,
        washout_minutes=options.washout_minutes,
        total_minutes=options.total_minutes,
        no_dbs=options.no_dbs,
        random_sessions=options.random_sessions,
        no_dbs_minutes=options.no_dbs_minutes,
        repeats=options.repeats,
        order=options.order,
        break_minutes=options.break_minutes,
    )


def testable_policies(db: Session, participant: Participant, ids: Sequence[int]) -> list[Policy]:
    """Load the named policies of this participant, in that order.

    Raises:
        NotFound: one that the participant does not have. Invalid: one that is named twice, or retired.
    """
    twice = sorted({i for i in ids if list(ids).count(i) > 1})
    if twice:
        raise Invalid(f"Policy {twice[0]} is named twice.", "Name each policy once; `repeats` says how many sessions each has.")
    found = learning.policies_named(db, participant.id, ids)
    for policy in found:
        if policy.retired_reason:
            hint = "Leave it out, or take it back first."
            raise Invalid(f"Policy '{policy.name}' was retired: {policy.retired_reason}.", hint, field="policy_ids")
    return found


def controller_of(policy: Policy) -> Controller:
    """Return the controller of a session of this policy: students are `distilled`, reference policies `other`, all others `rl`."""
    return CONTROLLER_OF_KIND.get(policy.kind, Controller.RL)


def count_repeats(items: Sequence[PlanItem]) -> None:
    """Count the sessions of each policy, and of each controller without one, from 1; those near an amplitude by themselves."""
    seen: Counter[tuple[Controller, int | None, bool]] = Counter()
    for item in items:
        arm = (Controller(item.controller), item.policy_id, is_held(item))
        seen[arm] += 1
        item.repeat = seen[arm]


def reorder(db: Session, visit: Visit, move: Move, caller: Caller) -> PlanView:
    """Move a tested session of a draft past others; sessions of cDBS and without stimulation stay where the protocol has them.

    The user who moves a session counts as the plan's author from then on, and cannot sign it.

    Raises:
        NotFound: no plan. Conflict: it is signed. Invalid: no tested session is there, there are not so many before or after it, or two
            policies would have no cDBS session between them.
    """
    access.require(caller, can.DRAFT_PLAN, visit.participant)
    repository.lock_visit(db, visit.id)
    plan = read_plan(db, visit, caller).plan
    if plan.status != "draft":
        raise Conflict(f"Plan {plan.id} is signed.", "Draft the visit again to change it.")
    tested = [item for item in plan.items if item.controller not in (Controller.CDBS, Controller.NO_DBS)]
    place = next((i for i, item in enumerate(tested) if item.position == move.position), None)
    step = -1 if move.earlier else 1
    if place is None or not 0 <= place + step * move.places < len(tested):
        where = "up" if move.earlier else "down"
        raise Invalid(f"Session {move.position} cannot be moved {where} by {move.places}.", "Move a tested session past another one.")
    for other in tested[place + step :: step][: move.places]:
        repository.swap(db, tested[place], other)
    require_controls([(Controller(i.controller), i.policy_id) for i in sorted(plan.items, key=lambda i: i.position)])
    plan.rules = plan.rules | {"order": Order.STATED.value}
    plan.created_by = caller.label
    db.flush()
    db.refresh(plan, ["items"])
    count_repeats(plan.items)
    _set_medication(visit, plan)
    db.flush()
    return view_of(db, plan, visit)


def _set_medication(visit: Visit, plan: Plan) -> None:
    """State for each session what is due before it, by the participant's schedule."""
    for item, words in zip(plan.items, medication_due(visit, plan), strict=True):
        item.medication = words


def _seed(participant: Participant, rules: Rules) -> int:
    """Draw a seed; of a square by the participant's code, so that its rows go on from visit to visit."""
    if rules.order in (Order.LATIN_SQUARE, Order.WILLIAMS):
        return seed_of(participant.code, 0)
    return secrets.randbelow(MAX_SEED)


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
        access.require(caller, can.SIGN_PLAN, visit.participant)
        if sealed(earlier) and repository.has_sessions(db, visit.id):
            raise Conflict(
                f"Sessions of visit {visit.number} ran under blinded plan {earlier.id}, whose key is sealed.",
                "Open the key first, or plan another visit.",
            )
        why = (reason or "").strip()
        if not why:
            raise Invalid(
                f"Plan {earlier.id} of visit {visit.number} is approved; no reason is given why it is replaced.",
                "Say why the approved plan is replaced (`reason`), or leave it as it is.",
                field="reason",
            )
        set_reason(db, f"approved plan {earlier.id} superseded by a new draft: {why}")
    earlier.status = "superseded"
    db.flush()
    set_reason(db, None)


def _to_try(db: Session, visit: Visit, rules: Rules, draft: PlanIn, seed: int) -> list[Planned]:
    """Design the visit's random sessions and those near an amplitude by today's settings, in a drawn order where there are both."""
    participant, settings = visit.participant, visit.participant.current_settings
    bound = lowest_draw(db, visit, StatedLimits(draft.min_ma, draft.max_ma, draft.ramp_ma_per_s), draft.hemisphere)
    earlier = repository.earlier_designed_visits(db, visit)
    random = planned_sessions(settings, participant.code, earlier, rules.random_sessions, rules.session_minutes, bound)
    if not draft.held:
        return random
    levels, cdbs_ma = _levels(visit, draft.held, draft.hemisphere)
    everyone = random + near_sessions(levels, settings, participant.code, visit.number, rules.session_minutes, bound, cdbs_ma)
    return [everyone[i] for i in np.random.default_rng([seed, 0x6E6561]).permutation(len(everyone))]


def _levels(visit: Visit, held: Sequence[HeldIn], hemisphere: Hemisphere | None) -> tuple[list[float], float | None]:
    """Return the fraction of cDBS of every session near an amplitude, and the cDBS amplitude in mA; None where unneeded and not stated.

    Raises:
        Invalid: an amplitude in mA whose fraction of cDBS is unknown.
    """
    try:
        cdbs_ma: float | None = planned_cdbs_ma(visit, hemisphere)
    except Invalid:
        if any(wish.amplitude_ma is not None for wish in held):
            raise
        cdbs_ma = None
    levels = []
    for wish in held:
        if wish.amplitude_fraction is not None:
            level = wish.amplitude_fraction
        else:
            assert wish.amplitude_ma is not None
            assert cdbs_ma is not None
            level = round(wish.amplitude_ma / cdbs_ma, 6)
        levels += [level] * wish.sessions
    return levels, cdbs_ma


def _fix_designs(visit: Visit, plan: Plan) -> None:
    """Fix the bounds of sustained draws in milliamperes."""
    for item in plan.items:
        if item.design is not None and item.design["holds"]:
            design = Planned.from_json(item.design)
            bounds = bounds_of(visit, visit.participant.current_settings, design.bound)
            item.design = replace(design, bounds=bounds).as_json()
