"""The page of a participant: where the study stands, its visits, and the five metrics of every controller against cDBS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from markupsafe import Markup
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.analysis.evidence.service import Evidence, evidence
from app.analysis.metrics import service as analysis
from app.analysis.metrics.charts import view
from app.analysis.standing import standing_sentences
from app.evaluation.ranking import service as ranking
from app.evaluation.ranking.staleness import stale_reasons
from app.evaluation.what_next import what_next
from app.overview import state, wording
from app.overview.story import story_chart
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.kept import kept
from app.platform.web.charts import Chart
from app.platform.web.templates import render
from app.study import repository as study
from app.study.characteristics.service import fields_of
from app.study.deps import CurrentParticipant, ResultsViewed
from app.study.service import may
from app.study.visits.service import days_of
from app.study.wording import characteristics_words
from app.tables.participants import Participant, SettingsVersion
from app.tables.visits import Visit

router = APIRouter()


@router.get("/participants/{code}", dependencies=[ResultsViewed])
def participant_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """One participant."""
    visits, _ = study.visits(db, participant.id, 1000, 0)
    sessions = study.sessions_for_lists(db, participant.id)
    held = evidence(db, participant, caller)
    page = render(
        request,
        "overview/participant.html",
        participant=participant,
        settings=participant.current_settings,
        state=state.states(db, [participant], datetime.now(UTC).date())[participant.id],
        phases=state.PHASES,
        answer=_answer(db, participant, caller),
        standings=standing_sentences(db, participant, caller, every=False),
        what=wording.what,
        characteristics=characteristics_words(fields_of(participant.current_characteristics)),
        actors=wording.ACTORS,
        progress=wording.progress,
        days=days_of(visits, sessions, caller),
        minutes=sum(s.duration_s for s in sessions) / 60,
        story=_story(held, visits, participant.settings),
        analysis=view(analysis.five_metrics(db, participant, caller, held), held.key),
        may_write=caller.may(can.WRITE_STUDY, participant.site.study_id, participant.site_id),
    )
    return HTMLResponse(page)


@dataclass(frozen=True)
class _Answer:
    """What to test next, in the ranking's own words; whether they are of data that have changed since."""

    words: Markup
    stale: bool


def _answer(db: Session, participant: Participant, caller: Caller) -> _Answer | None:
    """None before the first ranking, and for blinded assessors, to whom rankings are closed."""
    if caller.is_blinded:
        return None
    try:
        found = ranking.current(db, participant, caller)
    except NotFound:
        return None
    words = what_next(found, may_run=may(caller, can.RUN_JOBS, participant))
    return _Answer(words, bool(stale_reasons(db, participant, found.evaluation, found.sessions)))


def _story(held: Evidence, visits: Sequence[Visit], versions: Sequence[SettingsVersion]) -> Chart | None:
    """The months on one axis, kept while none of what they are made of has changed."""
    key = ("story", held.key, tuple((v.id, v.date) for v in visits), tuple((v.version, v.created_at) for v in versions))
    today = datetime.now(UTC).date()
    return kept((*key, today), lambda: story_chart(held, visits, versions, today))
