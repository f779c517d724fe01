"""The button that downloads a participant's data package."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from markupsafe import Markup
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.accounts.repository import studies
from app.analysis import metrics as analysis
from app.analysis.evidence import Evidence, evidence
from app.analysis.metrics_charts import view
from app.analysis.pooled import outlines, overall
from app.analysis.pooled_web import Summed
from app.analysis.standing import standing_sentences
from app.evaluation.ranking import service as ranking
from app.evaluation.ranking.staleness import stale_reasons
from app.evaluation.ranking.verdict_wording import what_next
from app.overview import repository, state, worklist
from app.overview.package import export_participant
from app.overview.state import State
from app.overview.story import story_chart
from app.platform.database import Db
from app.platform.errors import NotFound
from app.platform.jobs import registry
from app.platform.kept import kept
from app.platform.numbers import when
from app.platform.web.charts import Chart
from app.platform.web.schemas import PagingQuery, Text
from app.platform.web.templates import Part, make_part, render
from app.settings import get_settings
from app.study import repository as study
from app.study.access import may, withdrawn_codes
from app.study.characteristics import characteristics_words, fields_of
from app.study.deps import CurrentParticipant, ResultsViewed
from app.study.visits import days_of
from app.tables.participants import Participant, SettingsVersion
from app.tables.visits import Visit

# The first screen of the demo: questions to begin with, each with the page that answers it. No other installation shows it.


@dataclass(frozen=True)
class Offer:
    """A question with the page that answers it, and what one finds there."""

    question: str
    url: str
    found: str


def offers(participants: Sequence[Participant], states: Mapping[int, State]) -> list[Offer]:
    """Choose the questions that the study can answer by now: fewer while its participants still arrive.

    Args:
        states: of these participants, by their id.
    """
    known = {p.code: states[p.id] for p in participants if p.id in states}
    planned = {code: state.planned_visits[-1] for code, state in known.items() if state.planned_visits}
    found = []
    if "P1" in known:
        ranked = known["P1"].evaluated_at is not None
        what = "Ranked from three visits." if ranked else "Three visits so far. Its first policies are trained and ranked while you look."
        found.append(Offer("What would you test at P1's next visit?", "/participants/P1/ranking", what))
    if "P2" in planned:
        what = "Its plan is signed, with a bundle for each session."
        found.append(Offer("Walk P2's clinic day", f"/visit-day/{planned['P2'].visit_id}", what))
    if "P3" in planned:
        what = "Learned controllers ran beside cDBS at four visits."
        found.append(Offer("Does P3 save energy without loss?", "/participants/P3/analyses", what))
    if "P4" in planned:
        what = "Each ranking against the visits that followed it."
        found.append(Offer("Did the predictions for P4 come true?", "/participants/P4/calibration", what))
    if known:
        found.append(Offer("Who did what, and when?", "/audit", "Every change, in words, with the person who made it."))
    return found


# Study-wide pages: the overview of all participants, and the audit trail.

pages = APIRouter()

REFRESH_S = 5
SOON = 12
"""Number of next visits that are shown; later ones are a fold away."""


@pages.get("/")
def overview(
    request: Request, db: Db, caller: CurrentCaller, paging: PagingQuery, withdrawn: Annotated[str, Query(max_length=3)] = "no"
) -> HTMLResponse:
    """Show what waits for the reader, visits as a status board, and all participants as cards, those that need attention marked."""
    rows, total = study.participants(db, caller, paging.limit, paging.offset, withdrawn=withdrawn == "yes")
    today = datetime.now(UTC).date()
    # of the whole study: a participant seen tomorrow may be on another page of participants
    coming = study.next_visits(db, caller, today, withdrawn=withdrawn == "yes")
    states = state.states(db, list(dict.fromkeys([*rows, *coming])), today)
    page = render(
        request,
        "overview/overview.html",
        participants=[(p, states[p.id]) for p in rows],
        coming=[(p, states[p.id]) for p in coming],
        soon=SOON,
        today=today,
        work=worklist.worklist(db, caller, today),
        board=worklist.board(db, caller, coming[:SOON], today),
        board_columns=worklist.COLUMNS,
        waiting={p.code: states[p.id].blocked_by for p in coming},
        first_steps=worklist.FIRST_STEPS,
        what=state.what,
        actors=state.ACTORS,
        progress=state.progress,
        in_days=state.in_days,
        total=total,
        demo=get_settings().demo,
        offers=offers(rows, states) if get_settings().demo else [],
        withdrawn=withdrawn == "yes",
        paging=paging,
        phases=state.PHASES,
        refresh_s=REFRESH_S,
        studies=[s for s in studies(db) if caller.may(can.READ, s.id) and (withdrawn == "yes" or s.ended_at is None)],
    )
    return HTMLResponse(page)


# The page of a participant: the state of the study, its visits, and the five metrics of every controller against cDBS.


@pages.get("/participants/{code}", dependencies=[ResultsViewed])
def participant_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show one participant."""
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
        what=state.what,
        characteristics=characteristics_words(fields_of(participant.current_characteristics)),
        actors=state.ACTORS,
        progress=state.progress,
        days=days_of(visits, sessions, caller),
        minutes=sum(s.duration_s for s in sessions) / 60,
        story=_story(held, visits, participant.settings),
        analysis=view(analysis.five_metrics(db, participant, caller, held), held.key),
        may_write=caller.may(can.WRITE_STUDY, participant.site.study_id, participant.site_id),
    )
    return HTMLResponse(page)


