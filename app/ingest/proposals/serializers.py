"""Proposed sessions as API types."""

from __future__ import annotations

from dataclasses import asdict

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.ingest import repository, wording
from app.ingest.schemas import (
    PartOut,
    ProposalOut,
    UsableStepsOut,
)
from app.study import repository as study
from app.study.blinding import may_know
from app.study.recordings import amplitude_sources
from app.study.recordings.facts import unknown_clock
from app.study.routes.serializers import session_out
from app.study.sessions.contradictions import control_recording
from app.study.sessions.usable_steps import on_any, usable_steps
from app.tables.sessions import StudySession
from app.tables.uploads import SessionProposal


def proposals_out(db: Session, participant_id: int, caller: Caller) -> list[ProposalOut]:
    """Convert all proposals of a participant for the API."""
    rows = study.proposals_of_participant(db, participant_id)
    behind = repository.proposals(db, [s.id for s in rows])
    return [proposal_out(db, s, behind[s.id], caller) for s in rows if s.id in behind]


def proposal_out(db: Session, session: StudySession, row: SessionProposal, caller: Caller) -> ProposalOut:
    """Convert a proposal for the API."""
    usable = usable_steps(db, session)
    return ProposalOut(
        session=session_out(session, caller),
        version=row.version,
        upload_id=row.upload_id,
        visit_open=row.visit_open,
        evidence=wording.reasons(row.evidence, session.visit.sealed),
        changed_by=row.changed_by,
        parts=[
            PartOut(
                recording_id=s.recording_id,
                hemisphere=s.recording.hemisphere,
                recording_started_at=s.recording.started_at,
                recording_s=s.recording.duration_s,
                start_s=s.start_s,
                stop_s=s.stop_s,
                is_control=s.is_control,
            )
            for s in session.segments
        ],
        usable_steps=[UsableStepsOut(**{name: value for name, value in asdict(u).items() if name != "at"}) for u in usable],
        usable_on_any=on_any(usable),
        amplitude_conflicts=[c.as_api(may_know(session.visit, caller)) for c in amplitude_sources.of_session(session)],
        clock_unknown=unknown_clock(control_recording(session)),
    )
