"""How a policy leaves as a controller bundle: whose limits, whose approval, signed by this installation. The caller commits."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from numpy.typing import NDArray
from sqlalchemy import column, select, table
from sqlalchemy.orm import Session

from app import __version__
from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.learning import repository
from app.learning.models import BufferSnapshot, Policy
from app.learning.policies.service import probe_windows
from app.platform import files
from app.platform.audit import AuditEvent
from app.platform.database import set_reason
from app.platform.errors import Forbidden, Invalid
from app.settings import get_settings
from app.study import repository as study_repository
from app.study.models import Hemisphere, Participant, Recording, Visit
from ml.deploy.bundle import build_bundle, describe, sign
from ml.deploy.manifest import DEFAULTS, Approval, BundleError, BundleManifest
from ml.policies.onnx_policy import PolicyFileError

KEY = "bundle-signing"
_ZIP = "application/zip"


@dataclass(frozen=True)
class Limits:
    """The clinician's limits of a bundle, mA and mA/s; None takes the default.

    Defaults: the stimulator's own lower limit, or 0 mA where no recording holds one, to the cDBS amplitude, and a ramp that covers this
    range within one period, as the study's sessions had it.
    """

    min_ma: float | None = None
    max_ma: float | None = None
    ramp_ma_per_s: float | None = None

    @property
    def stated(self) -> bool:
        """Whether anything was stated."""
        return any(v is not None for v in (self.min_ma, self.max_ma, self.ramp_ma_per_s))


@dataclass(frozen=True)
class DeviceLimits:
    """Amplitude limits that a recording of the participant's stimulator holds: the strictest of its enabled programs, mA."""

    min_ma: float
    max_ma: float


def signing_key() -> Ed25519PrivateKey:
    """The key of this installation, made at first use."""
    return Ed25519PrivateKey.from_private_bytes(get_settings().secret(KEY))


def public_key() -> str:
    """The public half, 64 hexadecimal digits: what a tablet is given once, to check every bundle with."""
    return signing_key().public_key().public_bytes_raw().hex()


def bundle(db: Session, participant: Participant, policy: Policy, limits: Limits, hemisphere: Hemisphere | None, caller: Caller) -> bytes:
    """The controller bundle of a policy, signed. It is stored, so that the audit trail says who took which limits out when.

    Raises:
        Invalid: the cDBS amplitude or the unit of beta is not known, limits that contradict each other, or leave the stimulator's own.
        Forbidden: limits stated by somebody who may only read.
    """
    if limits.stated and not may_state(participant, caller):
        raise Forbidden("You may not state the limits of a bundle.", "Ask a clinician or an engineer of the study.")
    manifest, windows = _manifest(db, participant, policy, limits, hemisphere, caller)
    try:
        content = build_bundle(files.read(policy.onnx_sha256), manifest, windows)
    except (BundleError, PolicyFileError) as error:
        raise _unmade(policy, error) from error
    signed = sign(content, signing_key())
    side = f", {hemisphere}" if hemisphere else ""
    set_reason(
        db,
        f"controller bundle of {participant.code}, policy {policy.id}{side}: {manifest.min_ma:g} to {manifest.max_ma:g} mA, "
        f"cDBS {manifest.cdbs_ma:g} mA, ramp {manifest.ramp_ma_per_s:g} mA/s",
    )
    files.store(db, signed, _ZIP)
    db.flush()
    return signed


def preview(
    db: Session, participant: Participant, policy: Policy, limits: Limits, hemisphere: Hemisphere | None, caller: Caller
) -> BundleManifest:
    """What the bundle would say of itself, all but its files; nothing is stored. Raises Invalid as `bundle` does."""
    manifest, windows = _manifest(db, participant, policy, limits, hemisphere, caller)
    try:
        return describe(files.read(policy.onnx_sha256), manifest, windows)
    except (BundleError, PolicyFileError) as error:
        raise _unmade(policy, error) from error


def may_state(participant: Participant, caller: Caller) -> bool:
    """Whether somebody may state the limits of a bundle: those who may write into the study."""
    return caller.may(can.WRITE_STUDY, participant.site.study_id, participant.site.id)


def taken(db: Session, participant: Participant, policy: Policy) -> list[AuditEvent]:
    """The bundles of a policy that left so far, newest first, as the audit trail has them."""
    named = AuditEvent.reason.startswith(f"controller bundle of {participant.code}, policy {policy.id}", autoescape=True)
    found = db.scalars(select(AuditEvent).where(AuditEvent.entity == "stored_file", named).order_by(AuditEvent.id.desc()))
    return [event for event in found if re.match(rf".*, policy {policy.id}[,:]", event.reason or "")]


def device_limits(db: Session, participant: Participant, hemisphere: Hemisphere | None) -> DeviceLimits | None:
    """Limits of the newest recording that holds any, of this side where one is named; None where no recording does."""
    query = select(Recording).where(Recording.participant_id == participant.id)
    if hemisphere is not None:
        query = query.where((Recording.hemisphere == hemisphere) | Recording.hemisphere.is_(None))
    for recording in db.scalars(query.order_by(Recording.started_at.desc().nulls_last(), Recording.id.desc())):
        programs = [p for group in (recording.details.get("limits") or {}).values() for p in group.values()]
        if programs:
            return DeviceLimits(max(p["lower_ma"] for p in programs), min(p["upper_ma"] for p in programs))
    return None


