"""HTML page of a participant's margins and levels."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, field_notes, parse, renamed
from app.platform.web.schemas import problems
from app.platform.web.templates import render
from app.study import margins as margins_rules
from app.study.access import may
from app.study.deps import CurrentParticipant
from app.study.margins import (
    ConfirmationFields,
    ConfirmationIn,
    ConfirmationOut,
    MarginsChange,
    MarginsIn,
    MarginsLockFields,
    MarginsLockIn,
    MarginsLockOut,
    MarginsOut,
    confirmation_rows,
    lock_rows,
)
from app.study.settings_form import SettingField, SettingGroup, Shown, history, own_changes, reason_of, texts
from app.tables.participants import Participant
from ml.outcomes import OUTCOMES

# REST routes of margins and levels.

api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@api.get("/participants/{code}/margins")
def list_margins(participant: CurrentParticipant) -> list[MarginsOut]:
    """List all versions of the margins within which an outcome counts as no worse than under cDBS, oldest first; the last one applies."""
    return [MarginsOut.model_validate(version) for version in participant.margins]


@api.put("/participants/{code}/margins", responses=problems(409))
def change_margins(participant: CurrentParticipant, change: MarginsChange, db: Db, caller: CurrentCaller) -> MarginsOut:
    """Change margins or levels: a new version; omitted members keep their value. Only for those who approve plans."""
    row = margins_rules.change_margins(db, participant, change.margins, change.reason, caller)
    return MarginsOut.model_validate(row)


@api.get("/participants/{code}/margins/locks")
def list_margins_locks(participant: CurrentParticipant, db: Db) -> list[MarginsLockOut]:
    """List the locks of the margins, oldest first; the last one applies. Verdicts confirm only with sessions recorded after it."""
    return lock_rows(db, participant)


@api.post("/participants/{code}/margins/locks", status_code=201, responses=problems(409, 429))
def lock_margins(participant: CurrentParticipant, wanted: MarginsLockIn, db: Db, caller: CurrentCaller) -> MarginsLockOut:
    """Lock the present margins before the sessions that they will judge, signed over their values. Those who approve plans alone."""
    margins_rules.lock_margins(db, participant, wanted.version, wanted.reason, caller, wanted.password, wanted.code)
    return lock_rows(db, participant)[-1]


@api.get("/participants/{code}/confirmations")
def list_confirmations(participant: CurrentParticipant, db: Db) -> list[ConfirmationOut]:
    """List declared confirmations, oldest first: all later sessions of their policies confirm, whatever is planned."""
    return confirmation_rows(db, participant)


@api.post("/participants/{code}/confirmations", status_code=201, responses=problems(409, 429))
def declare_confirmation(participant: CurrentParticipant, body: ConfirmationIn, db: Db, caller: CurrentCaller) -> ConfirmationOut:
    """Declare the confirmation of a policy by the locked margins, signed once. Those who approve plans alone."""
    margins_rules.declare(db, participant, body, caller, body.password, body.code)
    return confirmation_rows(db, participant)[-1]


pages = APIRouter()

GROUPS = (
    SettingGroup(
        "Margins: no worse than under cDBS",
        tuple(SettingField(m.field, m.label, m.help, m.form_unit) for m in (o.margin for o in OUTCOMES)),
    ),
    SettingGroup(
        "When a policy is worth a test",
        (
            SettingField("test_within", "Within all margins with", "Probability from which a test is proposed.", "probability"),
            SettingField("test_saves", "Saves energy with", "Probability of using less energy than cDBS.", "probability"),
        ),
    ),
    SettingGroup(
        "When a policy is unsafe",
        (
            SettingField("unsafe_beyond", "Harm with", "Probability that any outcome is beyond twice its margin.", "probability"),
            SettingField("nearly_off_share", "Nearly off in", "Largest share of steps below 0.2 of the cDBS amplitude.", "of steps"),
        ),
    ),
)
LABELS = {f.name: f.label for group in GROUPS for f in group.fields}
_CONFIRMATION_FIELDS = {"policy_id": "policy_id", "reason": "confirmation_reason"}
_LOCK_FIELDS = {"version": "version", "reason": "lock_reason"}


@pages.get("/participants/{code}/margins")
def margins(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Present margins and levels, each explained, and the versions before."""
    return _page(request, db, participant, caller, texts(participant.current_margins, LABELS))


