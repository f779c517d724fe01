"""The page of the clinic day: for a tablet, and as a plain form where scripts or encryption are missing.

Its address is its own (`/visit-day/...`), because a service worker rules over everything below its address: this page and nothing else.
"""

from __future__ import annotations

import hashlib
import uuid
from functools import lru_cache
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from pydantic import TypeAdapter, ValidationError
from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.planning.visit_day import service, wording
from app.planning.visit_day.record import (
    ASKED,
    ASKED_BY_KIND,
    MANY,
    DeviceTime,
    contradictions,
    last_attempt,
    open_severe,
    outcomes_of,
    standing,
    state_of,
)
from app.planning.visit_day.schemas import (
    AdverseEventPayload,
    DosePayload,
    EntryIn,
    GradePayload,
    NotePayload,
    Nothing,
    ReasonPayload,
    StopCausePayload,
)
from app.planning.visit_day.screening import rules
from app.planning.visit_day.serializers import day_out
from app.platform.database import Db, now
from app.platform.errors import BetaloopError, Invalid, NotFound
from app.platform.web.forms import FormValues, field_notes, parse, renamed
from app.platform.web.schemas import Model
from app.platform.web.templates import STATIC, render
from app.study.adverse_event_types import EVENT_KINDS
from app.study.deps import CurrentVisit, VisitViewed
from app.study.doses import DRUG_NAMES
from app.tables.adverse_events import EventKind
from app.tables.visits import Visit

router = APIRouter()

FILES = STATIC / "visit-day"
_ENTRY: TypeAdapter[Any] = TypeAdapter(EntryIn)


class _When(Model):
    """Time when a dose was taken, where the form states it."""

    taken_at: DeviceTime | None = None


_PAYLOADS: dict[str, type[Model]] = {
    "start": Nothing, "stop": Nothing, "session_end": Nothing, "clinical_settings": Nothing, "stop_cause": StopCausePayload,
    **{one.kind: one.payload for one in ASKED}, "dyskinesia": GradePayload, "speech": GradePayload, "gait": GradePayload,
    "note": NotePayload, "skip": ReasonPayload, "repeat": ReasonPayload, "adverse_event": AdverseEventPayload,
    "dose": DosePayload,
}  # fmt: skip
_EVENT_FIELDS = {"kind": "kind_of_event"}
"""What the form of an adverse event calls a field of its payload."""
_LABELS = {
    "kind": "Adverse event",
    "severity": "Severity",
    "note": "What happened",
    **{field: label for one in ASKED for field, label in one.labels.items()},
    "grade": "Grade",
    "text": "Note",
    "reason": "Reason",
    "cause": "Cause",
    "drug": "Drug",
    "mg": "Dose",
    "taken_at": "Taken at",
}


@router.get("/visit-day/shell")
def shell(request: Request) -> HTMLResponse:
    """Show the page without any data, which the service worker shows without a network; what it shows is read on the tablet."""
    return HTMLResponse(render(request, "planning/visit_day/shell.html", **_frame()))


@router.get("/visit-day/worker.js")
def worker() -> Response:
    """Serve the service worker; from here it controls only `/visit-day/`."""
    return FileResponse(FILES / "worker.js", media_type="text/javascript", headers={"Cache-Control": "no-cache"})


@router.get("/visit-day/files/{path:path}")
def file(path: Annotated[str, Path(pattern=r"^[0-9a-f]{10}/[a-z-]+\.(js|css)$")]) -> Response:
    """Serve a script or style of the page. Scripts import one another by name, so that the version is in their folder's name."""
    version, name = path.split("/")
    if version != _version() or name not in _names():
        raise NotFound("There is no such file of this version.", "Load the page again.")
    return FileResponse(FILES / name, headers={"Cache-Control": "public, max-age=31536000, immutable"})


@router.get("/visit-day/key")
def key(caller: CurrentCaller) -> JSONResponse:
    """Return the key with which the tablet encrypts the caller's entries until they are sent."""
    found = service.device_key(caller)
    return JSONResponse({"owner": found.owner, "name": caller.label, "key": found.key, "until": found.until.isoformat()})


