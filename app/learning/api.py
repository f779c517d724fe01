"""REST routes of learning: policies, controller bundles, buffer snapshots."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, File, Form, Query, Response, UploadFile
from fastapi.responses import PlainTextResponse
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.learning import bundles, repository, service, snapshots
from app.learning.models import BufferSnapshot, Policy
from app.learning.schemas import PolicyChange, PolicyName, PolicyOut, SnapshotOut, SnapshotSessionOut
from app.platform.database import Db
from app.platform.errors import TooLarge
from app.platform.schemas import Page, PagingQuery, RowId, problems
from app.study import repository as study_repository
from app.study import service as study
from app.study.api import CurrentParticipant
from app.study.models import Hemisphere, Participant

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))

Milliamperes = Annotated[float | None, Query(ge=0, le=25.5, allow_inf_nan=False)]


def current_policy(policy_id: RowId, db: Db, caller: CurrentCaller) -> Policy:
    """The policy that the path names."""
    return repository.policy(db, policy_id, caller)


def current_snapshot(snapshot_id: RowId, db: Db, caller: CurrentCaller) -> BufferSnapshot:
    """The snapshot that the path names."""
    return repository.snapshot(db, snapshot_id, caller)


def current_own_policy(participant: CurrentParticipant, policy_id: RowId, db: Db, caller: CurrentCaller) -> Policy:
    """The policy that the path names after its participant. Raises NotFound for another participant's."""
    policy = repository.policy(db, policy_id, caller)
    study.require_own(participant, policy, f"policy {policy_id}")
    return policy


CurrentPolicy = Annotated[Policy, Depends(current_policy)]
CurrentOwnPolicy = Annotated[Policy, Depends(current_own_policy)]
CurrentSnapshot = Annotated[BufferSnapshot, Depends(current_snapshot)]


