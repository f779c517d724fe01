"""The first screen of the demo: questions to begin with, each with the page that answers it. No other installation shows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from app.overview.state import State
from app.tables.participants import Participant


@dataclass(frozen=True)
class Offer:
    """A question with the page that answers it, and what one finds there."""

    question: str
    url: str
    found: str


def offers(participants: Sequence[Participant], states: Mapping[int, State]) -> list[Offer]:
    """The questions that the study can answer by now: fewer while its participants still arrive.

    Args:
        states: of these participants, by their id.
    """
    known = {p.code: states[p.id] for p in participants if p.id in states}
    planned = {code: state.planned_visits[-1] for code, state in known.items() if state.planned_visits}
    found = []
    if "P1" in known:
        ranked = known["P1"].evaluated_at is not None
        what = "Ranked from three visits." if ranked else "Three visits so far. Its first policies are trained and ranked while you look."
        found.append(Offer("What would you test at P1's next visit?", "/participants/P1/ranking", what))
    if "P2" in planned:
        what = "Its plan is signed, with a bundle for each session."
        found.append(Offer("Walk P2's clinic day", f"/visit-day/{planned['P2'].visit_id}", what))
    if "P3" in planned:
        what = "Learned controllers ran beside cDBS at four visits."
        found.append(Offer("Does P3 save energy without loss?", "/participants/P3/analyses", what))
    if "P4" in planned:
        what = "Each ranking against the visits that followed it."
        found.append(Offer("Did the predictions for P4 come true?", "/participants/P4/calibration", what))
    if known:
        found.append(Offer("Who did what, and when?", "/audit", "Every change, in words, with the person who made it."))
    return found
