"""Rows of the audit trail: one for every write, made by triggers in the database, so that no code path can forget it.

`record` adds events that change no row: a refused sign-in, a record or a bundle that left. Both write as the owner of the tables; the
service's own role may only read the trail.
"""

from __future__ import annotations

import json
from datetime import timedelta
from typing import Any

from sqlalchemy import select, text
from sqlalchemy.orm import Session

from app.platform.database import now, set_actor
from app.tables.audit import AuditEvent

AUDITED: dict[str, tuple[str, ...]] = {
    "app_user": ("password_hash",),
    "membership": (),
    "second_factor": ("sealed_secret", "recovery", "last_used_at"),
    "sign_in": ("token_sha256", "last_seen_at"),
    "sign_on_link": ("last_used_at",),
    "api_token": ("token_sha256", "last_used_at"),
    "study": (),
    "site": (),
    "participant": (),
    "settings_version": (),
    "margins_version": (),
    "margins_lock": (),
    "declared_confirmation": (),
    "cdbs_amplitude": (),
    "device": (),
    "visit": (),
    "visit_lock": (),
    "session": (),
    "session_conditions": (),
    "characteristics_version": (),
    "dose": (),
    "adverse_event": (),
    "adverse_event_revision": (),
    "data_query": (),
    "data_query_entry": (),
    "recording": ("details",),
    "session_segment": (),
    "trace": ("values_f32", "valid_bits"),
    "qoc": (),
    "tremor_series": ("start_unix_s_f64", "duration_s_f64", "fractions_f32", "any_tremor_f32"),
    "grasp_test": ("open_fist_s_f64",),
    "stored_file": (),
    "upload": ("report",),
    "upload_file": ("report",),
    "column_mapping": (),
    "signal_meaning": (),
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
    "port_check": ("result",),
    "signature": ("content",),
    "day_entry": (),
    "job": ("progress", "message", "updated_at"),
}
"""Audited tables and the columns omitted from what is shown: secrets, bulk arrays and live progress. Every change makes a row, except of
last-seen times and live progress alone."""


VIEW_EVERY = timedelta(minutes=15)
"""A page that is reloaded is one view."""


def record(db: Session, action: str, entity: str, entity_id: str | int, details: dict[str, Any] | None = None) -> None:
    """Record something in the trail that changed no row; the session knows who did it (`set_actor`). The caller commits.

    Args:
        action: a verb of at most ten letters, e.g. `export`, `download`, `refuse`, `view`.
        entity, entity_id: what it was done to.
        details: what else is to be known, without identity.
    """
    if not db.info.get("actor"):
        set_actor(db, "system")
    db.flush()
    note = text("select audit_note(:action, :entity, :entity_id, cast(:details as jsonb))")
    said = None if details is None else json.dumps(details, allow_nan=False)
    db.execute(note, {"action": action, "entity": entity, "entity_id": str(entity_id), "details": said})


def record_once(db: Session, action: str, entity: str, entity_id: str, details: dict[str, Any], every: timedelta) -> bool:
    """Record as `record` does, unless the trail has the same with these details and younger than `every`; returns whether a row was
    written."""
    same = (AuditEvent.entity == entity) & (AuditEvent.entity_id == entity_id) & (AuditEvent.action == action)
    young = (AuditEvent.after == details) & (AuditEvent.at > now() - every)
    if db.scalar(select(AuditEvent.id).where(same, young).limit(1)) is not None:
        return False
    record(db, action, entity, entity_id, details)
    return True


def record_view(db: Session, entity: str, entity_id: str | int) -> bool:
    """Record that the acting user looked at something, once in VIEW_EVERY; whether a row was written. The caller commits."""
    what, user_id = str(entity_id), db.info.get("actor", {}).get("user_id")
    same = (AuditEvent.entity == entity) & (AuditEvent.entity_id == what) & (AuditEvent.user_id == user_id)
    mine = select(AuditEvent.id).where(same, AuditEvent.action == "view", AuditEvent.at > now() - VIEW_EVERY)
    if db.scalar(mine.limit(1)) is not None:
        return False
    record(db, "view", entity, what)
    return True
