"""Release of a policy as a controller bundle: whose limits, whose approval, signed by this installation. The caller commits."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app import __version__
from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.learning import foreign
from app.learning import repository as learning
from app.learning.policies import FOREIGN, onnx_of, probe_windows
from app.learning.trajectories import read_buffer
from app.planning.bundles import repository
from app.planning.grounds import events_against, unanswered
from app.planning.plans import wording
from app.planning.plans.limits import DeviceLimits, device_limits
from app.platform import files
from app.platform.database import end_reading, set_reason
from app.platform.errors import Conflict, Invalid
from app.settings import get_settings
from app.study import access, cdbs_amplitude
from app.study import repository as study_repository
from app.tables.learning import BufferSnapshot, Policy
from app.tables.participants import Hemisphere, Participant
from app.tables.plans import BundleRelease
from ml.deploy.appraisal import imputation, plausible_beta
from ml.deploy.bundle import build_bundle, describe, sign
from ml.deploy.manifest import Approval, BundleError, BundleManifest
from ml.deploy.ports.windows import COUNT, Recorded
from ml.policies.onnx_policy import PolicyFileError

KEY = "bundle-signing"
MAKE = "app.planning.bundles.compute:make"
"""What a child runs."""


@dataclass(frozen=True)
class Limits:
    """The clinician's limits of a bundle, mA and mA/s; None takes the default.

    The default range begins at the stimulator's own lower limit, or 0 mA where no recording has one. Where the newest approved plan has a
    test with care, its limit counts if it is higher. The range ends at the cDBS amplitude. The default ramp covers it within one period, as
    in the study's sessions.
    """

    min_ma: float | None = None
    max_ma: float | None = None
    ramp_ma_per_s: float | None = None

    @property
    def stated(self) -> bool:
        """True where anything was stated."""
        return any(v is not None for v in (self.min_ma, self.max_ma, self.ramp_ma_per_s))


class Tried(NamedTuple):
    """Beta windows that a bundle's policy is tried on: `probe`, [M, W], for the test vectors, and the snapshot with all of them."""

    probe: NDArray[np.float64]
    snapshot_sha256: str | None

    def by_visit(self) -> list[Recorded]:
        """Read the recorded windows of each visit, as many as port vectors can hold; none where no snapshot has any."""
        if self.snapshot_sha256 is None:
            return []
        buffer = read_buffer(self.snapshot_sha256)
        rows = buffer.transitions()
        visits = np.array([session.visit for session in buffer.sessions])[rows.session]
        found = []
        for visit in np.unique(visits):
            states = rows.states[visits == visit]
            places = np.unique(np.linspace(0, len(states) - 1, min(len(states), COUNT)).astype(int))
            found.append(Recorded(f"visit {visit}", np.asarray(states[places], dtype=np.float64)))
        return found


def signing_key() -> Ed25519PrivateKey:
    """Load the key of this installation, made at first use."""
    return Ed25519PrivateKey.from_private_bytes(get_settings().secret(KEY))


def public_key() -> str:
    """Return the public half, 64 hexadecimal digits: a tablet gets it once, to check every bundle with."""
    return signing_key().public_key().public_bytes_raw().hex()


def bundle(db: Session, participant: Participant, policy: Policy, limits: Limits, hemisphere: Hemisphere | None, caller: Caller) -> bytes:
    """Return the controller bundle of a policy, signed. It is stored when it is first taken; every release is recorded.

    Raises:
        NotFound: the policy is another participant's.
        Invalid: the cDBS amplitude or the unit of beta is not known, limits that contradict each other, or leave the stimulator's own.
        Conflict: as `refuse_after_events`. Forbidden: the caller may only read.
    """
    access.require(caller, can.TAKE_BUNDLES, participant)
    refuse_after_events(db, participant, policy)
    manifest, windows = manifest_of(db, participant, policy, limits, hemisphere, caller)
    content = content_of(manifest, windows, policy, caller.label if limits.stated else None)
    return take(db, participant, manifest, content, lambda: policy_bundle(policy, manifest, windows), caller)


def refuse_after_events(db: Session, participant: Participant, policy: Policy) -> None:
    """Raise Conflict for a policy with a serious event that no clinician has cleared, and no signed plan answers."""
    events = events_against(db, participant)
    plans = [plan for plan, _ in repository.approved_plans(db, participant.id, policy.id)]
    if policy.id in events and all(policy.id in unanswered(plan, events) for plan in plans):
        what = wording.happened(policy.name, events[policy.id])
        raise Conflict(f"No bundle of the policy leaves: {what}.", wording.ANSWER_EVENT)


def policy_bundle(policy: Policy, manifest: BundleManifest, windows: Tried) -> bytes:
    """Build the signed bundle of a policy. Raises Invalid where it cannot be made."""
    try:
        return _signed(policy, manifest, windows)
    except (BundleError, PolicyFileError) as error:
        raise _unmade(policy, error) from error


