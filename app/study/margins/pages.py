"""HTML page of a participant's margins and levels."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.platform.database import Db
from app.platform.errors import BetaloopError
from app.platform.web.forms import FormValues, field_notes, parse, renamed
from app.platform.web.templates import render
from app.study.access import may
from app.study.deps import CurrentParticipant
from app.study.form_changes import Shown, own_changes, reason_of
from app.study.margins import service, sign_off
from app.study.margins.schemas import MarginsIn, MarginsLockFields
from app.study.settings.form import SettingField, SettingGroup, history, texts
from app.tables.participants import Participant
from ml.outcomes import OUTCOMES

router = APIRouter()

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
            SettingField("unsafe_beyond", "Beyond a margin with", "Probability that any outcome lies beyond its margin.", "probability"),
            SettingField("nearly_off_share", "Nearly off in", "Largest share of steps below 0.2 of the cDBS amplitude.", "of steps"),
        ),
    ),
)
LABELS = {f.name: f.label for group in GROUPS for f in group.fields}
_LOCK_FIELDS = {"version": "version", "reason": "lock_reason"}


@router.get("/participants/{code}/margins")
def margins(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Present margins and levels, each explained, and the versions before."""
    return _page(request, db, participant, caller, texts(participant.current_margins, LABELS))


@router.post("/participants/{code}/margins")
def change_margins(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Make a new version of what the form changes."""
    before = participant.current_margins.version
    seen = str(values["version"]) if "version" in values else None
    shown = [Shown(v.version, texts(v, LABELS), v.created_by) for v in participant.margins]
    changes = own_changes(values, seen, shown, LABELS)
    try:
        changes.refuse_conflicts()
        change = parse(MarginsIn, changes.fields, LABELS)
        row = service.change_margins(db, participant, change, reason_of(values) or "", caller)
    except BetaloopError as error:
        db.rollback()
        typed = texts(participant.current_margins, LABELS) | changes.fields
        return _page(request, db, participant, caller, typed, error, reason_of(values))
    return RedirectResponse(f"/participants/{participant.code}/margins?done={'changed' if row.version != before else 'same'}", 303)


@router.post("/participants/{code}/margins/lock")
def lock_margins(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Lock the present margins, signed."""
    typed = {name: str(values.get(field, "")) for name, field in _LOCK_FIELDS.items()}
    try:
        wanted = parse(MarginsLockFields, typed, {"reason": "What the margins rest on"})
        password, code = str(values.get("password", "")), str(values.get("code", ""))
        service.lock_margins(db, participant, wanted.version, wanted.reason, caller, password, code)
    except BetaloopError as error:
        db.rollback()
        shown = texts(participant.current_margins, LABELS)
        return _page(request, db, participant, caller, shown, renamed(error, _LOCK_FIELDS), lock_reason=typed["reason"])
    return RedirectResponse(f"/participants/{participant.code}/margins?done=locked", 303)


def _page(
    request: Request,
    db: Session,
    participant: Participant,
    caller: Caller,
    values: dict[str, str],
    error: BetaloopError | None = None,
    reason: str | None = None,
    lock_reason: str = "",
) -> HTMLResponse:
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
        lock_meaning=sign_off.MEANING,
        lock_signatures=sign_off.signatures_of_locks(db, participant),
        may_write=may(caller, can.SET_MARGINS, participant),
        remarks=field_notes(error, values | {"lock_reason": lock_reason}),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
