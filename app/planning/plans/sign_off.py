"""Signature of a clinician under an approved plan, and its present state. The caller commits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts import sign_on
from app.accounts.permissions import Caller
from app.platform.audit import signatures
from app.platform.audit.signatures import SignatureState
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Forbidden, Invalid
from app.study import access
from app.tables.audit import Signature
from app.tables.learning import Policy
from app.tables.plans import Plan, PlanItem
from app.tables.visits import Visit

KIND: Final = "plan"
MEANING: Final = "approved for use in this participant"


def sign_plan(
    db: Session, visit: Visit, plan: Plan, policies: Mapping[int, Policy], caller: Caller, password: str, code: str = ""
) -> Signature:
    """Sign a plan in its final form.

    Raises:
        Forbidden: the caller drafted it, or a wrong password. TooMany: too many wrong passwords. Conflict: a session without limits.
    """
    if plan.created_by == caller.label:
        raise Forbidden(
            f"You drafted plan {plan.id} yourself.", "A second person must read and sign it: ask a clinician who did not draft it."
        )
    for item in plan.items:
        if item.min_ma is None or item.max_ma is None or item.ramp_ma_per_s is None or item.cdbs_ma is None:
            raise Conflict(
                f"Session {item.position} of plan {plan.id} has no limits in mA.",
                "Draft the visit again, so that its limits are set first.",
            )
    content = signed_content(visit, plan, policies)
    return sign_on.sign(db, caller, password, kind=KIND, subject_id=plan.id, meaning=MEANING, content=content, code=code)


def signature_of(db: Session, visit: Visit, plan: Plan, policies: Mapping[int, Policy]) -> tuple[SignatureState, Signature | None]:
    """Return the state of a plan's signature, and the newest one under it, valid or broken."""
    if plan.approved_at is None:
        return SignatureState.NONE, None
    newest = next(iter(signatures.signatures_of(db, KIND, plan.id)), None)
    return signatures.state_of(newest, signed_content(visit, plan, policies)), newest


def signed_content(visit: Visit, plan: Plan, policies: Mapping[int, Policy]) -> dict[str, Any]:
    """Build the content that a signature under a plan covers: whose visit, the order, and of every session its policy's bytes and limits in
    mA.

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


# Blinded plans: sessions run under letters, and which letter is which controller is the sealed key. The caller commits.


@dataclass(frozen=True)
class CommonLimits:
    """Limits that hold for every session of a plan alike, mA and mA/s: they reveal no controller."""

    min_ma: float
    max_ma: float
    ramp_ma_per_s: float


def label_sessions(items: Sequence[PlanItem], seed: int) -> None:
    """Give every session a letter of its own, drawn: a repeated letter would distinguish policies from cDBS."""
    order = np.random.default_rng([seed, len(items)]).permutation(len(items))
    for item, place in zip(items, order, strict=True):
        item.label = _letters(int(place))


def sealed(plan: Plan) -> bool:
    """Check whether it is hidden which session is which: from the signature on, until the key is opened."""
    return plan.blinded and plan.approved_at is not None and plan.key_opened_at is None


def common_limits(items: Sequence[PlanItem]) -> CommonLimits | None:
    """Return the least and the greatest amplitude and the fastest change of any session; None where a limit is open."""
    lows, highs, ramps = ([getattr(i, name) for i in items] for name in ("min_ma", "max_ma", "ramp_ma_per_s"))
    if not items or any(v is None for v in (*lows, *highs, *ramps)):
        return None
    return CommonLimits(min(lows), max(highs), max(ramps))


def open_key(db: Session, visit: Visit, plan: Plan, caller: Caller, reason: str, *, emergency: bool = False) -> None:
    """Open the key of a blinded plan.

    Args:
        reason: why; in an emergency it may be empty, and is asked for afterwards (`give_reason`).

    Raises:
        Forbidden: the caller may not open keys. Conflict: the plan is not blinded, not signed, or open already.
        Invalid: no reason, and no emergency.
    """
    access.require(caller, can.OPEN_KEY, visit.participant)
    if not sealed(plan):
        why = "is not blinded" if not plan.blinded else "is not signed yet" if plan.approved_at is None else "has an open key already"
        raise Conflict(f"Plan {plan.id} of visit {visit.number} {why}.", "Load the page again.")
    if not reason.strip() and not emergency:
        raise Invalid("A reason is missing.", "Say why the key is opened; in an emergency open it at once and give the reason afterwards.")
    set_reason(db, reason.strip() or "emergency: the reason follows")
    plan.key_opened_at, plan.key_opened_by = now(), caller.label
    plan.key_opened_reason, plan.key_opened_in_emergency = reason.strip() or None, emergency
    db.flush()
    set_reason(db, None)


def give_reason(db: Session, visit: Visit, plan: Plan, caller: Caller, reason: str) -> None:
    """State afterwards why a key was opened in an emergency.

    Raises:
        Forbidden: the caller may not open keys. Conflict: there is a reason already, or nothing was opened. Invalid: no reason.
    """
    access.require(caller, can.OPEN_KEY, visit.participant)
    if plan.key_opened_at is None or plan.key_opened_reason is not None:
        raise Conflict(f"Plan {plan.id} of visit {visit.number} waits for no reason.", "Load the page again.")
    if not reason.strip():
        raise Invalid("A reason is missing.", "Say why the key was opened.")
    set_reason(db, reason.strip())
    plan.key_opened_reason = reason.strip()
    db.flush()
    set_reason(db, None)


def _letters(number: int) -> str:
    """Write 0 as A, 25 as Z, 26 as AA."""
    text = ""
    number += 1
    while number:
        number, digit = divmod(number - 1, 26)
        text = chr(ord("A") + digit) + text
    return text
