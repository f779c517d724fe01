"""Every query of snapshots and policies, and the row scope."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.orm import Session, defer, selectinload

from app.accounts.permissions import Caller
from app.platform.errors import NotFound
from app.study.repository import count, in_scope
from app.tables.accounts import Site
from app.tables.learning import BufferGateDecision, BufferSnapshot, Policy, SnapshotSession, Sweep
from app.tables.participants import Participant


def snapshot(db: Session, snapshot_id: int, caller: Caller) -> BufferSnapshot:
    """Find a snapshot with its members. Raises NotFound."""
    row = db.scalar(
        select(BufferSnapshot)
        .join(Participant, Participant.id == BufferSnapshot.participant_id)
        .join(Site, Site.id == Participant.site_id)
        .where(BufferSnapshot.id == snapshot_id, in_scope(caller))
        .options(selectinload(BufferSnapshot.members))
    )
    if row is None:
        raise NotFound(f"There is no buffer snapshot {snapshot_id}, or you have no access to it.")
    return row


def snapshot_by_pins(db: Session, participant_id: int, pins_sha256: str) -> BufferSnapshot | None:
    """Find the participant's snapshot with these pins."""
    return db.scalar(
        select(BufferSnapshot).where(BufferSnapshot.participant_id == participant_id, BufferSnapshot.pins_sha256 == pins_sha256)
    )


def add_snapshot(db: Session, **columns: Any) -> int | None:
    """Add a buffer snapshot; its number, or None where the participant has one of the same pins, made by another process in between."""
    row = insert(BufferSnapshot).values(**columns).on_conflict_do_nothing(index_elements=["participant_id", "pins_sha256"])
    return db.scalar(row.returning(BufferSnapshot.id))


def snapshots(db: Session, participant_id: int, limit: int, offset: int) -> tuple[Sequence[BufferSnapshot], int]:
    """List a page of a participant's snapshots, newest first."""
    query = select(BufferSnapshot).where(BufferSnapshot.participant_id == participant_id)
    rows = db.scalars(query.order_by(BufferSnapshot.id.desc()).limit(limit).offset(offset).options(selectinload(BufferSnapshot.members)))
    return rows.all(), count(db, query)


def newest_snapshot(db: Session, participant_id: int) -> BufferSnapshot | None:
    """Find the snapshot that was taken last."""
    return db.scalar(
        select(BufferSnapshot).where(BufferSnapshot.participant_id == participant_id).order_by(BufferSnapshot.id.desc()).limit(1)
    )


def newest_gate_decision(db: Session, participant_id: int) -> BufferGateDecision | None:
    """Find the newest decision on the participant's buffer gate."""
    return db.scalar(
        select(BufferGateDecision)
        .where(BufferGateDecision.participant_id == participant_id)
        .order_by(BufferGateDecision.id.desc())
        .limit(1)
    )


def policy(db: Session, policy_id: int, caller: Caller) -> Policy:
    """Find a policy. Raises NotFound."""
    row = db.scalar(
        select(Policy)
        .join(Participant, Participant.id == Policy.participant_id)
        .join(Site, Site.id == Participant.site_id)
        .where(Policy.id == policy_id, in_scope(caller))
    )
    if row is None:
        raise NotFound(f"There is no policy {policy_id}, or you have no access to it.")
    return row


def policies(db: Session, participant_id: int, limit: int, offset: int) -> tuple[Sequence[Policy], int]:
    """List a page of a participant's policies, newest first."""
    query = select(Policy).where(Policy.participant_id == participant_id)
    return db.scalars(query.order_by(Policy.id.desc()).limit(limit).offset(offset)).all(), count(db, query)


def policies_named(db: Session, participant_id: int, ids: Sequence[int]) -> list[Policy]:
    """Find the participant's policies of these ids, in that order, each once. Raises NotFound naming those that are not there."""
    rows = {p.id: p for p in db.scalars(select(Policy).where(Policy.participant_id == participant_id, Policy.id.in_(ids)))}
    missing = sorted(set(ids) - set(rows))
    if missing:
        raise NotFound(
            f"The participant has no policy {', '.join(map(str, missing))}.", "Name ids from the participant's list of policies."
        )
    return [rows[i] for i in dict.fromkeys(ids)]


