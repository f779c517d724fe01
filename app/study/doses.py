"""Doses of medication with their times, and how long before a session the last one was."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, time, timedelta
from typing import Literal, NamedTuple

from pydantic import Field
from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import now, set_reason
from app.platform.errors import Conflict, Invalid, NotFound
from app.platform.web.schemas import Model, Moment, Number, Text
from app.study import access
from app.study.repository import visit
from app.study.visits import require_unlocked
from app.tables.sessions import StudySession
from app.tables.visits import Dose, Drug, Visit

# The drugs that can be named: a fixed list, so that no free text of a prescription enters.
#
# Levodopa equivalents per mg: Tomlinson et al. 2010 (Movement Disorders 25, 2649), where they give one. What Jost et al. 2023 (Movement
# Disorders 38, 1236) propose for later drugs such as safinamide is not used: such a drug has no equivalent here. Forms without a name of
# their own are `other`: no equivalent, and no time since it, rather than those of another form. They are prolonged-release agonists, whose
# effect hardly wanes within a visit; selegiline under the tongue, which counts eight times as much; tolcapone; levodopa gel.


@dataclass(frozen=True)
class DrugFacts:
    """Facts of a drug.

    Attributes:
        name: as pages show it.
        equivalent: mg of levodopa that 1 mg counts as; None where none is stated.
        within_hours: its effect on symptoms rises and wanes within hours of a dose, so that the time since that dose says something.
    """

    name: str
    equivalent: float | None
    within_hours: bool


DRUGS: dict[Drug, DrugFacts] = {
    Drug.LEVODOPA: DrugFacts("Levodopa (carbidopa, benserazide)", 1.0, True),
    Drug.LEVODOPA_CR: DrugFacts("Levodopa, controlled release", 0.75, True),
    Drug.LEVODOPA_COMT: DrugFacts("Levodopa with entacapone", 1.33, True),
    Drug.LEVODOPA_EQUIVALENT: DrugFacts("All of a time together, as levodopa equivalent", 1.0, True),
    Drug.APOMORPHINE: DrugFacts("Apomorphine", 10.0, True),
    Drug.PRAMIPEXOLE: DrugFacts("Pramipexole (salt), immediate release", 100.0, True),
    Drug.ROPINIROLE: DrugFacts("Ropinirole, immediate release", 20.0, True),
    Drug.ROTIGOTINE: DrugFacts("Rotigotine, mg per 24 h", 30.0, False),  # a patch: its level hardly changes over a visit
    Drug.SELEGILINE: DrugFacts("Selegiline, swallowed tablet", 10.0, False),
    Drug.RASAGILINE: DrugFacts("Rasagiline", 100.0, False),
    Drug.SAFINAMIDE: DrugFacts("Safinamide", None, False),
    Drug.AMANTADINE: DrugFacts("Amantadine", 1.0, False),
    Drug.ANTICHOLINERGIC: DrugFacts("Anticholinergic", None, False),
    Drug.MUSCLE_RELAXANT: DrugFacts("Muscle relaxant", None, False),
    Drug.OTHER: DrugFacts("Other", None, False),
}


def levodopa_equivalent_mg(drug: Drug, mg: float) -> float | None:
    """Convert a dose to mg of levodopa; None where no equivalent is stated."""
    factor = DRUGS[drug].equivalent
    return None if factor is None else factor * mg


# Words of doses.

DRUG_NAMES = {drug.value: facts.name for drug, facts in DRUGS.items()}


def doses_words(doses: Iterable[Dose]) -> str:
    """Write taken doses in words, by time."""
    return "; ".join(f"{d.taken_at:%Y-%m-%d %H:%M} {DRUGS[Drug(d.drug)].name} {d.mg:g} mg" for d in doses)


# API types of doses.


class DoseIn(Model):
    """A dose that was taken."""

    drug: Drug = Field(description="`levodopa_equivalent`: everything taken at that time together, as mg of levodopa.")
    mg: Number = Field(gt=0, le=5000, description="Of the active drug, mg; of levodopa combinations the levodopa (100 of a 25/100 tablet).")
    taken_at: Moment = Field(description="Without an offset it is UTC. Within three days before the visit, or on its day.")


class DoseRemoval(Model):
    """Reason why a recorded dose is removed."""

    reason: Text = Field(min_length=1, max_length=1000, description="Kept in the audit trail, as is the dose.")


class DoseOut(Model):
    """A dose that was taken."""

    id: int
    visit_id: int
    drug: Drug
    mg: float
    levodopa_equivalent_mg: float | None = Field(description="Null where no equivalent is stated for the drug.")
    counts_for_time: bool = Field(description="Whether the time since it counts: its effect comes and goes within hours.")
    taken_at: datetime
    entered_by: str
    created_at: datetime


# Queries of doses, within what the caller may read.


def dose_with_visit(db: Session, dose_id: int, caller: Caller) -> tuple[Dose, Visit]:
    """Load a dose that was not removed, and its visit. Raises NotFound."""
    row = db.scalar(select(Dose).where(Dose.id == dose_id, Dose.removed_at.is_(None)))
    gone = f"There is no dose {dose_id}, or you have no access to it."
    if row is None:
        raise NotFound(gone)
    try:
        return row, visit(db, row.visit_id, caller)
    except NotFound:
        raise NotFound(gone) from None


# Rules of doses. The caller commits.

_BEFORE, _AFTER = timedelta(days=3), timedelta(hours=36)
"""Range of a dose's time: from three days before the visit's day to that day's end in the westernmost time zone, in UTC."""
_AHEAD = timedelta(minutes=10)
"""Time by which the clock of the person who enters a dose may be ahead."""


