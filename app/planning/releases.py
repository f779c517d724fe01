"""Release of a policy for testing in participants: signed by a clinician over its bytes, where it comes from, and its limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.learning.policies import FOREIGN
from app.platform.audit import signatures
from app.platform.audit.signatures import SignatureState, state_of
from app.platform.errors import Conflict
from app.settings import get_settings
from app.study import repository as study_repository
from app.tables.audit import Signature
from app.tables.learning import BufferSnapshot, Policy
from app.tables.participants import Participant
from app.tables.plans import PlanItem

KIND: Final = "policy"
MEANING: Final = "released for testing in participants"
TOLERANCE = 1e-6
"""By how much a planned limit may pass a signed one, mA and mA/s: the digits that a form loses."""


@dataclass(frozen=True)
class Release:
    """State of a policy's release.

    Attributes:
        signature: the newest, standing or not; None where the policy is not released.
    """

    state: SignatureState
    signature: Signature | None

    @property
    def limits(self) -> dict[str, Any] | None:
        """The limits that were signed: `hemisphere`, `cdbs_ma`, `min_ma`, `max_ma`, `ramp_ma_per_s`."""
        return self.signature.content.get("limits") if self.signature else None


def brought_by(db: Session, policy: Policy, caller: Caller) -> Policy | None:
    """Find the policy that the caller imported, among a policy and those that it was distilled or tuned from; None where none."""
    line: list[Policy] = [policy]
    for one in line:  # grows by what each was made from; a policy is never changed, so that no line leads back
        if one.kind == FOREIGN and one.created_by == caller.label:
            return one
        line += [db.get_one(Policy, number) for number in (one.teacher_id, one.parent_id) if number is not None]
    return None


def release_of(db: Session, participant: Participant, policy: Policy) -> Release:
    """Return whether a policy is released, and whether it is still what was released."""
    return _judged(db, participant, policy, signatures.newest_of_each(db, KIND, [policy.id]).get(policy.id))


def refuse_unreleased(db: Session, participant: Participant, planned: Sequence[tuple[Policy, PlanItem]]) -> None:
    """Check the sessions of a plan that is to be approved against the releases of their policies.

    Raises:
        Conflict: a policy that was changed since it was released, or a session that goes beyond the limits of the release. Also a policy
            without a release, where this installation requires one (`BETALOOP_REQUIRE_RELEASED_POLICIES`).
    """
    found = signatures.newest_of_each(db, KIND, sorted({policy.id for policy, _ in planned}))
    for policy, item in planned:
        one = _judged(db, participant, policy, found.get(policy.id))
        if one.state is SignatureState.BROKEN:
            raise Conflict(
                f"Policy '{policy.name}' was changed since it was released for testing.", "Look at the audit trail; plan another policy."
            )
        if one.limits is None:
            if get_settings().require_released_policies:
                raise Conflict(
                    f"Policy '{policy.name}' is not released for testing in participants.",
                    "A clinician releases it on the page of its controller bundle; then approve the plan.",
                )
            continue
        _refuse_beyond(policy, item, one.limits)


def _judged(db: Session, participant: Participant, policy: Policy, newest: Signature | None) -> Release:
    if newest is None:
        return Release(SignatureState.NONE, None)
    content = signed_content(db, participant, policy) | {"limits": newest.content.get("limits")}
    return Release(state_of(newest, content), newest)


def _refuse_beyond(policy: Policy, item: PlanItem, limits: dict[str, Any]) -> None:
    """Raise Conflict where a planned session goes beyond what its policy was released for."""
    side = limits["hemisphere"]
    beyond = (
        (item.min_ma is not None and item.min_ma < limits["min_ma"] - TOLERANCE)
        or (item.max_ma is not None and item.max_ma > limits["max_ma"] + TOLERANCE)
        or (item.ramp_ma_per_s is not None and item.ramp_ma_per_s > limits["ramp_ma_per_s"] + TOLERANCE)
        or (side is not None and item.hemisphere is not None and str(item.hemisphere) != side)
    )
    if beyond:
        within = f"{limits['min_ma']:g} to {limits['max_ma']:g} mA, ramp {limits['ramp_ma_per_s']:g} mA/s{f', {side}' if side else ''}"
        raise Conflict(
            f"Session {item.position} goes beyond the limits within which policy '{policy.name}' was released: {within}.",
            "Draft the visit again within them, or have a clinician release the policy with other limits.",
        )


def signed_content(db: Session, participant: Participant, policy: Policy) -> dict[str, Any]:
    """Build the content that a signature under a policy covers, but the limits: its bytes, and what it was made of."""
    snapshot = db.get(BufferSnapshot, policy.snapshot_id) if policy.snapshot_id else None
    teacher = db.get(Policy, policy.teacher_id) if policy.teacher_id else None
    return {
        "participant": participant.code,
        "policy": policy.id,
        "name": policy.name,
        "kind": policy.kind,
        "algorithm": policy.algorithm,
        "onnx_sha256": policy.onnx_sha256,
        "checkpoint_sha256": policy.checkpoint_sha256,
        "teacher_sha256": teacher.onnx_sha256 if teacher else None,
        "snapshot": {"pins_sha256": snapshot.pins_sha256, "file_sha256": snapshot.file_sha256} if snapshot else None,
        "settings_version": study_repository.settings_version(db, policy.settings_version_id).version,
        "config": policy.config,
        "seed": policy.seed,
        "code_version": policy.code_version,
        "made_by": policy.created_by,
    }