def candidates(db: Session, participant_id: int) -> Sequence[Policy]:
    """List policies that a ranking should have: trained, distilled or made elsewhere, and not retired; oldest first.

    Their curves and other metrics are read when something asks for them.
    """
    return db.scalars(select(Policy).where(*_ranked(participant_id)).order_by(Policy.id).options(defer(Policy.metrics))).all()


def no_candidate(db: Session, participant_id: int) -> str:
    """Say why a participant has no candidate: no policy was made yet, or each was retired."""
    retired = count(db, select(Policy).where(Policy.participant_id == participant_id, Policy.kind != "baseline"))
    return f"No policy is in use: {retired} {'policy' if retired == 1 else 'policies'} retired." if retired else "There is no policy yet."


def candidate_names(db: Session, participant_id: int) -> dict[int, str]:
    """Map the same policies' numbers to their names, oldest first."""
    query = select(Policy.id, Policy.name).where(*_ranked(participant_id)).order_by(Policy.id)
    return {row.id: row.name for row in db.execute(query)}


def _ranked(participant_id: int) -> tuple[ColumnElement[bool], ...]:
    return Policy.participant_id == participant_id, Policy.kind != "baseline", Policy.retired_reason.is_(None)


def policy_by_name(db: Session, participant_id: int, name: str) -> Policy | None:
    """Find the participant's policy of a name."""
    return db.scalar(select(Policy).where(Policy.participant_id == participant_id, Policy.name == name))


def policy_of_step(db: Session, job_id: str, job_step: str) -> Policy | None:
    """Find the policy that a step of a job made."""
    return db.scalar(select(Policy).where(Policy.job_id == job_id, Policy.job_step == job_step))


def baselines(db: Session, participant_id: int) -> Sequence[Policy]:
    """List the participant's baseline policies that are in use, oldest first."""
    return db.scalars(
        select(Policy)
        .where(Policy.participant_id == participant_id, Policy.kind == "baseline", Policy.retired_reason.is_(None))
        .order_by(Policy.id)
    ).all()


def trained_count(db: Session, participant_id: int) -> int:
    """Count the policies trained for the participant; call under `lock_participant` to number the next."""
    query = select(func.count()).select_from(Policy).where(Policy.participant_id == participant_id, Policy.kind == "trained")
    return db.scalar(query) or 0


def lock_participant(db: Session, participant_id: int) -> None:
    """Let one transaction at a time name new policies of a participant."""
    db.execute(select(Participant.id).where(Participant.id == participant_id).with_for_update())


def names_in_use(db: Session, participant_id: int, prefix: str) -> set[str]:
    """List names of the participant's policies that begin so."""
    return set(
        db.scalars(select(Policy.name).where(Policy.participant_id == participant_id, or_(Policy.name.startswith(prefix, autoescape=True))))
    )


def snapshot_members(db: Session, snapshot_id: int) -> Sequence[SnapshotSession]:
    """List the sessions of a snapshot, excluded ones among them."""
    return db.scalars(select(SnapshotSession).where(SnapshotSession.snapshot_id == snapshot_id).order_by(SnapshotSession.session_id)).all()


def sweep(db: Session, sweep_id: int, caller: Caller) -> Sweep:
    """Find a sweep with its policies. Raises NotFound."""
    row = db.scalar(
        select(Sweep)
        .join(Participant, Participant.id == Sweep.participant_id)
        .join(Site, Site.id == Participant.site_id)
        .where(Sweep.id == sweep_id, in_scope(caller))
        .options(selectinload(Sweep.policies))
    )
    if row is None:
        raise NotFound(f"There is no sweep {sweep_id}, or you have no access to it.")
    return row


def sweeps(db: Session, participant_id: int, limit: int, offset: int) -> tuple[Sequence[Sweep], int]:
    """List a page of a participant's sweeps, newest first."""
    query = select(Sweep).where(Sweep.participant_id == participant_id)
    rows = db.scalars(query.order_by(Sweep.id.desc()).limit(limit).offset(offset).options(selectinload(Sweep.policies)))
    return rows.all(), count(db, query)


def sweep_of_job(db: Session, job_id: str) -> Sweep | None:
    """Find the sweep that a job made."""
    return db.scalar(select(Sweep).where(Sweep.job_id == job_id))


def sweep_names(db: Session, participant_id: int) -> set[str]:
    """List the names of the participant's sweeps."""
    return set(db.scalars(select(Sweep.name).where(Sweep.participant_id == participant_id)))
