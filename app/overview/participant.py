"""The page of a participant: where the study stands, its visits, and the five metrics of every controller against cDBS."""

from __future__ import annotations

from datetime import UTC, datetime

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.analysis.evidence.service import evidence
from app.analysis.metrics import service as analysis
from app.analysis.metrics.charts import view
from app.overview import state, wording
from app.overview.story import story_chart
from app.platform.database import Db
from app.platform.web.templates import render
from app.study import repository as study
from app.study.blinding import visible_arm
from app.study.characteristics.service import fields_of
from app.study.deps import CurrentParticipant
from app.study.wording import characteristics_words

router = APIRouter()


@router.get("/participants/{code}")
def participant_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """One participant."""
    visits, _ = study.visits(db, participant.id, 1000, 0)
    sessions = study.sessions_of_participant(db, participant.id)
    held = evidence(db, participant, caller)
    page = render(
        request,
        "overview/participant.html",
        participant=participant,
        settings=participant.current_settings,
        state=state.states(db, [participant], datetime.now(UTC).date())[participant.id],
        phases=state.PHASES,
        what=wording.what,
        characteristics=characteristics_words(fields_of(participant.current_characteristics)),
        actors=wording.ACTORS,
        progress=wording.progress,
        days=[(v, [(s, visible_arm(s, caller)) for s in sessions if s.visit_id == v.id]) for v in visits],
        minutes=sum(s.duration_s for s in sessions) / 60,
        story=story_chart(held, visits, participant.settings),
        analysis=view(analysis.five_metrics(db, participant, caller, held)),
        may_write=caller.may(can.WRITE_STUDY, participant.site.study_id, participant.site_id),
    )
    return HTMLResponse(page)
