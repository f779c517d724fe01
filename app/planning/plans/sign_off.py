"""What a clinician signs when a plan is approved, and whether the signature still stands. The caller commits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from sqlalchemy.orm import Session

from app.accounts import sign_on
from app.accounts.permissions import Caller
from app.platform.audit import signatures
from app.platform.audit.signatures import SignatureState
from app.platform.errors import Conflict, Forbidden
from app.tables.audit import Signature
from app.tables.learning import Policy
from app.tables.plans import Plan, PlanItem
from app.tables.visits import Visit

KIND: Final = "plan"
MEANING: Final = "approved for use in this participant"


def sign_plan(
    db: Session, visit: Visit, plan: Plan, policies: Mapping[int, Policy], caller: Caller, password: str, code: str = ""
) -> Signature:
    """Sign a plan that stands as it shall run.

    Raises:
        Forbidden: whoever drafted it, or a wrong password. TooMany: too many wrong passwords. Conflict: a session without limits.
    """
    if plan.created_by == caller.label:
        raise Forbidden(
            f"You drafted plan {plan.id} yourself.", "A second person must read and sign it: ask a clinician who did not draft it."
        )
    for item in plan.items:
        if item.min_ma is None or item.max_ma is None or item.ramp_ma_per_s is None or item.cdbs_ma is None:
            raise Conflict(
                f"Session {item.position} of plan {plan.id} has no limits in mA.", "Draft the visit anew, so that its limits are set first."
            )
    content = signed_content(visit, plan, policies)
    return sign_on.sign(db, caller, password, kind=KIND, subject_id=plan.id, meaning=MEANING, content=content, code=code)


def signature_of(db: Session, visit: Visit, plan: Plan, policies: Mapping[int, Policy]) -> tuple[SignatureState, Signature | None]:
    """Whether a plan's signature stands, and the newest one under it, standing or broken."""
    if plan.approved_at is None:
        return SignatureState.NONE, None
    newest = next(iter(signatures.signatures_of(db, KIND, plan.id)), None)
    return signatures.state_of(newest, signed_content(visit, plan, policies)), newest


def signed_content(visit: Visit, plan: Plan, policies: Mapping[int, Policy]) -> dict[str, Any]:
    """All that a signature under a plan covers: whose visit, the order, and of every session its policy's bytes and its limits in mA.

    The visit's date is not part of it: a visit that is put off is still the one that was approved.
    """
    return {
        "participant": visit.participant.code,
        "visit": visit.number,
        "blinded": plan.blinded,
        "starts_at": plan.starts_at.isoformat("minutes") if plan.starts_at else None,
        "note": plan.note,
        "evaluation": plan.evaluation_id,
        "sessions": [_session(item, policies.get(item.policy_id) if item.policy_id else None) for item in plan.items],
    }


def _session(item: PlanItem, policy: Policy | None) -> dict[str, Any]:
    return {
        "position": item.position,
        "controller": str(item.controller),
        "policy": item.policy_id,
        "policy_name": policy.name if policy else None,
        "policy_sha256": policy.onnx_sha256 if policy else None,
        "repeat": item.repeat,
        "label": item.label,
        "minutes": item.minutes,
        "washout_minutes": item.washout_minutes,
        "break_minutes": item.break_minutes,
        "medication": item.medication,
        "hemisphere": str(item.hemisphere) if item.hemisphere else None,
        "cdbs_ma": item.cdbs_ma,
        "min_ma": item.min_ma,
        "max_ma": item.max_ma,
        "ramp_ma_per_s": item.ramp_ma_per_s,
        "min_fraction": item.min_fraction,
        "override_reason": item.override_reason,
        "design": item.design,
        "note": item.note,
    }
