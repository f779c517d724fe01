"""Matching of sessions to the slots of a plan, pure.

A controller's log names its slot, and fills that one or none. Other sessions are aligned with slots in their order, as one aligns two
sequences. The assignment that explains most is taken; no session and no slot is used twice, and none passes another. What is left over is
matched out of order where controller and policy say clearly what it was.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta
from enum import StrEnum

import numpy as np

from app.platform.numbers import counted
from app.tables.sessions import Controller

FAR = timedelta(minutes=60)
"""A session that began further than this from what the clinic day entered for a slot is another one."""
NEAR = timedelta(minutes=10)
CLOCKS = (timedelta(0), timedelta(hours=1), timedelta(hours=-1))
"""Possible offsets of the recordings' clock against the clinic day's: none, or the hour of summer time."""
_SHARE = 0.2
"""A session whose length differs from the plan by more than this share is named."""


class Deviation(StrEnum):
    """Deviation of a day from its plan."""

    MISSING = "missing"
    UNPLANNED = "unplanned"
    OUT_OF_ORDER = "out_of_order"
    SHORTER = "shorter"
    LONGER = "longer"
    OTHER_DAY = "other_day"
    OTHER_TIME = "other_time"
    """It began further than NEAR from what the clinic day says: one of the two clocks is wrong."""
    OTHER_PLAN = "other_plan"
    """A controller's log of a session of another plan."""
    SECOND_RUN = "second_run"
    """A controller's log of a slot that another session fills: two tablets ran it, or one whose notes were lost."""
    EARLIER_PLAN = "earlier_plan"
    """A session that was put into a slot of the plan that was signed before this one."""
    ABORTED = "aborted"
    """A controller's log of an attempt at a slot that ended before policy or schedule decided."""


@dataclass(frozen=True)
class Planned:
    """One slot. began: as the clinic day entered it; None where it did not."""

    item_id: int
    controller: Controller
    policy_id: int | None
    minutes: float
    began: datetime | None = None


NO_SLOT = 0
"""Slot of a log whose plan is none of this participant's; the numbers of slots begin with 1."""


@dataclass(frozen=True)
class Done:
    """One session of the visit; controller and policy None where they are open."""

    session_id: int
    controller: Controller | None
    policy_id: int | None
    duration_s: float
    began: datetime | None
    filled: int | None = None
    """The slot that a person confirmed it into."""
    logged: int | None = None
    """The slot of which its controller's log says it is; NO_SLOT where that is none of this participant's."""
    bench: bool = False
    """Its controller's log is of a trial on a bench, which fills no slot."""
    aborted: bool = False
    """By its log the policy or schedule never decided: the slot is free for another attempt."""


@dataclass(frozen=True)
class Match:
    """A slot with the session that fills it, and how it departs; session_id is None for a slot that nothing fills."""

    item_id: int | None
    session_id: int | None
    deviations: tuple[Deviation, ...]


def match(slots: Sequence[Planned], sessions: Sequence[Done], day: date | None) -> list[Match]:
    """Match sessions to slots. Returns the slots in their order, each with its session, then unplanned sessions.

    Args:
        slots: in the plan's order. sessions: in the order in which they ran. day: of the visit; None where it has no date.
    """
    known = {p.item_id for p in slots}
    pairs: dict[int, Done] = {s.filled: s for s in sessions if s.filled in known and s.filled is not None}
    for session in sessions:
        if session.filled is None and session.logged in known and not session.aborted:
            pairs.setdefault(session.logged, session)
    taken = {s.session_id for s in pairs.values()}
    open_slots = [p for p in slots if p.item_id not in pairs]
    # a log that names its slot fills that one or none, and one of a bench never any
    free = [s for s in sessions if s.session_id not in taken and s.filled is None and s.logged is None and not s.bench]
    in_order = _by_clock(open_slots, free)
    pairs |= in_order
    taken |= {s.session_id for s in in_order.values()}
    crossed = set()
    for slot in slots:
        if slot.item_id in pairs:
            continue
        found = next((s for s in free if s.session_id not in taken and _is_clear(slot, s)), None)
        if found is not None:
            pairs[slot.item_id] = found
            taken.add(found.session_id)
            crossed.add(slot.item_id)
    crossed |= _passed(slots, sessions, pairs)
    made = [_judged(slot, pairs.get(slot.item_id), slot.item_id in crossed, day) for slot in slots]
    beside = [s for s in sessions if s.session_id not in taken]
    return made + [Match(None, s.session_id, (_beside(s, known),)) for s in beside]


def _beside(session: Done, known: Collection[int]) -> Deviation:
    """Return why a session fills no slot."""
    if session.filled is not None:
        return Deviation.EARLIER_PLAN
    if session.logged in known and session.aborted:
        return Deviation.ABORTED
    if session.logged is None:
        return Deviation.UNPLANNED
    return Deviation.SECOND_RUN if session.logged in known else Deviation.OTHER_PLAN


def _passed(slots: Sequence[Planned], sessions: Sequence[Done], pairs: Mapping[int, Done]) -> set[int]:
    """Find slots whose log says that a session ran before one of an earlier slot."""
    order = {s.session_id: i for i, s in enumerate(sessions)}
    found: set[int] = set()
    latest = -1
    for slot in slots:
        session = pairs.get(slot.item_id)
        if session is None:
            continue
        if session.logged is not None and order[session.session_id] < latest:
            found.add(slot.item_id)
        latest = max(latest, order[session.session_id])
    return found