def add_dose(db: Session, visit: Visit, draft: DoseIn, caller: Caller) -> Dose:
    """Write down a dose that was taken.

    Raises:
        Forbidden: the caller enters no data. Conflict: the visit is locked, the participant has withdrawn, or the dose is there already;
            what else was done in the transaction stays.
        Invalid: a time that is not near the visit's day, or has not come yet.
    """
    access.require(caller, can.WRITE_STUDY, visit.participant)
    access.refuse_withdrawn(visit.participant)
    require_unlocked(visit)
    _check_time(visit, draft.taken_at)
    row = Dose(visit_id=visit.id, entered_by=caller.label, **draft.model_dump())
    try:
        with db.begin_nested():
            db.add(row)
    except IntegrityError as error:
        raise Conflict(
            f"{DRUGS[draft.drug].name} at {draft.taken_at:%Y-%m-%d %H:%M} UTC is written down at this visit already.",
            "Two tablets at one time are one dose: remove the one that is there, and enter both together.",
            field="taken_at",
        ) from error
    db.refresh(visit, ["doses"])
    return row


def remove_dose(db: Session, dose: Dose, visit: Visit, reason: str, caller: Caller) -> None:
    """Take back a dose that was not taken so.

    Raises:
        Forbidden: the caller enters no data. Conflict: the visit is locked. Invalid: no reason.
    """
    access.require(caller, can.WRITE_STUDY, visit.participant)
    require_unlocked(visit)
    if not reason.strip():
        raise Invalid("A reason is missing.", "Say why the dose is taken back; the audit trail keeps it.", field="reason")
    set_reason(db, reason.strip())
    dose.removed_at = now()
    db.flush()
    db.refresh(visit, ["doses"])


def _check_time(visit: Visit, taken_at: datetime) -> None:
    if taken_at > now() + _AHEAD:
        words = f"{taken_at:%Y-%m-%d %H:%M} UTC has not come yet."
        raise Invalid(words, "Doses are written down when they were taken. Times are UTC.", field="taken_at")
    if visit.date is None:
        return
    day = datetime.combine(visit.date, time(), UTC)
    if not day - _BEFORE <= taken_at <= day + _AFTER:
        raise Invalid(
            f"{taken_at:%Y-%m-%d %H:%M} UTC is not near visit {visit.number} of {visit.date}.",
            "Give a time on its day or in the three days before, in UTC.",
            field="taken_at",
        )


# How long before a session the last dose was: the one place that says it, to pages, analyses, snapshots and the record that leaves.

LONGEST_H = 72.0
APART_H = 0.25
"""Difference between a stated time and the doses above which a question is asked, h."""


class SinceDose(NamedTuple):
    """Hours from the last dose to a session's start, and who says so: a person of the session, or the doses of its visit."""

    hours: float
    origin: Literal["stated", "doses"]


def since_last_dose(session: StudySession) -> SinceDose | None:
    """Return the time since the last dose that counts: the stated one, else the one by the visit's doses; None where neither is known."""
    if session.medication_h is not None:
        return SinceDose(session.medication_h, "stated")
    hours = hours_by_doses(session)
    return None if hours is None else SinceDose(hours, "doses")


def hours_since_dose(session: StudySession) -> float | None:
    """Return only the hours since the last dose."""
    found = since_last_dose(session)
    return found.hours if found else None


def hours_by_doses(session: StudySession) -> float | None:
    """Return the hours from the newest dose before a session's start, of those whose effect comes and goes within hours.

    None where the start is not known, or no such dose was taken within 72 h before it. A dose at the very start counts as 0 h.
    """
    start = session.started_at
    if start is None:
        return None
    before = [d.taken_at for d in session.visit.doses if DRUGS[Drug(d.drug)].within_hours and d.taken_at <= start]
    hours = (start - max(before)).total_seconds() / 3600 if before else None
    return hours if hours is not None and hours <= LONGEST_H else None


def disagreement_h(session: StudySession) -> tuple[float, float] | None:
    """Return stated hours and those of the doses, where they differ by more than a quarter of an hour."""
    by_doses = hours_by_doses(session)
    if session.medication_h is None or by_doses is None or abs(session.medication_h - by_doses) <= APART_H:
        return None
    return session.medication_h, by_doses


# Rows of doses as API types.


def dose_out(row: Dose) -> DoseOut:
    """Convert a dose with its levodopa equivalent."""
    drug = Drug(row.drug)
    return DoseOut(
        levodopa_equivalent_mg=levodopa_equivalent_mg(drug, row.mg),
        counts_for_time=DRUGS[drug].within_hours,
        **{n: getattr(row, n) for n in ("id", "visit_id", "drug", "mg", "taken_at", "entered_by", "created_at")},
    )
