"""REST routes of visit plans."""

from __future__ import annotations

from fastapi import APIRouter

from app.accounts.deps import CurrentCaller
from app.evaluation.wording import estimate_out
from app.planning.plans import service, sign_off, visits, wording
from app.planning.plans.schemas import (
    Approval,
    KeyOpening,
    KeyOut,
    Move,
    PlanEstimateOut,
    PlanEvaluationOut,
    PlanIn,
    PlannedDesignOut,
    PlannedSessionOut,
    PlanOut,
    PlanWarningOut,
    Removal,
)
from app.planning.plans.view import PlanLine, PlanView, shown
from app.planning.plans.view import read_plan as plan_of
from app.planning.protocol.schedule import Order
from app.platform.audit.signatures import SignatureOut
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentVisit, VisitViewed
from app.tables.plans import Plan

router = APIRouter(tags=["planning"], responses=problems(401, 403, 404, 422))


@router.get("/visits/{visit_id}/plan", dependencies=[VisitViewed])
def read_plan(visit: CurrentVisit, db: Db, caller: CurrentCaller) -> PlanOut:
    """Return the plan of a visit."""
    return plan_out(plan_of(db, visit, caller))


@router.post("/visits/{visit_id}/plan", status_code=201)
def draft_plan(visit: CurrentVisit, draft: PlanIn, db: Db, caller: CurrentCaller) -> PlanOut:
    """Draft the plan of a visit: the policies in a drawn order, a cDBS session between any two.

    It supersedes an earlier draft; an approved plan only for who may approve plans, and with a `reason`.
    """
    view = service.draft_plan(db, visit, draft, caller)
    return plan_out(view)


@router.post("/visits/{visit_id}/plan/approve", responses=problems(409, 429))
def approve_plan(visit: CurrentVisit, db: Db, caller: CurrentCaller, approval: Approval) -> PlanOut:
    """Sign the draft as approved for use in this participant; from then on the plan is fixed.

    The signer is a clinician who did not draft it, and gives the password again. What is signed: the order, and of every session its
    policy's bytes, its limits in mA and its ramp.
    """
    view = service.approve_plan(db, visit, caller, approval.password, approval.plan_id, approval.code)
    return plan_out(view)


@router.post("/visits/{visit_id}/plan/moves", responses=problems(409))
def move_session(visit: CurrentVisit, move: Move, db: Db, caller: CurrentCaller) -> PlanOut:
    """Move a tested session of a draft past the tested ones before or after it; cDBS stays between any two policies."""
    found = service.reorder(db, visit, move, caller)
    return plan_out(found)


@router.post("/visits/{visit_id}/plan/key", responses=problems(409))
def open_key(visit: CurrentVisit, opening: KeyOpening, db: Db, caller: CurrentCaller) -> PlanOut:
    """Open the key of a blinded plan, with a reason; in an emergency at once, and the reason by a second call."""
    found = plan_of(db, visit, caller)
    waits = found.plan.key_opened_at is not None and found.plan.key_opened_reason is None
    if waits:
        sign_off.give_reason(db, visit, found.plan, caller, opening.reason)
    else:
        sign_off.open_key(db, visit, found.plan, caller, opening.reason, emergency=opening.emergency)
    return plan_out(plan_of(db, visit, caller))


@router.post("/visits/{visit_id}/removal", status_code=204, responses=problems(409))
def remove_visit(visit: CurrentVisit, removal: Removal, db: Db, caller: CurrentCaller) -> None:
    """Remove a visit in which nothing was done, with its drafts."""
    visits.remove_visit(db, visit, removal.reason, caller)


def plan_out(view: PlanView) -> PlanOut:
    """Convert a plan for the API: of a sealed one what may be shown."""
    view = shown(view)
    plan, visit, evaluation = view.plan, view.visit, view.evaluation
    return PlanOut(
        id=plan.id,
        visit_id=visit.id,
        visit=visit.number,
        date=visit.date,
        participant=visit.participant.code,
        status=plan.status,
        seed=None if view.sealed else plan.seed,
        note=plan.note,
        created_at=plan.created_at,
        created_by=plan.created_by,
        approved_at=plan.approved_at,
        approved_by=plan.approved_by,
        signature=SignatureOut.model_validate(view.signature) if view.signature else None,
        signature_state=view.signature_state.value,
        total_minutes=view.total_minutes,
        evaluation=PlanEvaluationOut(
            id=evaluation.id,
            created_at=evaluation.created_at,
            method=evaluation.default_method,
            horizon_steps=evaluation.horizon_steps,
            gamma=evaluation.gamma,
            snapshot_id=evaluation.snapshot_id,
        )
        if evaluation
        else None,
        stale=bool(view.stale_reasons),
        starts_at=plan.starts_at,
        order=Order(plan.rules.get("order", Order.DRAWN)),
        block=plan.rules.get("block", 0),
        key=_key_out(plan) if plan.blinded else None,
        warnings=[PlanWarningOut(code=w.code, policy_id=w.policy_id, text=wording.warning(w)) for w in view.warnings],
        sessions=[_session_out(line) for line in view.lines],
    )


def _key_out(plan: Plan) -> KeyOut:
    return KeyOut(
        sealed=sign_off.sealed(plan),
        opened_at=plan.key_opened_at,
        opened_by=plan.key_opened_by,
        reason=plan.key_opened_reason,
        emergency=plan.key_opened_in_emergency,
    )


def _session_out(line: PlanLine) -> PlannedSessionOut:
    return PlannedSessionOut(
        position=line.item.position,
        start_minute=line.start_minute,
        controller=line.item.controller,
        policy_id=line.policy.id if line.policy else None,
        policy=line.policy.name if line.policy else None,
        minutes=line.item.minutes,
        washout_minutes=line.item.washout_minutes,
        break_minutes=line.item.break_minutes,
        medication=line.item.medication,
        estimate=estimate_out(line.estimate, PlanEstimateOut) if line.estimate else None,
        predicted_energy=line.predicted_energy,
        verdict=line.item.verdict,
        min_fraction=line.item.min_fraction,
        override_reason=line.item.override_reason,
        repeat=line.item.repeat,
        label=line.item.label,
        hemisphere=line.item.hemisphere,
        cdbs_ma=line.item.cdbs_ma,
        min_ma=line.item.min_ma,
        max_ma=line.item.max_ma,
        ramp_ma_per_s=line.item.ramp_ma_per_s,
        design=PlannedDesignOut.model_validate(line.design.as_json()) if line.design else None,
    )
