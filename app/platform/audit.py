"""The audit trail: one row for every write, made by triggers in the database, so that no code path can forget it."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import BigInteger, Index, String, Text, func
from sqlalchemy.orm import Mapped, mapped_column

from app.platform.database import Base


class AuditEvent(Base):
    """Who changed which row, when, from what to what, and why. Insert only: a trigger refuses updates and deletions."""

    __tablename__ = "audit_event"
    __table_args__ = (Index("ix_audit_event_entity", "entity", "entity_id"),)

    id: Mapped[int] = mapped_column(BigInteger, primary_key=True)
    at: Mapped[datetime] = mapped_column(server_default=func.clock_timestamp(), index=True)
    actor: Mapped[str] = mapped_column(String(254))
    user_id: Mapped[int | None]
    request_id: Mapped[str | None] = mapped_column(String(64))
    action: Mapped[str] = mapped_column(String(10))
    entity: Mapped[str] = mapped_column(String(63))
    entity_id: Mapped[str] = mapped_column(String(200))
    before: Mapped[dict[str, Any] | None]
    after: Mapped[dict[str, Any] | None]
    reason: Mapped[str | None] = mapped_column(Text)


AUDITED: dict[str, tuple[str, ...]] = {
    "app_user": ("password_hash",),
    "membership": (),
    "sign_in": ("token_sha256", "last_seen_at"),
    "api_token": ("token_sha256", "last_used_at"),
    "study": (),
    "site": (),
    "participant": (),
    "settings_version": (),
    "margins_version": (),
    "margins_lock": (),
    "cdbs_amplitude": (),
    "device": (),
    "visit": (),
    "visit_lock": (),
    "session": (),
    "session_conditions": (),
    "adverse_event": (),
    "adverse_event_revision": (),
    "recording": ("details",),
    "session_segment": (),
    "trace": ("values_f32", "valid_bits"),
    "qoc": (),
    "tremor_series": ("start_unix_s_f64", "duration_s_f64", "fractions_f32", "any_tremor_f32"),
    "grasp_test": ("open_fist_s_f64",),
    "stored_file": (),
    "upload": ("report",),
    "upload_file": ("report",),
    "session_proposal": (),
    "policy": (),
    "buffer_snapshot": (),
    "buffer_gate_decision": (),
    "sweep": (),
    "snapshot_session": (),
    "evaluation": (),
    "estimate": ("details",),
    "plan": (),
    "plan_item": (),
    "bundle_release": (),
    "signature": ("content",),
    "job": ("progress", "message", "updated_at"),
}
"""Audited tables and the columns left out of what is shown: secrets, bulk arrays and live progress. Every change makes a row, except of
last-seen times and live progress alone."""