@pages.post("/participants/{code}/margins")
def change_margins_by_form(
    request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues
) -> Response:
    """Make a new version of what the form changes."""
    before = participant.current_margins.version
    seen = str(values["version"]) if "version" in values else None
    shown = [Shown(v.version, texts(v, LABELS), v.created_by) for v in participant.margins]
    changes = own_changes(values, seen, shown, LABELS)
    try:
        changes.refuse_conflicts()
        change = parse(MarginsIn, changes.fields, LABELS)
        row = margins_rules.change_margins(db, participant, change, reason_of(values) or "", caller)
    except BetaloopError as error:
        db.rollback()
        typed = texts(participant.current_margins, LABELS) | changes.fields
        return _page(request, db, participant, caller, typed, error, reason_of(values))
    return RedirectResponse(f"/participants/{participant.code}/margins?done={'changed' if row.version != before else 'same'}", 303)


@pages.post("/participants/{code}/margins/lock")
def lock_margins_by_form(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Lock the present margins, signed."""
    typed = {name: str(values.get(field, "")) for name, field in _LOCK_FIELDS.items()}
    try:
        wanted = parse(MarginsLockFields, typed, {"reason": "What the margins rest on"})
        password, code = str(values.get("password", "")), str(values.get("code", ""))
        margins_rules.lock_margins(db, participant, wanted.version, wanted.reason, caller, password, code)
    except BetaloopError as error:
        db.rollback()
        shown = texts(participant.current_margins, LABELS)
        return _page(request, db, participant, caller, shown, renamed(error, _LOCK_FIELDS), lock_reason=typed["reason"])
    return RedirectResponse(f"/participants/{participant.code}/margins?done=locked", 303)


@pages.post("/participants/{code}/margins/confirmations")
def declare_by_form(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Declare the confirmation of a policy, signed."""
    typed = {name: str(values.get(field, "")) for name, field in _CONFIRMATION_FIELDS.items()}
    try:
        wanted = parse(ConfirmationFields, typed, {"policy_id": "Policy", "reason": "Why this policy"})
        margins_rules.declare(db, participant, wanted, caller, str(values.get("password", "")), str(values.get("code", "")))
    except BetaloopError as error:
        db.rollback()
        shown = texts(participant.current_margins, LABELS)
        return _page(request, db, participant, caller, shown, renamed(error, _CONFIRMATION_FIELDS), confirmation=typed)
    return RedirectResponse(f"/participants/{participant.code}/margins?done=declared", 303)


def _page(
    request: Request,
    db: Session,
    participant: Participant,
    caller: Caller,
    values: dict[str, str],
    error: BetaloopError | None = None,
    reason: str | None = None,
    lock_reason: str = "",
    confirmation: dict[str, str] | None = None,
) -> HTMLResponse:
    confirmation = confirmation or dict.fromkeys(_CONFIRMATION_FIELDS, "")
    page = render(
        request,
        "study/margins.html",
        participant=participant,
        current=participant.current_margins,
        values=values,
        reason=reason,
        groups=GROUPS,
        history=history(participant.margins, LABELS),
        lock_reason=lock_reason,
        lock_meaning=margins_rules.MEANING,
        lock_signatures=margins_rules.signatures_of_locks(db, participant),
        may_write=may(caller, can.SET_MARGINS, participant),
        declared=confirmation_rows(db, participant),
        declarable=margins_rules.policies_of(db, participant),
        confirmation=confirmation,
        confirmation_meaning=margins_rules.CONFIRMED,
        remarks=field_notes(error, values | {"lock_reason": lock_reason, "confirmation_reason": confirmation["reason"]}),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