@router.get("/participants/{code}/policies")
def list_policies(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[PolicyOut]:
    """Policies of a participant, newest first; baselines and retired ones among them."""
    rows, total = repository.policies(db, participant.id, paging.limit, paging.offset)
    return Page(items=[policy_out(db, p, participant) for p in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.post("/participants/{code}/policies", status_code=201, responses=problems(409, 413))
def add_policy(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    name: Annotated[PolicyName, Form(description="How the study calls it.")],
    file: Annotated[
        UploadFile, File(description="ONNX: input [N, W] of beta windows, oldest first; output [N, 1] of amplitude fractions.")
    ],
) -> PolicyOut:
    """Add a policy made elsewhere; it is checked by running it."""
    row = service.add_external(db, participant, name.strip(), read_limited(file), file.filename or "policy.onnx", caller)
    db.commit()
    return policy_out(db, row, participant)


@router.get("/policies/{policy_id}")
def read_policy(policy: CurrentPolicy, db: Db) -> PolicyOut:
    """One policy."""
    return policy_out(db, policy, db.get_one(Participant, policy.participant_id))


@router.patch("/policies/{policy_id}")
def change_policy(policy: CurrentPolicy, change: PolicyChange, db: Db, caller: CurrentCaller) -> PolicyOut:
    """Retire a policy with a reason, or take it back."""
    participant = db.get_one(Participant, policy.participant_id)
    service.retire(db, participant, policy, change.retired_reason, caller)
    db.commit()
    return policy_out(db, policy, participant)


@router.get(
    "/policies/{policy_id}/bundle",
    response_class=Response,
    responses={200: {"content": {"application/zip": {}}, "description": "The controller bundle."}},
)
def read_bundle(
    policy: CurrentPolicy,
    db: Db,
    caller: CurrentCaller,
    min_ma: Annotated[Milliamperes, Query(description="Lowest amplitude, mA; the stimulator's own limit, or 0, where not given.")] = None,
    max_ma: Annotated[Milliamperes, Query(description="Highest amplitude, mA; the cDBS amplitude where not given.")] = None,
    ramp_ma_per_s: Annotated[float | None, Query(gt=0, le=100, allow_inf_nan=False, description="Fastest change, mA/s.")] = None,
    hemisphere: Annotated[Hemisphere | None, Query(description="Needed where a visit states several cDBS amplitudes.")] = None,
) -> Response:
    """The signed controller bundle as a ZIP: network, C header, reference runner, test vectors, the clinician's limits, a sheet.

    Each is stored as it left, and the audit trail says who took it, for whom and within which limits.
    """
    participant = db.get_one(Participant, policy.participant_id)
    content = bundles.bundle(db, participant, policy, bundles.Limits(min_ma, max_ma, ramp_ma_per_s), hemisphere, caller)
    db.commit()
    name = f"{participant.code}-policy-{policy.id}.zip"
    return Response(content, media_type="application/zip", headers={"Content-Disposition": f'attachment; filename="{name}"'})


@router.get("/bundle-key", response_class=PlainTextResponse)
def read_bundle_key(caller: CurrentCaller) -> str:
    """The public key that this installation's bundles are signed with: 64 hexadecimal digits. Give it to a tablet once."""
    return bundles.public_key() + "\n"


@router.get("/participants/{code}/snapshots")
def list_snapshots(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[SnapshotOut]:
    """Buffer snapshots of a participant, newest first."""
    rows, total = repository.snapshots(db, participant.id, paging.limit, paging.offset)
    return Page(items=[snapshot_out(db, s, participant) for s in rows], total=total, limit=paging.limit, offset=paging.offset)


@router.post("/participants/{code}/snapshots", status_code=201)
def take_snapshot(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> SnapshotOut:
    """Pin the replay buffer as it is now; the same data give the same snapshot."""
    row = snapshots.take_snapshot(db, participant, caller)
    db.commit()
    return snapshot_out(db, row, participant)


@router.get("/snapshots/{snapshot_id}")
def read_snapshot(snapshot: CurrentSnapshot, db: Db) -> SnapshotOut:
    """One snapshot with its sessions, and why others were left out."""
    return snapshot_out(db, snapshot, db.get_one(Participant, snapshot.participant_id))


def read_limited(file: UploadFile) -> bytes:
    """The bytes of an uploaded policy. Raises TooLarge."""
    content = file.file.read(service.UPLOAD_LIMIT + 1)
    if len(content) > service.UPLOAD_LIMIT:
        raise TooLarge(
            f"'{file.filename}' is larger than {service.UPLOAD_LIMIT >> 20} MiB.", "A policy of the study's kind has some kilobytes."
        )
    return content


def policy_out(db: Session, p: Policy, participant: Participant) -> PolicyOut:
    """A policy for the API."""
    return PolicyOut(
        id=p.id,
        participant=participant.code,
        name=p.name,
        kind=p.kind,
        algorithm=p.algorithm,
        teacher_id=p.teacher_id,
        parent_id=p.parent_id,
        snapshot_id=p.snapshot_id,
        settings_version=study_repository.settings_version(db, p.settings_version_id).version,
        job_id=p.job_id,
        config=p.config,
        seed=p.seed,
        metrics=p.metrics,
        onnx_sha256=p.onnx_sha256,
        code_version=p.code_version,
        created_at=p.created_at,
        created_by=p.created_by,
        retired_reason=p.retired_reason,
    )


def snapshot_out(db: Session, s: BufferSnapshot, participant: Participant) -> SnapshotOut:
    """A snapshot for the API."""
    return SnapshotOut(
        id=s.id,
        participant=participant.code,
        settings_version=study_repository.settings_version(db, s.settings_version_id).version,
        pins_sha256=s.pins_sha256,
        file_sha256=s.file_sha256,
        sessions=s.sessions,
        steps=s.steps,
        median_steps=s.median_steps,
        beta_unit=s.beta_unit,
        beta_source=s.beta_source,
        created_at=s.created_at,
        created_by=s.created_by,
        members=[SnapshotSessionOut.model_validate(m, from_attributes=True) for m in s.members],
    )
