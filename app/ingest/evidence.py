"""Guesses about a recording by plain rules, each with its evidence. A person confirms or corrects them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from enum import StrEnum
from typing import Any

from app.study.sessions.stimulation import Course, Delivered, Pattern, course
from app.tables.sessions import Controller
from app.tables.visits import Visit


class Source(StrEnum):
    """Source of a value of a proposal."""

    UPLOAD = "upload"
    """The sender, with the upload."""
    PERSON = "person"
    """A person who corrected the proposal; `by` names them."""
    CUT = "cut"
    """A person who cut a recording into sessions."""
    RECORDING = "recording"
    """A rule that looked at the recording."""


class Reason(StrEnum):
    """Reason for a value; behind each the facts that a sentence about it needs."""

    STATED = "stated"
    """`by`, of a person; `open` where they left the value open."""
    DAY_OF_VISIT = "day_of_visit"
    """`day`, `visit`."""
    NO_DATE = "no_date"
    SEVERAL_VISITS = "several_visits"
    """`day`, `visits`: how many."""
    NO_VISIT_OF_DAY = "no_visit_of_day"
    """`day`."""
    AMPLITUDE = "amplitude"
    """`courses`: one per side, as `Course.as_json`."""
    LOG = "log"
    """`policy`: name of the participant's policy that the controller's log names."""
    SLOT = "slot"
    """`visit`, `position`: of the signed plan's session that the controller's log names. `stated`: another visit, which the upload says and
    which is not taken, for the plan's key is sealed."""
    OTHER_VISIT = "other_visit"
    """`stated`: visit of the upload; `visit`, `position`: of the session that the log names."""
    SURVEY = "survey"
    """`recording`; `montages`: how many sets of sensing contacts it went through."""
    CHANNEL = "channel"
    """`stream`, `channel`; `lead` where known; `usable`: its usable steps when it was chosen; `passed`: channels that were not taken, each
    with `why` and `usable`."""
    PROGRAM = "program"
    """`program`; `programs`: every one of the control recording, with `number`, `how`, `low`, `high` (mA or fraction)."""
    UNREADABLE = "unreadable"
    """`detail`."""
    RECORDED_SIDE = "recorded_side"
    NO_SIDE = "no_side"
    CUT_OUT = "cut_out"
    """`session`: of the proposal that was cut."""


@dataclass(frozen=True)
class Evidence:
    """Evidence for one value of a proposal. `app.ingest.wording` puts it in words."""

    source: Source
    reason: Reason
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stated(self) -> bool:
        """True where a person stated it, so that no guess replaces it."""
        return self.source is not Source.RECORDING

    def as_json(self) -> dict[str, Any]:
        """Convert the evidence for storage."""
        return {"source": self.source, "reason": self.reason, "facts": dict(self.facts)}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Evidence:
        """Read evidence as it was stored."""
        return cls(Source(stored["source"]), Reason(stored["reason"]), stored["facts"])


BY_UPLOAD = Evidence(Source.UPLOAD, Reason.STATED)
BY_CUT = Evidence(Source.CUT, Reason.STATED)


@dataclass(frozen=True)
class VisitGuess:
    """The visit that a recording belongs to; `open`: it is only a place to store it until a person says which."""

    visit: Visit
    open: bool
    why: Evidence


def guess_visit(visits: Sequence[Visit], day: date | None, stated: Visit | None, today: date | None = None) -> VisitGuess:
    """Guess the visit: the stated one, else the one on the recording's day, else an open place in the newest one that has taken place.

    Args:
        visits: of the participant, by number; at least one.
        day: on which the recording was made, by the clock of the place where its file states it.
    """
    if stated is not None:
        return VisitGuess(stated, False, BY_UPLOAD)
    same = [v for v in visits if v.date == day] if day is not None else []
    if len(same) == 1:
        return VisitGuess(same[0], False, _recorded(Reason.DAY_OF_VISIT, day, visit=same[0].number))
    today = today or datetime.now(UTC).date()
    past = [v for v in visits if v.date is None or v.date <= today]
    place = (past or list(visits))[-1]
    if day is None:
        return VisitGuess(place, True, Evidence(Source.RECORDING, Reason.NO_DATE))
    if len(same) > 1:
        return VisitGuess(same[0], True, _recorded(Reason.SEVERAL_VISITS, day, visits=len(same)))
    return VisitGuess(place, True, _recorded(Reason.NO_VISIT_OF_DAY, day))


def _recorded(reason: Reason, day: date | None, **facts: int) -> Evidence:
    return Evidence(Source.RECORDING, reason, {"day": str(day), **facts})


def guess_controller(sides: Sequence[Delivered]) -> tuple[Controller | None, Evidence]:
    """Guess the controller, and why: no DBS where no side was stimulated, cDBS where every side is constant at its cDBS amplitude, else
    open.

    Args:
        sides: of all recordings of the session. One whose amplitude is not known leaves the controller open.
    """
    courses = [course(side) for side in sides]
    why = Evidence(Source.RECORDING, Reason.AMPLITUDE, {"courses": [c.as_json() for c in courses]})
    return agreed(courses), why


def agreed(courses: Sequence[Course]) -> Controller | None:
    """Find the controller that every side speaks for; None where they do not agree, or leave it open."""
    guesses = {c.controller for c in courses}
    return guesses.pop() if len(guesses) == 1 else None


def stored_courses(facts: Mapping[str, Any]) -> list[Course]:
    """Read the courses of the amplitude in stored evidence."""
    return [Course(**{**c, "pattern": Pattern(c["pattern"])}) for c in facts["courses"]]
