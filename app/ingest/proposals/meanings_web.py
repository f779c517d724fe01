"""Meanings of markers, amplitude channels and gyroscopes: asked on a session's page, stated once for the study, read by its recordings."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import Field
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.ingest import repository
from app.ingest.proposals.service import renew
from app.ingest.uploads import redecode
from app.platform.database import Db, set_reason
from app.platform.errors import BetaloopError, Conflict, Forbidden, Invalid
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.schemas import Model, Number, Text, problems
from app.platform.web.templates import render
from app.study.access import require
from app.study.blinding import may_know
from app.study.deps import CurrentSession
from app.study.visits import require_unlocked
from app.tables.recordings import Recording
from app.tables.sessions import StudySession
from app.tables.uploads import SignalMeaning, UploadFile
from ml.formats import AMPLITUDE_UNITS, CHANNEL_KEY, LEVER_KEY, Meaning, Means, Question

api = APIRouter(tags=["proposals"], responses=problems(401, 403, 404, 422))
pages = APIRouter()

LABELS = {
    "nothing": "nothing of stimulation",
    "off": "stimulation is off from here",
    "amplitude": "from here on the amplitude is",
    "stated": "the amplitude in it holds from here",
    "unknown": "the amplitude is unknown from here",
    "unit": "the unit of this channel is",
    "lever": "the lever of this gyroscope is",
}


class MeaningIn(Model):
    """Meaning of one marker or channel, for all recordings of the study."""

    key: Text = Field(min_length=1, max_length=80, description="Of the question.")
    means: Means | None = Field(description="Null ends a meaning: it is asked about again.")
    amplitude_ma: Number | None = Field(None, ge=0, lt=25.5, description="From the marker on, mA; with `amplitude` alone.")
    side: Literal["left", "right"] | None = Field(None, description="Of the stimulation, where the marker names none; null: both.")
    unit: Text = Field("", max_length=4, description="mA, uA, A, or V, which is no current; with `unit` alone.")
    lever_cm: Number | None = Field(None, ge=1, le=100, description="From a gyroscope's joint to the fingertip, cm; with `lever` alone.")


@dataclass(frozen=True, slots=True)
class QuestionOut(Question):
    """Marker or channel of a session's recordings, and what it means; null where it is not stated."""

    meaning: dict[str, Any] | None
    stated_by: str | None


class MeaningsOut(Model):
    """Questions of a session, and sentences about what a statement changed."""

    questions: list[QuestionOut]
    said: list[str] = []


def questions_of(db: Session, session: StudySession, caller: Caller) -> list[QuestionOut]:
    """List what the markers and channels of a session's recordings mean, first what is not known.

    Raises:
        Forbidden: the session is blinded for the caller, and markers would show what ran.
    """
    if not may_know(session.visit, caller):
        raise Forbidden("Markers of a blinded session show what ran.", "Explain them when the visit is unblinded.")
    known = repository.meanings(db, session.visit.participant.site.study_id)
    found: dict[str, QuestionOut] = {}
    for recording in _recordings(session):
        quality = recording.details.get("quality", {})
        asked = {q["key"]: q for q in quality.get("questions", ())}
        for key in [*asked, *quality.get("meanings", {})]:
            row = known.get(key)
            at = asked.get(key) or {"shown": row.shown if row else key, "count": 0, "asked": False}
            stated = row is not None and not row.removed
            asks: dict[str, Any] = {f.name: at.get(f.name) for f in fields(Question)} | {"key": key}
            found.setdefault(
                key,
                QuestionOut(
                    **asks,
                    meaning=dict(row.meaning) if stated and row else None,
                    stated_by=row.created_by if stated and row else None,
                ),
            )
    return list(found.values())


