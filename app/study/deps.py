"""FastAPI dependencies: the participant, visit or session that a path names, if the caller may read it; and records of views.

Routes that show outcomes by controller depend on one of `ResultsViewed`, `VisitViewed` and `SessionViewed`. So do those that open
controllers to blinded assessors once a visit is locked. They write the trail before the response is sent. Where there was nothing to see
they write nothing: wrong addresses would fill it. Looks at one thing within a quarter of an hour are one row; each table or figure that is
taken is its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from fastapi import Depends, Path, Request

from app.accounts.deps import CurrentCaller
from app.platform.audit import record, record_view
from app.platform.database import Db
from app.platform.web.schemas import RowId
from app.study import blinding, repository
from app.tables.participants import Participant
from app.tables.sessions import StudySession
from app.tables.visits import Visit


def mark_synthetic(request: Request, participant: Participant) -> None:
    """Note that the answer is about a simulation: its page, its figures and the names of its files say so."""
    if participant.synthetic:
        request.state.synthetic = participant.code


def current_participant(
    request: Request, code: Annotated[str, Path(max_length=40, pattern=r"^[^\x00]*$")], db: Db, caller: CurrentCaller
) -> Participant:
    """Load the participant that the path names."""
    found = repository.participant_by_code(db, code, caller)
    mark_synthetic(request, found)
    return found


def current_visit(request: Request, visit_id: RowId, db: Db, caller: CurrentCaller) -> Visit:
    """Load the visit that the path names."""
    found = repository.visit(db, visit_id, caller)
    mark_synthetic(request, found.participant)
    return found


def current_session(request: Request, session_id: RowId, db: Db, caller: CurrentCaller) -> StudySession:
    """Load the session that the path names."""
    found = repository.session(db, session_id, caller)
    mark_synthetic(request, found.visit.participant)
    return found


CurrentParticipant = Annotated[Participant, Depends(current_participant)]


CurrentVisit = Annotated[Visit, Depends(current_visit)]


CurrentSession = Annotated[StudySession, Depends(current_session)]


FILE_FORMS = ("csv", "svg")
"""Forms in which results are taken away as a file: the end of a path, or the member `format` of a query."""


def results_viewed(request: Request, db: Db, caller: CurrentCaller) -> Iterator[None]:
    """Record a view of results by controller, of a participant or of all. For a blinded assessor nothing is written while everything that
    the route shows is hidden from them.
    """
    yield
    if request.method != "GET" or (caller.is_blinded and not repository.tells_some_arm(db, caller, request.path_params.get("code"))):
        return
    path = request.scope["path"]
    form = _file_form(request)
    if form is not None:
        record(db, "export", "results", path, {"format": form})
    else:
        record_view(db, "results", path)


def visit_viewed(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller) -> Iterator[None]:
    """Record a view of what ran at a visit and its results. Nothing is written while that is hidden from the caller."""
    yield
    if request.method == "GET" and blinding.may_know(visit, caller):
        record_view(db, "visit", visit.id)


def session_viewed(request: Request, session: CurrentSession, db: Db, caller: CurrentCaller) -> Iterator[None]:
    """Record a view of what ran in a session and its results."""
    yield
    if request.method == "GET" and blinding.may_know(session.visit, caller):
        record_view(db, "session", session.id)


def _file_form(request: Request) -> str | None:
    """Return the file form of FILE_FORMS that the response has; None of a page or of JSON."""
    stated = request.scope["path"].rpartition(".")[2], request.query_params.get("format", "")
    return next((form for form in FILE_FORMS if form in stated), None)


ResultsViewed = Depends(results_viewed, scope="function")
VisitViewed = Depends(visit_viewed, scope="function")
SessionViewed = Depends(session_viewed, scope="function")
