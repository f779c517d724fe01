"""REST routes of visit plans."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Response

from app.accounts.deps import CurrentCaller
from app.evaluation.shown import estimate_out
from app.planning.plans import service
from app.planning.plans.schemas import (
    Approval,
    PlanEstimateOut,
    PlanEvaluationOut,
    PlanIn,
    PlannedDesignOut,
    PlannedSessionOut,
    PlanOut,
    SignatureOut,
)
from app.planning.plans.service import PlanLine, PlanView
from app.planning.sheet import pdf
from app.platform.audit import record
from app.platform.database import Db, now
from app.platform.web.schemas import problems
from app.study.deps import CurrentVisit

router = APIRouter(tags=["planning"], responses=problems(401, 403, 404, 422))

_PDF: dict[int | str, dict[str, Any]] = {200: {"content": {"application/pdf": {}}, "description": "The sheet."}}


@router.get("/visits/{visit_id}/plan")
def read_plan(visit: CurrentVisit, db: Db, caller: CurrentCaller) -> PlanOut:
    """The plan of a visit."""
    return plan_out(service.read_plan(db, visit, caller))


@router.post("/visits/{visit_id}/plan", status_code=201)
def draft_plan(visit: CurrentVisit, draft: PlanIn, db: Db, caller: CurrentCaller) -> PlanOut:
    """Draft the plan of a visit: the policies in a drawn order, a cDBS session between any two.

    It supersedes an earlier draft; an approved plan only for who may approve plans, and with a `reason`.
    """
    view = service.draft_plan(db, visit, draft, caller)
    db.commit()
    return plan_out(view)


@router.post("/visits/{visit_id}/plan/approve", responses=problems(409, 429))
def approve_plan(visit: CurrentVisit, db: Db, caller: CurrentCaller, approval: Approval) -> PlanOut:
    """Sign the draft as approved for use in this participant; from then on the plan is fixed.

    The signer is a clinician who did not draft it, and gives the password again. What is signed: the order, and of every session its
    policy's bytes, its limits in mA and its ramp.
    """
    view = service.approve_plan(db, visit, caller, approval.password, approval.plan_id)
    db.commit()
    return plan_out(view)


@router.get("/visits/{visit_id}/plan.pdf", response_class=Response, responses=_PDF)
def print_plan(visit: CurrentVisit, db: Db, caller: CurrentCaller) -> Response:
    """The plan as a sheet to print: sessions in order, estimates, blanks to fill in, signatures. A draft says so across every page."""
    view = service.read_plan(db, visit, caller)
    record(db, "download", "plan", view.plan.id)
    db.commit()
    name = f"plan-{visit.participant.code}-visit-{visit.number}.pdf"
    return Response(
        pdf.render(view, caller.label, now()), media_type="application/pdf", headers={"Content-Disposition": f'inline; filename="{name}"'}
    )


def plan_out(view: PlanView) -> PlanOut:
    """A plan for the API."""
    plan, visit, evaluation = view.plan, view.visit, view.evaluation
    return PlanOut(
        id=plan.id,
        visit_id=visit.id,
        visit=visit.number,
        date=visit.date,
        participant=visit.participant.code,
        status=plan.status,
        seed=plan.seed,
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
        warnings=view.warnings,
        sessions=[_session_out(line) for line in view.lines],
    )


def _session_out(line: PlanLine) -> PlannedSessionOut:
    return PlannedSessionOut(
        position=line.item.position,
        start_minute=line.start_minute,
        controller=line.item.controller,
        policy_id=line.item.policy_id,
        policy=line.policy.name if line.policy else None,
        minutes=line.item.minutes,
        washout_minutes=line.item.washout_minutes,
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
