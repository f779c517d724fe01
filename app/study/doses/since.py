"""How long before a session the last dose was: the one place that says it, to pages, analyses, snapshots and the record that leaves."""

from __future__ import annotations

from typing import Literal, NamedTuple

from app.study.doses.drugs import DRUGS
from app.tables.sessions import StudySession
from app.tables.visits import Drug

LONGEST_H = 72.0
APART_H = 0.25
"""How far a stated time and the doses may lie apart before somebody is asked, h."""


class SinceDose(NamedTuple):
    """Hours from the last dose to a session's start, and who says so: a person of the session, or the doses of its visit."""

    hours: float
    origin: Literal["stated", "doses"]


def since_last_dose(session: StudySession) -> SinceDose | None:
    """What counts: what a person stated of the session, else what the visit's doses give; None where neither is known."""
    if session.medication_h is not None:
        return SinceDose(session.medication_h, "stated")
    hours = hours_by_doses(session)
    return None if hours is None else SinceDose(hours, "doses")


def hours_since_dose(session: StudySession) -> float | None:
    """The hours alone."""
    found = since_last_dose(session)
    return found.hours if found else None


def hours_by_doses(session: StudySession) -> float | None:
    """Hours from the newest dose before a session's start, of those whose effect comes and goes within hours.

    None where the start is not known, or no such dose was taken within 72 h before it. A dose at the very start counts as 0 h.
    """
    start = session.started_at
    if start is None:
        return None
    before = [d.taken_at for d in session.visit.doses if DRUGS[Drug(d.drug)].within_hours and d.taken_at <= start]
    hours = (start - max(before)).total_seconds() / 3600 if before else None
    return hours if hours is not None and hours <= LONGEST_H else None


def disagreement_h(session: StudySession) -> tuple[float, float] | None:
    """Stated hours and those of the doses, where they lie more than a quarter of an hour apart."""
    by_doses = hours_by_doses(session)
    if session.medication_h is None or by_doses is None or abs(session.medication_h - by_doses) <= APART_H:
        return None
    return session.medication_h, by_doses
