"""Adverse events as API types."""

from __future__ import annotations

from app.accounts.permissions import Caller
from app.study.adverse_events.schemas import AdverseEventOut
from app.study.adverse_events.service import policy_of
from app.tables.adverse_events import AdverseEvent


def event_out(event: AdverseEvent, caller: Caller) -> AdverseEventOut:
    """An event as it is known now; what ran comes through the blinding gate."""
    now = event.now
    return AdverseEventOut(
        id=event.id,
        participant=event.participant.code,
        visit_id=event.visit_id,
        session_id=event.session_id,
        policy_id=policy_of(event, caller),
        occurred_at=event.occurred_at,
        revision=now.revision,
        kind=now.kind,
        severity=now.severity,
        serious=now.serious,
        note=now.note,
        cleared_reason=now.cleared_reason,
        blocks=event.blocks,
        entered_by=now.entered_by,
        reason=now.reason,
        created_at=now.created_at,
    )
