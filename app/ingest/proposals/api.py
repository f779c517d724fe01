"""REST routes of proposed sessions: list, correct, confirm, cut, drop; and grasp files that wait for their session."""

from __future__ import annotations

from fastapi import APIRouter
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.ingest import repository
from app.ingest.deps import CurrentProposal
from app.ingest.proposals import clocks
from app.ingest.proposals import service as proposals
from app.ingest.proposals.clocks import ClockIn, ClockOut
from app.ingest.proposals.serializers import proposal_out, proposals_out
from app.ingest.proposals.visit_of_recording import add_visit_of_recording
from app.ingest.schemas import (
    AmplitudeChoiceIn,
    AttachedOut,
    AttachIn,
    ConfirmedOut,
    DiscardIn,
    ProposalChange,
    ProposalOut,
    SplitIn,
    VisitOfRecordingIn,
    VisitOfRecordingOut,
)
from app.ingest.uploads import service
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.web.schemas import RowId, problems
from app.study import access
from app.study import repository as study
from app.study.deps import CurrentParticipant
from app.study.recordings.amplitude_sources import AmplitudeConflictOut
from app.study.routes.serializers import session_out, visit_out
from app.tables.sessions import StudySession

router = APIRouter(tags=["proposals"], responses=problems(401, 403, 404, 422))


@router.get("/participants/{code}/proposals")
def list_proposals(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> list[ProposalOut]:
    """List sessions of a participant that wait for confirmation, by visit and start."""
    return proposals_out(db, participant.id, caller)


@router.get("/proposals/{session_id}")
def read_proposal(session: CurrentProposal, db: Db, caller: CurrentCaller) -> ProposalOut:
    """Return one proposed session; NotFound once it counts."""
    return _one(db, session, caller)


@router.patch("/proposals/{session_id}", responses=problems(409))
def correct_proposal(session: CurrentProposal, change: ProposalChange, db: Db, caller: CurrentCaller) -> ProposalOut:
    """Correct a proposal without confirming it. 409 where it was changed after the stated version."""
    row = proposals.change(db, session, change, caller)
    return proposal_out(db, session, row, caller)


@router.put("/proposals/{session_id}/amplitude-source", responses=problems(409))
def choose_amplitude(session: CurrentProposal, choice: AmplitudeChoiceIn, db: Db, caller: CurrentCaller) -> list[AmplitudeConflictOut]:
    """Choose which of the sources counts that state different amplitudes, or `unknown`; until then the session cannot be confirmed."""
    return proposals.choose_amplitude(db, session, choice.version, choice, caller)


@router.put("/sessions/{session_id}/clock", responses=problems(409))
def correct_clock(session_id: RowId, offset: ClockIn, db: Db, caller: CurrentCaller) -> ClockOut:
    """State how far the clock of a session's recording was ahead of UTC; its recordings and their sessions move."""
    return clocks.correct(db, study.session(db, session_id, caller), offset, caller)


@router.post("/proposals/{session_id}/confirm", responses=problems(409))
def confirm_proposal(session: CurrentProposal, change: ProposalChange, db: Db, caller: CurrentCaller) -> ConfirmedOut:
    """Correct a proposal, where members are given, and let it count from now on."""
    notes = proposals.confirm(db, session, change, caller)
    return ConfirmedOut(session=session_out(study.session(db, session.id, caller), caller), notes=notes)


@router.post("/proposals/{session_id}/visit", status_code=201, responses=problems(409))
def add_visit(session: CurrentProposal, of: VisitOfRecordingIn, db: Db, caller: CurrentCaller) -> VisitOfRecordingOut:
    """Add a visit on the day of the recording, and give it to every proposal of that day whose visit is open."""
    visit, moved = add_visit_of_recording(db, session, of.version, caller)
    behind = repository.proposals(db, [s.id for s in moved])
    told = [proposal_out(db, s, behind[s.id], caller) for s in moved]
    return VisitOfRecordingOut(visit=visit_out(visit, visit.participant.code), proposals=told)


@router.post("/proposals/{session_id}/split", status_code=201, responses=problems(409))
def split_proposal(session: CurrentProposal, parts: SplitIn, db: Db, caller: CurrentCaller) -> list[ProposalOut]:
    """Cut a long recording into several proposals that take the place of this one."""
    made = proposals.split(db, session, parts.version, parts.parts, caller)
    behind = repository.proposals(db, [s.id for s in made])
    return [proposal_out(db, s, behind[s.id], caller) for s in made]


@router.post("/proposals/{session_id}/discard", status_code=204, responses=problems(409))
def discard_proposal(session: CurrentProposal, why: DiscardIn, db: Db, caller: CurrentCaller) -> None:
    """Say that a proposal is no session; its recordings stay, and the same file sent again proposes it again."""
    proposals.discard(db, session, why.version, why.reason, caller)


@router.post("/uploaded-files/{file_id}/session", responses=problems(409))
def attach_file(file_id: RowId, target: AttachIn, db: Db, caller: CurrentCaller) -> AttachedOut:
    """Attach a grasp file, which names no clock, to its session."""
    file, participant = repository.upload_file(db, file_id, caller, lock=True)
    access.require(caller, can.WRITE_STUDY, participant)
    session = study.session(db, target.session_id, caller)
    notes = service.attach_grasps(db, file, session)
    return AttachedOut(session=session_out(study.session(db, session.id, caller), caller), notes=notes)


def _one(db: Session, session: StudySession, caller: Caller) -> ProposalOut:
    if session.status != "proposed":
        raise NotFound(f"Session {session.id} is confirmed; it is no proposal any more.", "Read it as a session.")
    return proposal_out(db, session, repository.proposal(db, session.id, caller), caller)