def content_of(manifest: BundleManifest, windows: Tried | None, policy: Policy | None, stated_by: str | None) -> str:
    """Hash what a bundle contains (SHA-256), except who takes it and when.

    Args:
        manifest: as the bundle's, before its files are filled in. windows: of the test vectors. policy: whose network runs. Both are None
            where a schedule runs. stated_by: who stated the limits.
    """
    slot = manifest.slot and replace(manifest.slot, issued_at=datetime.min.replace(tzinfo=UTC).isoformat())
    digest = hashlib.sha256(replace(manifest, taken_by=None, limits_stated_by=stated_by, slot=slot).to_bytes())
    if policy is not None:
        digest.update(policy.onnx_sha256.encode())
    if windows is not None:
        digest.update(np.ascontiguousarray(windows.probe).tobytes())
        digest.update(f"port vectors 1, {windows.snapshot_sha256}".encode())
    return digest.hexdigest()


def take(
    db: Session,
    participant: Participant,
    manifest: BundleManifest,
    content_sha256: str,
    make: Callable[[], bytes],
    caller: Caller,
    plan_item_id: int | None = None,
) -> bytes:
    """Return the signed bundle of a content: the bytes that left when it was first taken, or those that `make` makes, which are stored.

    The release is recorded either way. Bytes that were kept and have been lost or damaged are made again; the doctor names them.
    """
    set_reason(db, wording.release_reason(manifest))
    sha256 = repository.kept(db, participant.id, content_sha256)
    made: bytes | None = None
    if sha256 is None or not files.is_whole(sha256):
        made = make()
        end_reading(db)
        new = files.store(db, made).sha256
    repository.lock_content(db, content_sha256)
    # asked again under the lock: another caller may have taken it in between, and then the bytes are those
    sha256 = repository.kept(db, participant.id, content_sha256)
    if made is None or (sha256 is not None and files.is_whole(sha256)):
        assert sha256 is not None
        signed = files.read(sha256)
    else:
        signed, sha256 = made, new
    release = BundleRelease(
        participant_id=participant.id,
        policy_id=manifest.policy_id,
        plan_item_id=plan_item_id,
        sha256=sha256,
        content_sha256=content_sha256,
        hemisphere=Hemisphere(manifest.hemisphere) if manifest.hemisphere else None,
        min_ma=manifest.min_ma,
        max_ma=manifest.max_ma,
        cdbs_ma=manifest.cdbs_ma,
        ramp_ma_per_s=manifest.ramp_ma_per_s,
        approvals=[asdict(approval) for approval in manifest.approvals],
        created_by=caller.label,
    )
    db.add(release)
    db.flush()
    return signed


def preview(
    db: Session, participant: Participant, policy: Policy, limits: Limits, hemisphere: Hemisphere | None, caller: Caller
) -> BundleManifest:
    """Describe the bundle, all but its files; nothing is stored. Raises as `bundle` does, but any reader may look."""
    manifest, windows = manifest_of(db, participant, policy, limits, hemisphere, caller)
    try:
        return _described(policy, manifest, windows)
    except (BundleError, PolicyFileError) as error:
        raise _unmade(policy, error) from error


def _signed(policy: Policy, manifest: BundleManifest, windows: Tried) -> bytes:
    """Build the signed bundle. A policy made elsewhere is run in a child, one of ours here. Raises BundleError, PolicyFileError."""
    content = onnx_of(policy)
    if policy.kind != FOREIGN:
        return sign(build_bundle(content, manifest, windows.probe, windows.by_visit()), signing_key())
    with files.draft_folder() as folder:
        _in_child(policy, manifest, windows, folder / "bundle.zip")
        return (folder / "bundle.zip").read_bytes()


def _described(policy: Policy, manifest: BundleManifest, windows: Tried) -> BundleManifest:
    """Build only the manifest, as `_signed`."""
    content = onnx_of(policy)
    if policy.kind != FOREIGN:
        return describe(content, manifest, windows.probe)
    return BundleManifest.from_bytes(_in_child(policy, manifest, windows, None)["manifest"].encode())


def _in_child(policy: Policy, manifest: BundleManifest, windows: Tried, target: Path | None) -> dict[str, Any]:
    params = {
        "file": str(files.path_of(policy.onnx_sha256).resolve()),
        "manifest": manifest.to_bytes().decode(),
        "windows": windows.probe.tolist(),
        "visits": [] if target is None else [(part.kind, part.windows.tolist()) for part in windows.by_visit()],
        "target": None if target is None else str(target),
        "secrets": str(get_settings().data_dir.resolve() / "secrets"),
        "key": KEY,
    }
    found = foreign.run(MAKE, params)
    if "refused" in found:
        raise BundleError(found["refused"])
    return found