@router.get("/visit-day/{visit_id}", dependencies=[VisitViewed])
def visit_day(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the clinic day of a visit."""
    return HTMLResponse(_page(request, db, visit, caller))


@router.post("/visit-day/{visit_id}")
def enter(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Add one entry from the plain form."""
    try:
        entry, plan_id = _entry(values)
        result = service.add_entries(db, visit, plan_id, [entry], caller)[0]
        if result.outcome == "refused":
            raise Invalid(result.detail, result.hint, **({"field": result.field} if result.field else {}))
    except BetaloopError as error:
        db.rollback()
        shown = renamed(error, _EVENT_FIELDS) if values.get("kind") == "adverse_event" else error
        return HTMLResponse(_page(request, db, visit, caller, shown, values), error.status)
    chosen = f"?session={entry.plan_item_id}" if entry.plan_item_id is not None and entry.kind not in ("session_end", "skip") else ""
    return RedirectResponse(f"/visit-day/{visit.id}{chosen}", 303)


def _entry(values: FormData) -> tuple[Any, int]:
    """Parse the form to the API's type, and the plan that it was about."""
    kind = str(values.get("kind", ""))
    if kind not in _PAYLOADS:
        raise Invalid(f"'{kind}' is nothing that can be entered.", "Load the page again.")
    texts = {k: str(v) for k, v in values.items()} | dict(ASKED_BY_KIND[kind].form if kind in ASKED_BY_KIND else {})
    payload = parse(_PAYLOADS[kind], texts | _event(texts) if kind == "adverse_event" else texts, _LABELS)
    numbers = {name: _number(texts.get(name, "")) for name in ("plan_item_id", "attempt", "plan_id")}
    replaces = [u for u in texts.get("replaces", "").split() if u]
    if kind in ("note", "adverse_event") and texts.get("no_names_ok"):
        payload = payload.model_copy(update={"no_names": texts["no_names_ok"].split()})
    taken_at = parse(_When, texts, _LABELS).taken_at if kind == "dose" else None
    draft = {
        "uuid": texts.get("uuid", ""), "kind": kind, "plan_item_id": numbers["plan_item_id"], "attempt": numbers["attempt"],
        "payload": payload.model_dump(), "device_time": taken_at or now(), "clock_offset_ms": 0, "replaces": replaces,
    }  # fmt: skip
    try:
        return _ENTRY.validate_python(draft), numbers["plan_id"] or 0
    except ValidationError as error:
        raise Invalid("This entry cannot be used: " + "; ".join(e["msg"] for e in error.errors()) + ".", "Load the page again.") from error


def _event(texts: dict[str, str]) -> dict[str, str]:
    """Convert an adverse event to the names of its payload: the form has one choice for severe and serious."""
    serious = texts.get("severity") == "serious"
    return {
        "kind": texts.get("kind_of_event", ""),
        "severity": "severe" if serious else texts.get("severity", ""),
        "serious": "yes" if serious else "no",
    }


def _number(text: str) -> int | None:
    return int(text) if text.isdecimal() and len(text) < 10 else None


def _page(
    request: Request, db: Session, visit: Visit, caller: Caller, error: BetaloopError | None = None, values: FormData | None = None
) -> str:
    day = service.read_day(db, visit, caller)
    shown = day_out(day, caller)
    states = {slot.plan_item_id: state_of(day.entries, slot.plan_item_id) for slot in shown.slots}
    typed = {name: str(value) for name, value in values.items()} if values else {}
    wanted = _number(request.query_params.get("session", "") or typed.get("plan_item_id", ""))
    unfinished = (slot for slot in shown.slots if states[slot.plan_item_id] not in ("done", "skipped"))
    current = next((s for s in shown.slots if s.plan_item_id == wanted), None) or next(unfinished, None)
    attempt = last_attempt(day.entries, current.plan_item_id) if current else 1
    said = standing(day.entries)
    mine = [e for e in said if current and (e.plan_item_id, e.attempt) == (current.plan_item_id, attempt)]
    note = typed.get("text") or typed.get("note") or ""
    return render(
        request,
        "planning/visit_day/day.html",
        participant=visit.participant,
        visit=visit,
        day=shown,
        current=current,
        attempt=attempt,
        states=states,
        state_names=wording.DAY_STATES,
        outcome=outcomes_of(day.entries).get(current.plan_item_id) if current else None,
        latest={e.kind: e for e in mine if e.kind not in MANY},
        contradictions=[wording.contradiction(c, shown.slots) for c in contradictions(day.entries)],
        severe=open_severe(day.entries),
        confirmed=[e for e in said if e.kind == "clinical_settings" and e.plan_item_id is None],
        new_id=lambda: str(uuid.uuid4()),
        typed=typed,
        remarks=field_notes(error, typed),
        name_words=" ".join(service.words_like_names(note)),
        problem=error.problem(request.url.path) if error else None,
        **_frame(),
    )


def _frame() -> dict[str, Any]:
    """Return what the page and the shell need of their files."""
    folder = f"/visit-day/files/{_version()}"
    return {
        "folder": folder,
        "modules": [n for n in _names() if n.endswith(".js") and n != "worker.js"],
        "note_rules": rules(),
        "event_kinds": [(k.value, n) for k, n in EVENT_KINDS.items() if k is not EventKind.STOPPED],
        "drugs": list(DRUG_NAMES.items()),
        "drug_names": DRUG_NAMES,
    }


def _names() -> tuple[str, ...]:
    return tuple(sorted(p.name for p in FILES.iterdir() if p.suffix in (".js", ".css")))


def _version() -> str:
    return _hash(tuple((name, (FILES / name).stat().st_mtime_ns) for name in _names()))


@lru_cache(maxsize=8)
def _hash(files: tuple[tuple[str, int], ...]) -> str:
    digest = hashlib.sha256()
    for name, _changed in files:
        digest.update(name.encode() + b"\0" + (FILES / name).read_bytes())
    return digest.hexdigest()[:10]
