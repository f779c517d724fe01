"""Enrolment. The caller commits."""

from __future__ import annotations

from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts import studies
from app.accounts.permissions import Caller
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Invalid, NotFound
from app.study import repository
from app.study.access import refuse_ended
from app.study.enrolment import codes, words
from app.study.enrolment.schemas import ParticipantIn
from app.study.margins.schemas import MarginsFields
from app.study.settings.service import add_settings
from app.study.usual.questions import require_sure
from app.tables.accounts import Site
from app.tables.participants import MarginsVersion, Participant

RESERVED_CODES = {"new"}


def enrol(db: Session, draft: ParticipantIn, caller: Caller) -> Participant:
    """Add a participant with its first settings version and the default margins.

    Raises:
        Invalid: the code is a page's address, lacks the prefix of the study's codes or has another's, or looks like somebody's identity and
            nobody said that it is a study code (the problem's `questions` say what it looks like).
        Unusual: the cDBS amplitude is outside the usual, and nobody is sure of it. Conflict: the code is taken, or the site has ended.
        NotFound: no such site. Forbidden: not the caller's to enrol.
    """
    if draft.code.lower() in RESERVED_CODES:
        raise Invalid(f"'{draft.code}' cannot be a participant's code: it is the address of a page.", "Choose another code.")
    site = _site(db, draft.site, caller)
    caller.require(can.WRITE_STUDY, site.study_id, site.id)
    refuse_ended(site)
    asked = codes.questions(studies.require_own(db, site.study, draft.code), now().date())
    if asked and not draft.is_study_code:
        told = words.code_questions(draft.code, asked)
        raise Invalid(told, words.CODE_HINT, questions=[{"code": q.value, "text": words.CODE_QUESTIONS[q]} for q in asked])
    if asked:
        set_reason(db, words.CODE_CONFIRMED)
    require_sure(draft.settings.model_dump(exclude_unset=True), draft.sure)
    participant = Participant(site_id=site.id, code=draft.code)
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
    """The site of a code, or the only one at which the caller enrols."""
    readable = [s for s in repository.sites(db, caller) if code in (None, s.code, in_study(s))]
    if not readable:
        raise NotFound(f"There is no site '{code}', or you have no access to it.")
    sites = [s for s in readable if caller.may(can.WRITE_STUDY, s.study_id, s.id) and (code or not s.ended_at)] or readable
    if len(sites) == 1:
        return sites[0]
    raise Invalid("There are several sites.", f"Name one: {', '.join(map(in_study, sites))}.")


def in_study(site: Site) -> str:
    """A site by its study, for two studies may have sites of one code."""
    return f"{site.study.code}/{site.code}"