def state_meanings(db: Session, session: StudySession, answers: list[MeaningIn], reason: str, caller: Caller) -> list[str]:
    """State meanings for the study, and read the files of this session again by them. The caller commits.

    Returns:
        Sentences about what changed.

    Raises:
        Invalid: a meaning contradicts itself, or is of no marker of this session. Conflict: a visit of these recordings is locked.
    """
    participant = session.visit.participant
    require(caller, can.UPLOAD, participant)
    asked = {q.key: q for q in questions_of(db, session, caller)}
    study_id = participant.site.study_id
    repository.lock_meanings(db, study_id)
    repository.lock_participant(db, participant.id)
    known = repository.meanings(db, study_id)
    if reason.strip():
        set_reason(db, reason.strip())
    for one in answers:
        if one.key not in asked:
            raise Invalid(f"No marker or channel of session {session.id} has the key '{one.key}'.", "Load the page again.", field=one.key)
        before = known.get(one.key)
        meaning = _meaning(one) if one.means else {}
        if (before.meaning if before and not before.removed else {}) == meaning:
            continue
        db.add(
            SignalMeaning(
                study_id=study_id, key=one.key, version=before.version + 1 if before else 1, shown=asked[one.key].shown[:100],
                meaning=meaning or (before.meaning if before else {}), removed=not meaning, created_by=caller.label,
                reason=reason.strip() or None,
            )
        )  # fmt: skip
    db.flush()
    return _read_files_again(db, session, caller)


def _meaning(one: MeaningIn) -> dict[str, Any]:
    """Make the meaning as it is stored. Raises Invalid where it contradicts itself."""
    assert one.means is not None
    due = "unit" if one.key.startswith(CHANNEL_KEY) else "lever" if one.key.startswith(LEVER_KEY) else None
    if (due or one.means) != one.means or (due is None and one.means in ("unit", "lever")):
        what = "A channel has a unit, a gyroscope has a lever, and a marker has neither."
        raise Invalid(what, "State the unit of the channel, the lever of the gyroscope, or what the marker means.", field=one.key)
    try:
        meaning = Meaning(one.means, one.amplitude_ma, one.side, one.unit, one.lever_cm)
    except ValueError as error:
        raise Invalid(f"The meaning cannot be used: {error}.", "Correct it; nothing was changed.", field=one.key) from error
    fields = {
        "means": meaning.means,
        "amplitude_ma": meaning.amplitude_ma,
        "side": meaning.side,
        "unit": meaning.unit or None,
        "lever_cm": meaning.lever_cm,
    }
    return {name: value for name, value in fields.items() if value is not None}


def _read_files_again(db: Session, session: StudySession, caller: Caller) -> list[str]:
    """Read the participant's files again that the meanings change, a session's own first. Raises Conflict where its visit is locked."""
    own = {r.upload_file_id for r in _recordings(session) if r.upload_file_id is not None}
    meanings = repository.meanings_in_force(db, session.visit.participant.site.study_id)
    numbers = repository.readable_files(db, session.visit.participant_id, None)
    said: list[str] = []
    for file in [db.get_one(UploadFile, n) for n in sorted(numbers, key=lambda n: (n not in own, n))]:
        changes = any(redecode.explained_otherwise(r, meanings) for r in repository.recordings_of_file(db, file.id))
        if file.id not in own and not changes:
            continue
        sessions = repository.sessions_of_file(db, file.id)
        try:
            for one in sessions:
                require_unlocked(one.visit)
            read, doses = redecode.read_again(db, file, session.visit.participant, caller.label)
        except (Conflict, redecode.Refused) as error:
            if file.id in own:
                raise Conflict(f"The recording cannot be read by these meanings: {error}", "Nothing was changed.") from error
            said.append(f"file {file.id} was not read again: {error}")
            continue
        said += [*read, *doses]
        for one in sessions:
            if one.status == "proposed":
                renew(db, one)
    return said


def _recordings(session: StudySession) -> list[Recording]:
    return list(dict.fromkeys(s.recording for s in session.segments))


class MeaningsIn(Model):
    """Meanings of several markers and channels; without any the session's recordings are read again by those in force."""

    meanings: list[MeaningIn] = Field(max_length=100)
    reason: Text = Field("", max_length=1000)