_CLEAR = 3.0
_MUCH_BETTER = 1.0
"""Least gain in explanation for assuming another clock than the recorded one: as much as a session of which nothing is known."""


def _score(slot: Planned, session: Done) -> float:
    """Score how well a session explains a slot; 0 where it cannot be this one."""
    if session.controller is not None and session.controller is not slot.controller:
        return 0.0
    if session.policy_id is not None and session.policy_id != slot.policy_id:
        return 0.0
    known = 1.0 if session.controller is None else 2.0 if slot.policy_id is not None and session.policy_id is None else _CLEAR
    if slot.began is None or session.began is None:
        return known
    apart = abs(slot.began - session.began)
    # falls from NEAR to FAR, so that a day of clocks minutes apart is not moved whole to the neighbours' slots
    return 0.0 if apart > FAR else known + 2.0 * min(1.0, (FAR - apart) / (FAR - NEAR))


def _is_clear(slot: Planned, session: Done) -> bool:
    """Check whether a session fills a slot out of order: its controller and policy say so, or its time."""
    if (score := _score(slot, replace(session, began=None))) >= _CLEAR:
        return _score(slot, session) > 0
    near = slot.began is not None and session.began is not None and abs(slot.began - session.began) <= NEAR
    return score > 0 and near


def _by_clock(slots: Sequence[Planned], sessions: Sequence[Done]) -> dict[int, Done]:
    """Find the best assignment by the recorded clock, or an hour off where that explains as many of two or more much better."""
    own = {s.session_id: s for s in sessions}
    best, most, fewest = {}, -1.0, 2
    for off in CLOCKS:
        found, score = _aligned(slots, [s if s.began is None else replace(s, began=s.began - off) for s in sessions])
        if not off:
            best, most, fewest = found, score, max(fewest, len(found))
        elif len(found) >= fewest and score > most + _MUCH_BETTER:
            # clocks minutes apart would let some sessions lie close to their neighbours' slots an hour off, and leave others out
            best, most = found, score
    return {item: own[s.session_id] for item, s in best.items()}


def _aligned(slots: Sequence[Planned], sessions: Sequence[Done]) -> tuple[dict[int, Done], float]:
    """Find the best assignment that keeps the order of both, and how much it explains."""
    best = np.zeros((len(slots) + 1, len(sessions) + 1))
    for i, slot in enumerate(slots):
        for j, session in enumerate(sessions):
            score = _score(slot, session)
            both = best[i, j] + score if score > 0 else -np.inf
            best[i + 1, j + 1] = max(best[i, j + 1], best[i + 1, j], both)
    found: dict[int, Done] = {}
    i, j = len(slots), len(sessions)
    while i and j:
        score = _score(slots[i - 1], sessions[j - 1])
        # a session goes to the earliest slot that explains as much
        if best[i, j] == best[i - 1, j]:
            i -= 1
        elif best[i, j] == best[i, j - 1]:
            j -= 1
        else:
            assert score > 0
            found[slots[i - 1].item_id] = sessions[j - 1]
            i, j = i - 1, j - 1
    return found, float(best[-1, -1])


def _judged(slot: Planned, session: Done | None, crossed: bool, day: date | None) -> Match:
    if session is None:
        return Match(slot.item_id, None, (Deviation.MISSING,))
    said = [Deviation.OUT_OF_ORDER] if crossed else []
    planned_s = 60 * slot.minutes
    if session.duration_s < (1 - _SHARE) * planned_s:
        said.append(Deviation.SHORTER)
    elif session.duration_s > (1 + _SHARE) * planned_s:
        said.append(Deviation.LONGER)
    if day is not None and session.began is not None and abs((session.began.date() - day).days) > 1:
        said.append(Deviation.OTHER_DAY)
    elif slot.began is not None and session.began is not None and abs(slot.began - session.began) > NEAR:
        said.append(Deviation.OTHER_TIME)
    return Match(slot.item_id, session.session_id, tuple(said))


DEVIATIONS: dict[Deviation, str] = {
    Deviation.MISSING: "not found",
    Deviation.UNPLANNED: "not planned",
    Deviation.OUT_OF_ORDER: "in another order than planned",
    Deviation.SHORTER: "shorter than planned",
    Deviation.LONGER: "longer than planned",
    Deviation.OTHER_DAY: "held on another day than the visit's",
    Deviation.OTHER_TIME: "began at another time than the clinic day says: one of the two clocks is wrong",
    Deviation.OTHER_PLAN: "its log is of a session of another plan",
    Deviation.EARLIER_PLAN: "of the plan that was signed before this one",
    Deviation.ABORTED: "an aborted start of a planned session: its controller never decided",
    Deviation.SECOND_RUN: "its log is of a slot that another session fills: a second run, or a second record of the same one",
}


def slots_summary(planned: int, missing: Sequence[str], due: bool = True, earlier: int = 0) -> str:
    """Describe how many of the planned sessions were found, and which are missing; none is before the day (`due` False)."""
    found = f"{planned - len(missing)} of {planned} planned sessions found"
    found += f"; {counted(earlier, 'session')} of the plan signed before {'is' if earlier == 1 else 'are'} kept" if earlier else ""
    return found if not missing or not due else f"{found}; {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