def approvals(db: Session, policy_id: int) -> tuple[Approval, ...]:
    """Sign-offs of the approved visit plans that this policy stands in. Plans belong to a later phase; their tables are asked by name."""
    plan = table("plan", *(column(name) for name in ("id", "visit_id", "status", "approved_at", "approved_by")))
    item = table("plan_item", column("plan_id"), column("policy_id"))
    rows = db.execute(
        select(plan.c.id, plan.c.approved_by, plan.c.approved_at, Visit.number)
        .join_from(plan, Visit, Visit.id == plan.c.visit_id)
        .where(plan.c.status == "approved", plan.c.id.in_(select(item.c.plan_id).where(item.c.policy_id == policy_id)))
        .order_by(plan.c.id)
    )
    return tuple(
        Approval(name=by, role="approver of plans", approved_at=at.isoformat(timespec="seconds"), statement=f"plan {id_} of visit {number}")
        for id_, by, at, number in rows
    )


def present_cdbs_ma(participant: Participant, hemisphere: Hemisphere | None) -> float:
    """The cDBS amplitude in force now: the newest visit that states one (of this hemisphere), else the settings' shorthand."""
    for visit in sorted(participant.visits, key=_visit_number, reverse=True):
        stated = {a.amplitude_ma for a in visit.cdbs_amplitudes if hemisphere in (None, a.hemisphere)}
        if len(stated) == 1:
            return stated.pop()
        if stated:
            raise Invalid(f"Visit {visit.number} states several cDBS amplitudes.", "Name the hemisphere: left or right.")
    shorthand = participant.current_settings.cdbs_amplitude_ma
    if shorthand is None:
        raise Invalid("The cDBS amplitude is not known.", "Set cdbs_amplitude_ma in the participant's settings or at a visit.")
    return shorthand


def _manifest(
    db: Session, participant: Participant, policy: Policy, limits: Limits, hemisphere: Hemisphere | None, caller: Caller
) -> tuple[BundleManifest, NDArray[np.float64]]:
    """What the bundle says about itself, and beta windows for its test vectors: logged ones, where there are any of its length."""
    version = study_repository.settings_version(db, policy.settings_version_id)
    snapshot = db.get(BufferSnapshot, policy.snapshot_id) if policy.snapshot_id else None
    data = snapshot or repository.newest_snapshot(db, participant.id)
    unit = data.beta_unit if data else version.beta_unit
    source = data.beta_source if data else version.beta_source
    if unit is None or source is None:
        raise Invalid("The unit and source of beta are not known.", "Set beta_unit and beta_source in the participant's settings.")
    cdbs = present_cdbs_ma(participant, hemisphere)
    device = device_limits(db, participant, hemisphere)
    usable = data if data and study_repository.settings_version(db, data.settings_version_id).window == version.window else None
    teacher = db.get(Policy, policy.teacher_id) if policy.teacher_id else None
    agreement: dict[str, Any] = policy.metrics.get("on_buffer") or {}
    stated = f"{caller.label}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC" if limits.stated else DEFAULTS
    try:
        manifest = BundleManifest(
            participant=participant.code,
            policy_id=policy.id,
            policy_name=policy.name,
            hemisphere=hemisphere.value if hemisphere else None,
            window=version.window,
            period_s=version.period_s,
            beta_unit=unit,
            beta_source=source,
            beta_low_hz=version.beta_low_hz,
            beta_high_hz=version.beta_high_hz,
            min_valid_fraction=version.min_valid_fraction,
            min_ma=(device.min_ma if device else 0.0) if limits.min_ma is None else limits.min_ma,
            max_ma=cdbs if limits.max_ma is None else limits.max_ma,
            cdbs_ma=cdbs,
            ramp_ma_per_s=cdbs / version.period_s if limits.ramp_ma_per_s is None else limits.ramp_ma_per_s,
            limits_stated_by=stated,
            device_min_ma=device.min_ma if device else None,
            device_max_ma=device.max_ma if device else None,
            snapshot_sha256=snapshot.file_sha256 if snapshot else None,
            policy_code_version=policy.code_version,
            code_version=__version__,
            teacher_name=teacher.name if teacher else None,
            agreement_mean=agreement.get("mean"),
            agreement_p99=agreement.get("p99"),
            agreement_worst=agreement.get("worst"),
            logged_lower_bound=version.lower_bound,
            test_windows_from=f"snapshot {usable.id}" if usable else None,
            taken_by=f"{caller.label}, {datetime.now(UTC):%Y-%m-%d %H:%M:%S.%f} UTC",
            public_key=public_key(),
            approvals=approvals(db, policy.id),
        )
    except BundleError as error:
        raise _unmade(policy, error) from error
    return manifest, probe_windows(usable, version)


def _unmade(policy: Policy, error: Exception) -> Invalid:
    return Invalid(f"The bundle of policy '{policy.name}' cannot be made: {error}.", "Correct what is named.")


def _visit_number(visit: Visit) -> int:
    return visit.number
