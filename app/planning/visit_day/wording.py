"""Sentences about the clinic day, made of typed values at the last moment; nothing reads them back."""

from __future__ import annotations

from collections.abc import Sequence

from app.planning.visit_day.record import ASKED, ASKED_BY_KIND, AskedOutcome, Contradiction, Entry, moment
from app.planning.visit_day.schemas import SlotOut
from app.planning.visit_day.screening import Found
from app.platform.numbers import elapsed_time, stated
from ml.outcomes import BY_FIELD


def screened(found: Sequence[Found]) -> str:
    """Explain why a note is not kept, in one sentence."""
    what = {"date": "a date", "number": "a number of four or more digits", "address": "an address", "name": "a word that looks like a name"}
    return "The note holds " + "; ".join(f"{what[f.kind]} ('{f.text}')" for f in found) + "."


DAY_STATES = {"waiting": "to come", "running": "running", "asked": "to be rated", "done": "finished", "skipped": "skipped"}
"""How far a session of the clinic day is."""
_MATTERS = {
    "start": "starts", "stop": "stops", "stop_cause": "causes of the early stop",
    **{one.kind: one.several for one in ASKED},
    "skip": "reasons for skipping it", "speech": "grades of speech", "gait": "grades of gait", "dyskinesia": "grades of dyskinesia",
}  # fmt: skip


def contradiction(found: Contradiction, slots: Sequence[SlotOut]) -> str:
    """Describe what two entries state differently, in one sentence."""
    position = next((slot.position for slot in slots if slot.plan_item_id == found.plan_item_id), 0)
    said = ", ".join(f"{_entered(entry)} by {entry.entered_by} at {moment(entry):%H:%M:%S} UTC" for entry in found.entries)
    what = _MATTERS.get(found.kind, "entries")
    return f"Session {position} has {len(found.entries)} different {what}: {said}. None counts until one is chosen."


MAY_NOT_RUN = "This plan may not run any more. A clinician who may open its key sees why on the page of the plan."
CORRECTED_ON_THE_DAY = "the entry was corrected on the clinic day"
STOPPED_FOR_PARTICIPANT = "stopped for the participant's sake on the clinic day"


def from_the_day(who: Sequence[str]) -> str:
    """Explain where a session's outcomes come from, if they were not typed on its page."""
    return "entered on the clinic day" + (f" by {', '.join(who)}" if who else "")


def day_differs(outcome: AskedOutcome, entered: float, known: float | None) -> str:
    """Describe a QoC that the clinic day has otherwise than the session, which keeps its own; `known` None: a person took it back."""
    what = BY_FIELD[outcome.field].label.lower()
    own = "none" if known is None else f"{stated(known, 3)}{outcome.unit}"
    return f"The clinic day has a {what} of {stated(entered, 3)}{outcome.unit}, the session {own}; the session keeps its own."


def day_ended(elapsed_s: float, recorded_s: float) -> str:
    """Describe a session that the clinic day ends at another time than its recording."""
    said, recorded = elapsed_time(elapsed_s), elapsed_time(recorded_s)
    return f"The clinic day has it stopped after {said}, and its recording is {recorded} long: one of the two is wrong."


def open_contradiction(kind: str) -> str:
    """Describe a matter of which the clinic day has two different entries."""
    return f"The clinic day has different {_MATTERS.get(kind, 'entries')}; none was taken. Choose one on the page of the day."


def _entered(entry: Entry) -> str:
    payload = entry.payload
    if entry.kind in ASKED_BY_KIND:
        return ASKED_BY_KIND[entry.kind].words(payload)
    return str(payload.get("value") or payload.get("grade") or payload.get("reason") or payload.get("cause") or entry.kind)
