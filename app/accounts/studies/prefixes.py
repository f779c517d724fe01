"""Prefixes of participants' codes of a study: a user who enrols in one study never learns which codes another has.

Codes are unique in an installation, because addresses name participants by them. Every study but the first has a prefix of its own, none
the beginning of another's. A code is compared with these before it is looked up, so that "taken" refers to the own study alone.
"""

from __future__ import annotations

from sqlalchemy.orm import Session

from app.accounts.studies import repository
from app.accounts.studies.schemas import Prefix
from app.platform.errors import Conflict, Invalid
from app.tables.accounts import Study

LONGEST = 20


def default_of(code: str) -> str:
    """Choose the prefix of a study for which none is stated. Raises Invalid for a code that is too long."""
    prefix = code.replace(".", "-") + "-"
    if len(prefix) > LONGEST:
        raise Invalid(f"'{prefix}' is too long to begin participants' codes with.", f"State a prefix of at most {LONGEST} characters.")
    return prefix


def claim(db: Session, study: Study, prefix: Prefix) -> None:
    """Give a study without a prefix one. Until then no participant is enrolled.

    Raises:
        Conflict: it has one, one of another study begins with this or the other way round, or codes of another study begin with it.
    """
    if study.code_prefix is not None:
        raise Conflict(f"Codes of study '{study.code}' begin with '{study.code_prefix}', and participants are known by them.", "Keep it.")
    repository.lock_codes(db, exclusively=True)
    lower = prefix.lower()
    for _, code, theirs in repository.prefixes(db):
        if lower.startswith(theirs.lower()) or theirs.lower().startswith(lower):
            raise Conflict(f"'{prefix}' and the prefix '{theirs}' of study '{code}' cannot be told apart.", "Choose another.")
    if repository.codes_elsewhere(db, study.id, prefix):
        raise Conflict(f"Codes of another study's participants begin with '{prefix}'.", "Choose another prefix.")
    study.code_prefix = prefix
    db.flush()


def require_own(db: Session, study: Study, code: str) -> str:
    """Return what follows the study's prefix in the code of a participant to enrol; until the transaction ends no study claims a prefix.

    Raises:
        Invalid: the code has not this study's prefix, or has another one's. No participant is looked up for it.
    """
    repository.lock_codes(db, exclusively=False)
    known = {number: prefix for number, _, prefix in repository.prefixes(db)}
    prefix = known.pop(study.id, "")
    if prefix and not (code.lower().startswith(prefix.lower()) and len(code) > len(prefix)):
        raise Invalid(f"Participants' codes of study '{study.code}' begin with '{prefix}'.", f"Choose one such as {prefix}1.")
    if any(code.lower().startswith(theirs.lower()) for theirs in known.values()):
        raise Invalid(f"'{code}' begins as codes of another study do.", "Choose a code that begins otherwise.")
    return code[len(prefix) :]
