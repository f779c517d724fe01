"""Worklist of Today: what waits for a person in the whole study, by kind, and the visits whose day is not complete."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.overview import repository
from app.overview.repository import VisitCounts
from app.platform.numbers import counted
from app.tables.data_queries import QueryState
from app.tables.participants import Participant
from app.tables.visits import Visit

MOST_NAMED = 8
"""Participants of one line that are named; more are counted."""
RECENT = dt.timedelta(days=60)
"""How long a past visit stays on the board."""
MOST_VISITS = 12
"""Past visits on the board."""


@dataclass(frozen=True)
class Kind:
    """A kind of work.

    Attributes:
        needs: permission to do it. page: address where it is done, with the participant's code or the key of the row.
        words: what is to be done, around the number. one, many: the noun. tone: of its badge.
    """

    needs: str
    page: str
    words: str
    one: str
    many: str = ""
    tone: str = ""

    def text(self, number: int) -> str:
        """Return what is to be done, for so many."""
        return self.words.format(counted(number, self.one, self.many))


_EVENTS, _QUERIES = "/participants/{code}/adverse-events", "/participants/{code}/data-queries"
SERIOUS = Kind(can.CLEAR_EVENT, _EVENTS, "Clear {}", "serious adverse event", tone="bad")
STOPS = Kind(can.CLEAR_EVENT, _EVENTS, "Clear {} for the participant's sake", "early stop", tone="bad")
QUARANTINE = Kind(can.DECIDE_QUARANTINE, "/participants/{code}/quarantine", "Decide on {} in quarantine", "file", tone="warn")
MARGINS = Kind(can.SET_MARGINS, "/participants/{code}/margins", "Lock margins before {}", "planned visit", tone="warn")
SIGN = Kind(can.SIGN_PLAN, "/participants/{code}/plans", "Sign {}", "visit plan", tone="warn")
ANSWER = Kind(can.WRITE_STUDY, _QUERIES, "Answer {}", "data query", "data queries", tone="warn")
LOGS = Kind(can.UPLOAD, "/visits/{key}/slots", "Upload {}", "late log", tone="warn")
CONFIRM = Kind(can.WRITE_STUDY, "/participants/{code}/proposals", "Confirm {}", "proposed session")
OUTCOMES = Kind(can.WRITE_QOC, "/participants/{code}/visits", "Enter outcomes of {}", "session")
CLOSE = Kind(can.ASK_QUERIES, _QUERIES, "Close {}", "answered data query", "answered data queries")


@dataclass(frozen=True)
class Place:
    """A participant that a line is about: how often, and where it is done; empty where the reader may not open that page."""

    code: str
    count: int
    url: str


@dataclass(frozen=True)
class Line:
    """One kind of work with its participants.

    Attributes:
        text: what is to be done. tone: of its badge. places: those named. more: participants not named. since: the oldest, if known.
    """

    text: str
    tone: str
    places: tuple[Place, ...]
    more: int
    since: dt.datetime | None


@dataclass(frozen=True)
class Worklist:
    """Lines in order of urgency: `own` is what the reader may do, `others` waits for other roles."""

    own: tuple[Line, ...]
    others: tuple[Line, ...]


def worklist(db: Session, caller: Caller, today: dt.date) -> Worklist:
    """Collect what waits. Ten statements, whatever the size of the study; nothing of pages that are closed to the reader."""
    own: list[Line] = []
    others: list[Line] = []
    for kind, rows in _rows(db, caller, today):
        readable = [r for r in rows if caller.may_open(kind.page.format(code=r[1], key=r[0]), r[2], r[3])]
        mine = [r for r in readable if caller.may(kind.needs, r[2], r[3])]
        theirs = [r for r in rows if r not in mine] if not caller.is_blinded else []
        for target, found in ((own, mine), (others, theirs)):
            if found:
                target.append(_line(kind, found, caller))
    return Worklist(tuple(own), tuple(others))


def _rows(db: Session, caller: Caller, today: dt.date) -> Iterable[tuple[Kind, list[Any]]]:
    events = list(repository.events_to_clear(db, caller))
    yield SERIOUS, [r for r in events if r[0]]
    yield STOPS, [r for r in events if not r[0]]
    yield QUARANTINE, list(repository.files_in_quarantine(db, caller))
    yield MARGINS, list(repository.margins_to_lock(db, caller, today))
    yield SIGN, list(repository.plans_to_sign(db, caller))
    queries = list(repository.queries_not_closed(db, caller))
    yield ANSWER, [r for r in queries if r[0] == QueryState.OPEN]
    yield LOGS, list(repository.late_logs(db, caller, today))
    yield CONFIRM, list(repository.sessions_to_confirm(db, caller))
    yield OUTCOMES, list(repository.sessions_without_outcomes(db, caller))
    yield CLOSE, [r for r in queries if r[0] == QueryState.ANSWERED]


def _line(kind: Kind, rows: Sequence[Any], caller: Caller) -> Line:
    rows = sorted(rows, key=lambda r: (-r[4], r[1]))
    places = []
    for key, code, study_id, site_id, count, _ in rows[:MOST_NAMED]:
        url = kind.page.format(code=code, key=key)
        places.append(Place(code, count, url if caller.may_open(url, study_id, site_id) else ""))
    since = min((r[5] for r in rows if r[5] is not None), default=None)
    return Line(kind.text(sum(r[4] for r in rows)), kind.tone, tuple(places), len(rows) - len(places), since)


# The status board: how far plan, files, outcomes, doses and lock of a visit are.


@dataclass(frozen=True)
class Mark:
    """State of one part of a visit: a tone (good, warn, bad, or empty where nothing is due), its words, and where it is changed."""

    tone: str
    text: str
    url: str = ""


COLUMNS = ("Plan", "Files", "Outcomes", "Doses", "Lock")


@dataclass(frozen=True)
class BoardRow:
    """A visit on the board with its marks, one per column; of a visit to come only that of the plan."""

    visit: Visit
    code: str
    marks: tuple[Mark, ...]

    @property
    def due(self) -> bool:
        """True if more than the plan is due."""
        return len(self.marks) > 1


def board(db: Session, caller: Caller, coming: Sequence[Participant], today: dt.date) -> list[BoardRow]:
    """List visits of the last `RECENT`, unlocked ones rather than locked ones, then the next visit of each of `coming`, by date."""
    rows: list[tuple[Visit, str, bool]] = [(*row,) for row in repository.latest_visits(db, caller, today - RECENT, today, MOST_VISITS)]
    codes = {p.id: p.code for p in coming}
    rows += [(visit, codes[visit.participant_id], False) for visit in repository.visits_to_come(db, list(codes), today)]
    rows.sort(key=lambda row: (row[0].date or today, row[1]))
    counts = repository.visit_counts(db, [visit.id for visit, _, _ in rows])
    return [BoardRow(visit, code, marks(counts[visit.id], visit, code, today, locked=locked)) for visit, code, locked in rows]


def marks(counts: VisitCounts, visit: Visit, code: str, today: dt.date, *, locked: bool) -> tuple[Mark, ...]:
    """Return the marks of a visit, in the order of `COLUMNS`; before its day only the plan is due."""
    home = f"/visits/{visit.id}"
    plan = {"approved": Mark("good", "signed", f"{home}/plan"), "draft": Mark("warn", "to sign", f"{home}/plan")}.get(counts.plan or "")
    begun = counts.sessions or counts.proposed or counts.doses
    if visit.date is None or visit.date > today or (visit.date == today and not begun):
        return (plan or Mark("warn", "none", f"{home}/plan"),)
    lock = Mark("good", "locked", home) if locked else Mark("warn", "open", home)
    doses = Mark("good", counted(counts.doses, "dose"), home) if counts.doses else Mark("warn", "none", home)
    return plan or Mark("", "none"), _files(counts, home, code), _outcomes(counts, home), doses, lock


def _files(counts: VisitCounts, home: str, code: str) -> Mark:
    if counts.proposed:
        return Mark("warn", f"{counts.proposed} to confirm", f"/participants/{code}/proposals")
    if counts.filled < counts.slots:
        return Mark("bad", f"{counts.filled} of {counts.slots}", f"{home}/slots")
    if not counts.sessions:
        return Mark("bad", "no session", f"/participants/{code}/upload")
    return Mark("good", counted(counts.sessions, "session"), home)


def _outcomes(counts: VisitCounts, home: str) -> Mark:
    if not counts.sessions:
        return Mark("", "—")
    return Mark("warn", f"{counts.without_outcomes} missing", home) if counts.without_outcomes else Mark("good", "complete", home)


# The first steps of an installation without a participant, each with its page.

FIRST_STEPS = (
    ("Name the study and its sites", "/studies"),
    ("Add an account for each person, with a role", "/accounts"),
    ("Enrol the first participant, with the cDBS amplitude", "/participants/new"),
    ("Add the participant's first visit", ""),
    ("Upload that visit's recordings, and confirm the sessions they hold", ""),
)
"""Text and address; those without one have no page yet."""
