"""Search: participants by code, sessions by number, policies by name, jobs by number or kind; within what the caller may read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.overview import repository
from app.platform.database import Db
from app.platform.jobs import registry
from app.platform.web.numbers import when
from app.platform.web.schemas import Text
from app.platform.web.templates import render

router = APIRouter()

MOST = 20
"""Of each kind of thing that a page of results names."""


@dataclass(frozen=True)
class Hit:
    """One thing that was found: its name, what tells it from others, and its page."""

    name: str
    about: str
    url: str


def search(db: Session, caller: Caller, words: str) -> dict[str, list[Hit]]:
    """What the words name, by kind; a participant's code before another word narrows policies, jobs and sessions to that participant."""
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


@router.get("/search")
def search_page(request: Request, db: Db, caller: CurrentCaller, q: Annotated[Text, Query(max_length=100)] = "") -> Response:
    """What was found; a single hit opens at once."""
    found = search(db, caller, q)
    every: Sequence[Hit] = [hit for hits in found.values() for hit in hits]
    if len(every) == 1:
        return RedirectResponse(every[0].url, 303)
    return HTMLResponse(render(request, "overview/search.html", q=q, found=found, most=MOST))