@api.get("/sessions/{session_id}/markers")
def list_markers(session: CurrentSession, db: Db, caller: CurrentCaller) -> MeaningsOut:
    """List the markers and channels of a session's recordings that need an explanation or have one."""
    return MeaningsOut(questions=questions_of(db, session, caller))


@api.put("/sessions/{session_id}/markers", responses=problems(409))
def explain_markers(session: CurrentSession, body: MeaningsIn, db: Db, caller: CurrentCaller) -> MeaningsOut:
    """State what markers and channels mean, for every recording of the study; those of this session are read again at once.

    Files that come later are read by it; earlier ones by `betaloop ingest redecode`.
    """
    said = state_meanings(db, session, body.meanings, body.reason, caller)
    db.expire(session)
    return MeaningsOut(questions=questions_of(db, session, caller), said=said)


@pages.get("/sessions/{session_id}/markers")
def markers_page(request: Request, session: CurrentSession, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the markers of a session, and what each means."""
    return _page(request, db, session, caller)


@pages.post("/sessions/{session_id}/markers")
def explain(request: Request, session: CurrentSession, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """State what the form says; where it is refused the form comes back with the reason."""
    require(caller, can.UPLOAD, session.visit.participant)
    typed = {str(name): str(value).strip() for name, value in values.items()}
    try:
        questions = questions_of(db, session, caller)
        if not questions:
            raise Invalid("No recording of this session has a marker or a channel to explain.", "Nothing was changed.")
        given = _read_answers(questions, typed)
        state_meanings(db, session, given, typed.get("reason", "")[:1000], caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, db, session, caller, error, typed)
    return RedirectResponse(f"/sessions/{session.id}/markers?done=stated", 303)


def _read_answers(questions: list[QuestionOut], texts: dict[str, str]) -> list[MeaningIn]:
    """Read the meanings of a form. Raises Invalid naming the marker at fault."""
    given = []
    for i, question in enumerate(questions):
        unit = texts.get(f"unit-{i}", "")
        lever = texts.get(f"lever-{i}", "")
        means = "unit" if unit else "lever" if lever else texts.get(f"means-{i}", "")
        if not means and not question.meaning:
            continue
        fields = {"key": question.key, "means": means}
        if means == "amplitude":
            fields["amplitude_ma"] = texts.get(f"amplitude-{i}", "")
        fields |= {
            name: text for name, text in (("side", texts.get(f"side-{i}", "")), ("unit", unit), ("lever_cm", lever)) if text and means
        }
        whose = {name: f"{question.shown}, {name.split('_')[0]}" for name in fields}
        given.append(parse(MeaningIn, fields, whose))
    return given


def _page(
    request: Request,
    db: Session,
    session: StudySession,
    caller: Caller,
    error: BetaloopError | None = None,
    texts: dict[str, str] | None = None,
) -> HTMLResponse:
    participant = session.visit.participant
    asked = questions_of(db, session, caller)
    shown = {}
    for i, question in enumerate(asked):
        meaning = question.meaning or {}
        for name, value in (("means", meaning.get("means")), ("amplitude", meaning.get("amplitude_ma")), ("side", meaning.get("side")),
                            ("unit", meaning.get("unit")), ("lever", meaning.get("lever_cm"))):  # fmt: skip
            shown[f"{name}-{i}"] = "" if value is None else str(value)
    page = render(
        request,
        "ingest/markers.html",
        session=session,
        participant=participant,
        questions=asked,
        channel=CHANNEL_KEY,
        gyroscope=LEVER_KEY,
        labels={name: text for name, text in LABELS.items() if name not in ("unit", "lever")},
        units=AMPLITUDE_UNITS,
        typed={**shown, **(texts or {})},
        may_write=caller.may(can.UPLOAD, participant.site.study_id, participant.site_id),
        problem=error.problem(request.url.path) if error else None,
        remarks=field_notes(error, {}) if error else {},
    )
    return HTMLResponse(page, error.status if error else 200)