def may_take(participant: Participant, caller: Caller) -> bool:
    """Check whether the caller may take a bundle and state its limits."""
    return access.may(caller, can.TAKE_BUNDLES, participant)


def approvals(db: Session, participant_id: int, policy_id: int) -> tuple[Approval, ...]:
    """List sign-offs of the participant's approved visit plans with this policy."""
    return tuple(
        Approval(
            name=plan.approved_by,
            role="approver of plans",
            approved_at=plan.approved_at.isoformat(timespec="seconds"),
            statement=f"plan {plan.id} of visit {number}",
        )
        for plan, number in repository.approved_plans(db, participant_id, policy_id)
        if plan.approved_by is not None and plan.approved_at is not None
    )


def manifest_of(
    db: Session, participant: Participant, policy: Policy, limits: Limits, hemisphere: Hemisphere | None, caller: Caller
) -> tuple[BundleManifest, Tried]:
    """Build the manifest of the bundle, and the beta windows that it is tried on: logged ones, where there are any of its length."""
    access.require_own(participant, policy, f"policy {policy.id}")
    version = study_repository.settings_version(db, policy.settings_version_id)
    snapshot = db.get(BufferSnapshot, policy.snapshot_id) if policy.snapshot_id else None
    data = snapshot or learning.newest_snapshot(db, participant.id)
    unit = data.beta_unit if data else version.beta_unit
    source = data.beta_source if data else version.beta_source
    if unit is None or source is None:
        raise Invalid("The unit and source of beta are not known.", "Set beta_unit and beta_source in the participant's settings.")
    cdbs = cdbs_amplitude.in_force_now(participant, hemisphere)
    device = device_limits(db, participant, hemisphere)
    usable = data if data and study_repository.settings_version(db, data.settings_version_id).window == version.window else None
    teacher = db.get(Policy, policy.teacher_id) if policy.teacher_id else None
    agreement: dict[str, Any] = policy.metrics.get("on_buffer") or {}
    stated = f"{caller.label}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC" if limits.stated else None
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
            min_ma=_lowest(db, participant, policy, limits, device, cdbs),
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
            **beta_limits(data, version.window),
            test_windows_from=f"snapshot {usable.id}" if usable else None,
            taken_by=f"{caller.label}, {datetime.now(UTC):%Y-%m-%d %H:%M:%S.%f} UTC",
            public_key=public_key(),
            approvals=approvals(db, participant.id, policy.id),
        )
    except BundleError as error:
        raise _unmade(policy, error, _at_fault(limits, device, cdbs)) from error
    return manifest, Tried(probe_windows(usable, version), usable.file_sha256 if usable else None)


def _at_fault(limits: Limits, device: DeviceLimits | None, cdbs_ma: float) -> dict[str, str]:
    """Name the stated limit that excludes the cDBS amplitude or leaves the stimulator's own, as a problem's `field`; else empty."""
    if limits.min_ma is not None and (limits.min_ma > cdbs_ma or (device and limits.min_ma < device.min_ma)):
        return {"field": "min_ma"}
    if limits.max_ma is not None and (limits.max_ma < cdbs_ma or (device and limits.max_ma > device.max_ma)):
        return {"field": "max_ma"}
    return {}


def beta_limits(snapshot: BufferSnapshot | None, window: int) -> dict[str, Any]:
    """Derive which beta is plausible and how lost beta is imputed, as entries of the manifest. Without a snapshot only frozen beta is
    implausible."""
    if snapshot is None:
        return plausible_beta(None)
    buffer = read_buffer(snapshot.file_sha256)
    return plausible_beta(buffer.transitions().states) | imputation(buffer.sessions, window)


def _lowest(db: Session, participant: Participant, policy: Policy, limits: Limits, device: DeviceLimits | None, cdbs_ma: float) -> float:
    """Return the lower limit, mA: the stated one, else the highest of the stimulator's own and that of the newest approved plan with the
    policy.

    Raises:
        Invalid: a stated limit below that of the plan: the policy was approved to be tested with care, down to that amplitude.
    """
    planned = repository.planned_limits(db, participant.id, policy.id)
    # to the hundredth of a milliampere, upwards, so that rounding never goes below what was approved
    least = math.ceil(100 * planned[0] * cdbs_ma - 1e-6) / 100 if planned else 0.0
    if limits.min_ma is None:
        return max(least, device.min_ma if device else 0.0)
    if limits.min_ma < least:
        raise Invalid(
            f"A lower limit of {limits.min_ma:g} mA is below the {least:g} mA with which policy '{policy.name}' was approved to be tested.",
            "Raise the lower limit, or leave it out.",
            field="min_ma",
        )
    return limits.min_ma


def _unmade(policy: Policy, error: Exception, fault: dict[str, str] | None = None) -> Invalid:
    return Invalid(f"The bundle of policy '{policy.name}' cannot be made: {error}.", "Correct what is named.", **(fault or {}))
