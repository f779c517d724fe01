"""Release of a policy: a clinician signs it for testing in participants, within limits. The caller commits."""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts import sign_on
from app.accounts.permissions import Caller
from app.learning.policies import onnx_of
from app.planning.bundles import service as bundles
from app.planning.releases import KIND, MEANING, Release, brought_by, signed_content
from app.platform.audit.signatures import SignatureState
from app.platform.errors import Conflict, Forbidden
from app.study import access
from app.tables.learning import Policy
from app.tables.participants import Hemisphere, Participant


def release(
    db: Session,
    participant: Participant,
    policy: Policy,
    limits: bundles.Limits,
    hemisphere: Hemisphere | None,
    caller: Caller,
    password: str,
    code: str = "",
) -> Release:
    """Sign a policy as released for testing in participants, within limits. A newer release replaces an older one.

    Args:
        limits: omitted ones take the default of a bundle. password: of the caller, asked for again; empty where a fresh sign-on replaces
            it. code: of the second factor.

    Raises:
        Forbidden: a caller who imported the policy or one of its teachers, or approves no plans; a wrong password.
        TooMany: too many wrong ones.
        Conflict: a retired policy, or as `bundles.refuse_after_events`.
        Invalid: limits that contradict each other or leave the stimulator's own; a damaged file; no stated cDBS amplitude or unit of beta.
    """
    access.require(caller, can.RELEASE, participant)
    access.require_own(participant, policy, f"policy {policy.id}")
    if policy.retired_reason:
        raise Conflict(f"Policy '{policy.name}' was retired: {policy.retired_reason}.", "Take it back first, or release another one.")
    bundles.refuse_after_events(db, participant, policy)
    brought = brought_by(db, policy, caller)
    if brought is not None:
        made_of = "" if brought is policy else f" Policy '{policy.name}' was made from it."
        raise Forbidden(
            f"You brought policy '{brought.name}' from elsewhere yourself.{made_of}",
            "A second person looks at it and releases it: ask a clinician.",
        )
    onnx_of(policy)
    manifest, _ = bundles.manifest_of(db, participant, policy, limits, hemisphere, caller)
    signed = {
        "hemisphere": manifest.hemisphere,
        "cdbs_ma": manifest.cdbs_ma,
        "min_ma": manifest.min_ma,
        "max_ma": manifest.max_ma,
        "ramp_ma_per_s": manifest.ramp_ma_per_s,
    }
    content = signed_content(db, participant, policy) | {"limits": signed}
    row = sign_on.sign(db, caller, password, kind=KIND, subject_id=policy.id, meaning=MEANING, content=content, code=code)
    return Release(SignatureState.STANDS, row)