@dataclass(frozen=True)
class _Answer:
    """Words of the ranking on what to test next, whether the data have changed since, and the visit that one button drafts."""

    words: Markup
    stale: bool
    suggested: Any


def _answer(db: Session, participant: Participant, caller: Caller) -> _Answer | None:
    """Return None before the first ranking, and for blinded assessors, to whom rankings are closed."""
    if caller.is_blinded:
        return None
    try:
        found = ranking.current(db, participant, caller)
    except NotFound:
        return None
    words = what_next(found, may_run=may(caller, can.RUN_JOBS, participant))
    suggested = make_part(Part.SUGGESTED_VISIT, db, participant, caller, found)
    return _Answer(words, bool(stale_reasons(db, participant, found.evaluation, found.sessions)), suggested)


def _story(held: Evidence, visits: Sequence[Visit], versions: Sequence[SettingsVersion]) -> Chart | None:
    """Plot the months on one axis, cached while none of its inputs has changed."""
    key = ("story", held.key, tuple((v.id, v.date) for v in visits), tuple((v.version, v.created_at) for v in versions))
    today = datetime.now(UTC).date()
    return kept((*key, today), lambda: story_chart(held, visits, versions, today))


# Energy that learned controllers have saved so far.


@pages.get("/energy-saved", dependencies=[ResultsViewed])
def energy_saved_page(request: Request, participants: Summed, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the energy saved so far; the home page takes its numbers from here once it is loaded."""
    saved = [outline.saved for outline in outlines(db, participants, caller) if outline.saved is not None]
    page = render(request, "overview/energy_saved.html", saved=saved, overall=overall(saved), withdrawn=withdrawn_codes(participants))
    return HTMLResponse(page)


# Search: participants by code, sessions by number, policies by name, jobs by number or kind; within what the caller may read.

MOST = 20
"""Of each kind of thing that a page of results names."""


@dataclass(frozen=True)
class Hit:
    """One thing that was found: its name, what distinguishes it, and its page."""

    name: str
    about: str
    url: str


def search(db: Session, caller: Caller, words: str) -> dict[str, list[Hit]]:
    """Search what the words name, by kind; a participant's code first narrows policies, jobs and sessions to that participant."""
    whole = words.strip()
    first, _, rest = whole.partition(" ")
    owner = repository.participant_id_of_code(db, caller, first) if rest else None
    wanted = rest.strip() if owner is not None else whole
    if not wanted:
        return {}
    number = re.fullmatch(r"(?:session )?#?(\d{1,9})", wanted, re.IGNORECASE)
    titles = {k.name: k.title for k in registry.kinds().values()}
    kinds = [name for name, title in titles.items() if wanted.lower() in title.lower() or wanted.lower() == name]
    gone = repository.withdrawn_codes(db, caller)

    def of(code: str) -> str:
        return f"{code} (withdrawn)" if code in gone else code

    found = {
        "Participants": [
            Hit(p.code, f"{p.site.name}, withdrawn" if p.code in gone else p.site.name, f"/participants/{p.code}")
            for p in repository.find_participants(db, caller, whole, MOST)
        ],
        "Sessions": [
            Hit(f"Session {i}", f"{of(code)}, visit {visit}, {when(day)}", f"/sessions/{i}")
            for i, code, visit, day in (repository.find_session(db, caller, int(number[1]), owner) if number else ())
        ],
        "Policies": [
            Hit(name, f"{of(code)}, {kind}", f"/participants/{code}/policies/{i}")
            for i, name, kind, code in repository.find_policies(db, caller, wanted, owner, MOST)
        ],
        "Jobs": [
            Hit(titles.get(kind, kind), f"{of(code)}, {status}, {when(made)}", f"/jobs/{i}")
            for i, kind, status, made, code in repository.find_jobs(db, caller, wanted, kinds, owner, MOST)
        ],
    }
    return {kind: hits for kind, hits in found.items() if hits}


@pages.get("/search")
def search_page(request: Request, db: Db, caller: CurrentCaller, q: Annotated[Text, Query(max_length=100)] = "") -> Response:
    """Show what was found; a single hit opens at once."""
    found = search(db, caller, q)
    every: Sequence[Hit] = [hit for hits in found.values() for hit in hits]
    if len(every) == 1:
        return RedirectResponse(every[0].url, 303)
    return HTMLResponse(render(request, "overview/search.html", q=q, found=found, most=MOST))


@pages.get("/participants/{code}/export.zip")
def data_package(participant: CurrentParticipant, db: Db, caller: CurrentCaller) -> Response:
    """Download everything of a participant as a Frictionless data package."""
    content = export_participant(db, participant, caller)
    return Response(
        content, media_type="application/zip", headers={"Content-Disposition": f'attachment; filename="{participant.code}.zip"'}
    )
