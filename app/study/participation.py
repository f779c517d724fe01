"""Taking part: enrolment under a study code, withdrawal, the end of a site and a study."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import date
from enum import StrEnum
from itertools import pairwise
from typing import Literal

from pydantic import Field
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts import studies
from app.accounts.permissions import Caller
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Invalid, NotFound
from app.platform.jobs import service as jobs
from app.platform.web.schemas import Bool, Model, Text
from app.study import repository
from app.study.access import WITHDRAWN, refuse_ended, require
from app.study.margins import MarginsFields
from app.study.outcome_fields import SURE, require_sure
from app.study.schemas import Code
from app.study.settings import add_settings
from app.study.settings_types import SettingsIn
from app.tables.accounts import Site, Study
from app.tables.participants import MarginsVersion, Participant

# Study codes that may reveal a person. A code is questioned, never refused: only a person knows what it means.


class CodeQuestion(StrEnum):
    """Resemblance of a code to an identity."""

    NAME = "name"
    BIRTH_YEAR = "birth_year"
    BIRTH_DATE = "birth_date"


STUDY_WORDS = frozenset(
    {"adapt", "baseline", "beta", "case", "clinic", "cohort", "control", "ctrl", "demo", "east", "group", "main", "north", "part"}
    | {"participant", "patient", "person", "pilot", "practice", "proband", "random", "screen", "site", "south", "study", "subj"}
    | {"subject", "test", "training", "trial", "volunteer", "west"}
)
"""Words of four letters and more that studies number their participants with."""
_OLDEST, _YOUNGEST = 110, 15
_DIGITS = re.compile(r"\d+")


def questions(code: str, today: date) -> tuple[CodeQuestion, ...]:
    """List the questions about a code; empty for one that reveals nothing.

    A word with small letters after a capital (`JSmith`, `Lee`) or of four letters (`smith`, `ANNA`) looks like a name unless studies use it
    (STUDY_WORDS). Four digits that can be the birth year of a living person look like one (`P-1961`). So do eight digits that are such a
    date (`19610412`, `12041961`).

    Args:
        code: letters, digits, hyphens and underscores. today: from which ages are counted.
    """
    found = []
    if any(w.lower() not in STUDY_WORDS for w in _names(code)):
        found.append(CodeQuestion.NAME)
    numbers = _DIGITS.findall(code)
    if any(len(n) == 4 and _of_somebody(int(n), today) for n in numbers):
        found.append(CodeQuestion.BIRTH_YEAR)
    if any(len(n) == 8 and _is_birth_date(n, today) for n in numbers) or _written_date(code, today):
        found.append(CodeQuestion.BIRTH_DATE)
    return tuple(found)


def _names(code: str) -> list[str]:
    """Find runs of letters that can be names; a capital begins a new word within small letters, as in `JSmith`."""
    words = []
    for run in re.findall(r"[A-Za-z]+", code):
        if run.lower() in STUDY_WORDS:
            continue
        parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", run)
        mixed = not (run.isupper() or run.islower())
        words += [p for p in parts if (mixed and len(p) > 2 and p[0].isupper() and not p.isupper()) or len(p) > 3]
    return words


def _of_somebody(year: int, today: date) -> bool:
    return today.year - _OLDEST <= year <= today.year - _YOUNGEST


def _is_birth_date(digits: str, today: date) -> bool:
    orders = ((digits[:4], digits[4:6], digits[6:]), (digits[4:], digits[2:4], digits[:2]), (digits[4:], digits[:2], digits[2:4]))
    return any(_is_day(int(y), int(m), int(d), today) for y, m, d in orders)


def _written_date(code: str, today: date) -> bool:
    """Check whether three numbers that follow each other are a date, as in `12-04-1961`."""
    parts = re.split(r"[-_]", code)
    triples = zip(pairwise(parts), parts[2:], strict=False)
    written = ("".join([*pair, last]) for pair, last in triples)
    return any(text.isdecimal() and len(text) == 8 and _is_birth_date(text, today) for text in written)


def _is_day(year: int, month: int, day: int, today: date) -> bool:
    if not _of_somebody(year, today):
        return False
    try:
        date(year, month, day)
    except ValueError:
        return False
    return True


# Words of what is asked about a study code.

CODE_QUESTIONS = {
    CodeQuestion.NAME: "it holds a word that may be a name",
    CodeQuestion.BIRTH_YEAR: "it holds a year in which a participant may have been born",
    CodeQuestion.BIRTH_DATE: "it holds a date on which a participant may have been born",
}
CODE_HINT = "Choose a code that tells nothing about the person, or confirm that this is a study code."
CODE_CONFIRMED = "looked at by a person: a study code"


def code_questions(code: str, found: Iterable[CodeQuestion]) -> str:
    """Write the questions about a study code."""
    return f"The code '{code}' may tell who the participant is: {' and '.join(CODE_QUESTIONS[q] for q in found)}."


# API type of an enrolment.


class ParticipantIn(Model):
    """A participant to enrol."""

    code: Code
    is_study_code: Bool = Field(
        False, description="A person has looked at a code that resembles a name or holds a birth year or date: it is a study code."
    )
    site: Text | None = Field(
        None, max_length=81, description="Code of the site; needed when there are several. `STUDY/SITE` where two studies share a code."
    )
    synthetic: Bool = Field(False, description="A simulation and no person; fixed at enrolment. It alone takes logs of simulated devices.")
    settings: SettingsIn = Field(default_factory=SettingsIn)
    sure: list[Literal["cdbs_amplitude_ma"]] | None = Field(None, max_length=1, description=SURE)


# Enrolment. The caller commits.

RESERVED_CODES = {"new"}


def enrol(db: Session, draft: ParticipantIn, caller: Caller) -> Participant:
    """Add a participant with its first settings version and the default margins.

    Raises:
        Invalid: the code is a page's address, or has not the prefix of the study's codes. Or it looks like a person's identity and is not
            confirmed as a study code (see the problem's `questions`).
        Unusual: the cDBS amplitude is outside the usual, and not confirmed. Conflict: the code is taken, or the site has ended.
        NotFound: no such site. Forbidden: not the caller's to enrol.
    """
    if draft.code.lower() in RESERVED_CODES:
        raise Invalid(f"'{draft.code}' cannot be a participant's code: it is the address of a page.", "Choose another code.")
    site = _site(db, draft.site, caller)
    caller.require(can.WRITE_STUDY, site.study_id, site.id)
    refuse_ended(site)
    asked = questions(studies.require_own(db, site.study, draft.code), now().date())
    if asked and not draft.is_study_code:
        told = code_questions(draft.code, asked)
        raise Invalid(told, CODE_HINT, questions=[{"code": q.value, "text": CODE_QUESTIONS[q]} for q in asked])
    if asked:
        set_reason(db, CODE_CONFIRMED)
    require_sure(draft.settings.model_dump(exclude_unset=True), draft.sure)
    participant = Participant(site_id=site.id, code=draft.code, synthetic=draft.synthetic)
    db.add(participant)
    try:
        db.flush()
    except IntegrityError as error:
        db.rollback()
        raise Conflict(
            f"There is already a participant '{draft.code}' (capitals and small letters count as the same).", "Choose another code."
        ) from error
    add_settings(db, participant, draft.settings.model_dump(), caller, reason=None)
    participant.margins.append(MarginsVersion(version=1, created_by=caller.label, **MarginsFields().model_dump()))
    db.flush()
    return participant


def _site(db: Session, code: str | None, caller: Caller) -> Site:
    """Find the site of a code, or the only one at which the caller enrols."""
    readable = [s for s in repository.sites(db, caller) if code in (None, s.code, in_study(s))]
    if not readable:
        raise NotFound(f"There is no site '{code}', or you have no access to it.")
    sites = [s for s in readable if caller.may(can.WRITE_STUDY, s.study_id, s.id) and (code or not s.ended_at)] or readable
    if len(sites) == 1:
        return sites[0]
    raise Invalid("There are several sites.", f"Name one: {', '.join(map(in_study, sites))}.")


def in_study(site: Site) -> str:
    """Name a site by its study, for two studies may have sites of one code."""
    return f"{site.study.code}/{site.code}"


# API types of taking part.

Status = Literal["active", "completed", "withdrawn"]


class StatusChange(Model):
    """New status of a participant, and the reason."""

    status: Status
    reason: Text = Field(min_length=1, max_length=1000, description="Why; kept in the audit trail.")


# Rules of taking part. The caller commits.


def change_status(db: Session, participant: Participant, change: StatusChange, caller: Caller) -> Participant:
    """Say that a participant has completed the study, has withdrawn, or takes part again.

    Nothing is deleted. A withdrawn participant is no longer listed among those who take part. New data, plans, jobs and controllers are
    refused, and running jobs are cancelled.

    Raises:
        NotFound, Forbidden: as `require`.
    """
    require(caller, can.WRITE_STUDY, participant)
    if participant.status == change.status:
        return participant
    set_reason(db, change.reason)
    participant.status = change.status
    db.flush()
    if change.status == WITHDRAWN:
        for job in jobs.live_of(db, participant.id):
            jobs.cancel(db, job, caller.label)
    return participant


# Rules of ending studies and sites. The caller commits.


def end_study(db: Session, study: Study, reason: str, caller: Caller) -> None:
    """End a study: it is read and exported, nothing in it changes, and it is not on Today. Its jobs that run are cancelled.

    Who may what is asked at every call (`Grant.holds`), so that it holds at once for whatever people have open.

    Raises:
        Conflict: it has ended already.
    """
    studies.set_ended(db, study, True, reason)
    for participant_id in repository.participants_of_study(db, study.id):
        for job in jobs.live_of(db, participant_id):
            jobs.cancel(db, job, caller.label)


def reopen_study(db: Session, study: Study, reason: str) -> None:
    """Open a study that has ended; its sites are as they were. Raises Conflict where it has not."""
    studies.set_ended(db, study, False, reason)


def end_site(db: Session, study: Study, code: str, reason: str) -> None:
    """End a site: it takes neither enrolments nor uploads; all else goes on. Raises NotFound, Conflict."""
    studies.set_ended(db, studies.site_of(db, study, code), True, reason)


def reopen_site(db: Session, study: Study, code: str, reason: str) -> None:
    """Open a site that has ended. Raises NotFound, Conflict."""
    studies.set_ended(db, studies.site_of(db, study, code), False, reason)
