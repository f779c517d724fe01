"""Energy that learned controllers have saved so far against the cDBS amplitude, over the minutes that they ran; description, no test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.analysis.evidence.service import of_all
from app.analysis.pooled.service import readable
from app.platform.database import Db
from app.platform.web.templates import render
from app.study.deps import ResultsViewed
from app.study.service import withdrawn_codes
from app.tables.participants import Participant
from app.tables.sessions import Controller

router = APIRouter()

LEARNED = (Controller.RL, Controller.DISTILLED)


@dataclass(frozen=True)
class Saved:
    """What learned controllers saved in one participant.

    Attributes:
        share: 1 less the mean of a^2 over the sessions' minutes, a being the fraction of the cDBS amplitude of the controlled side; below 0
            where they spent more. minutes, sessions: of theirs with a known energy.
    """

    participant: str
    share: float
    minutes: float
    sessions: int


def energy_saved(db: Session, participants: Sequence[Participant], caller: Caller) -> list[Saved]:
    """Participants with sessions of learned controllers that the caller may know of and that count."""
    found = []
    for held in of_all(db, participants, caller):
        ran = [s for s in held.sessions if s.controller in LEARNED and "energy" in s.values]
        seconds = sum(s.duration_s for s in ran)
        if seconds > 0:
            spent = sum(s.values["energy"] * s.duration_s for s in ran) / seconds
            found.append(Saved(held.participant, 1 - spent, seconds / 60, len(ran)))
    return found


def overall(saved: Sequence[Saved]) -> Saved | None:
    """All participants together, weighted by minutes; None without any."""
    minutes = sum(s.minutes for s in saved)
    if not minutes:
        return None
    return Saved("", sum(s.share * s.minutes for s in saved) / minutes, minutes, sum(s.sessions for s in saved))


@router.get("/energy-saved", dependencies=[ResultsViewed])
def energy_saved_page(request: Request, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Energy saved so far; the home page takes its numbers from here once it stands."""
    participants = readable(db, caller)
    saved = energy_saved(db, participants, caller)
    page = render(request, "overview/energy_saved.html", saved=saved, overall=overall(saved), withdrawn=withdrawn_codes(participants))
    return HTMLResponse(page)
