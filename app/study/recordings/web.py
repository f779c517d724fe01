"""HTML page of the data that devices keep besides sessions."""

from __future__ import annotations

from dataclasses import asdict

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from app.platform.database import Db
from app.platform.web.schemas import problems
from app.platform.web.templates import render
from app.study.deps import CurrentParticipant
from app.study.recordings import facts
from app.study.recordings.facts import DeviceEventOut, DeviceHistoryOut, DeviceSpectrumOut, TherapyGroupOut, TrendOut
from app.study.recordings.history import History, history_of
from app.study.recordings.history_charts import charts_of

# The history of a device as an API type.


def history_out(history: History) -> DeviceHistoryOut:
    """Convert one report to the schema."""
    return DeviceHistoryOut(
        recording_id=history.recording.id,
        device=history.recording.device.pseudonym,
        reported_at=history.recording.started_at,
        trends=[TrendOut(**asdict(t)) for t in history.trends],
        snapshots=[DeviceSpectrumOut(**asdict(s)) for s in history.snapshots],
        surveys=[DeviceSpectrumOut(**asdict(s)) for s in history.surveys],
        groups=[TherapyGroupOut.model_validate(asdict(g)) for g in history.groups],
        events=[DeviceEventOut(**asdict(e)) for e in history.events],
        battery_percent=history.battery_percent,
        battery_months=history.battery_months,
    )


# REST route of what devices keep besides sessions.

api = APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))


@api.get("/participants/{code}/device-history")
def device_history(participant: CurrentParticipant, db: Db) -> list[DeviceHistoryOut]:
    """Return trends, spectra, therapy groups and events from the participant's devices, the newest report first."""
    hidden = facts.sealed_days(db, participant.id)
    return [history_out(history_of(r, hidden)) for r in facts.histories(db, participant.id)]


pages = APIRouter()


@pages.get("/participants/{code}/device-history")
def device_history_page(request: Request, participant: CurrentParticipant, db: Db, report: str = "") -> HTMLResponse:
    """Show the newest report's history, or that of the recording `report`."""
    recordings = facts.histories(db, participant.id)
    chosen = next((r for r in recordings if str(r.id) == report), recordings[0] if recordings else None)
    history = history_of(chosen, facts.sealed_days(db, participant.id)) if chosen is not None else None
    page = render(
        request,
        "study/device_history.html",
        participant=participant,
        recordings=recordings,
        history=history,
        charts=charts_of(history) if history else [],
    )
    return HTMLResponse(page)
