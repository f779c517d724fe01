"""The rules of a visit day, pure: which controller runs when. Source: Gao et al. 2023, section 6.1.

From the paper: 2-4 policies a visit, a cDBS session between any two of them as control, sessions of 5-20 minutes, a short session without
stimulation. Ours: the washout, the minutes of a visit, the order, repeats, the break, and the places of no-DBS and random sessions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import time
from enum import StrEnum

import numpy as np

from app.platform.errors import Invalid
from app.platform.numbers import counted
from app.study.characteristics import PlannedDose
from app.study.doses import DRUGS
from app.tables.sessions import Controller

# Balanced orders of the policies of a visit, pure. Source: Williams 1949, "Experimental designs balanced for the estimation of residual
# effects of treatments".


class Order(StrEnum):
    """Method by which the order of a visit's policies is found."""

    DRAWN = "drawn"  # from the seed
    LATIN_SQUARE = "latin_square"  # every policy at every place equally often
    WILLIAMS = "williams"  # and after every other equally often
    STATED = "stated"  # as they were named


def latin_square(treatments: int) -> list[tuple[int, ...]]:
    """Build the cyclic Latin square: `treatments` rows, each treatment once at each place. Rows hold numbers from 0."""
    return [tuple((row + place) % treatments for place in range(treatments)) for row in range(treatments)]


def williams(treatments: int) -> list[tuple[int, ...]]:
    """Build Williams' design: each treatment equally often at each place and right after each other one.

    Returns:
        As many rows as treatments where they are even in number, twice as many where they are odd.
    """
    first = [0]
    for k in range(1, treatments):
        first.append((k + 1) // 2 if k % 2 else treatments - k // 2)
    rows = [tuple((number + shift) % treatments for number in first) for shift in range(treatments)]
    return rows + [row[::-1] for row in rows] if treatments % 2 and treatments > 1 else rows


def rounds(treatments: int, count: int, order: Order, seed: int, block: int) -> list[Sequence[int]]:
    """Build the orders of `count` rounds, each of all treatments.

    Args:
        treatments: how many. count: rounds of this visit. seed: draws orders, and which treatment is which of a square.
        block: visits before this one that followed the same square, so that its rows go on from visit to visit.
    """
    if order is Order.STATED or treatments == 0:
        return [range(treatments)] * count
    rng = np.random.default_rng(seed)
    if order is Order.DRAWN:
        return [[int(i) for i in rng.permutation(treatments)] for _ in range(count)]
    named = rng.permutation(treatments)
    rows = latin_square(treatments) if order is Order.LATIN_SQUARE else williams(treatments)
    return [[int(named[i]) for i in rows[(block * count + k) % len(rows)]] for k in range(count)]


SESSION_MINUTES = (5.0, 20.0)
"""Shortest and longest session of the paper, minutes."""
POLICIES = (2, 4)
"""Fewest and most policies of a visit in the paper; a single one, or random sessions alone, is possible and noted."""
MOST_REPEATS = 4
"""Sessions of one policy within a visit, at most."""


class Rule(StrEnum):
    """The protocol's rules, by which a refusal and a warning name what they rest on."""

    POLICIES = "policies_per_visit"
    CDBS_BETWEEN = "cdbs_between_policies"
    SESSION_MINUTES = "session_minutes"
    NO_DBS_SHORT = "no_dbs_short"
    VISIT_MINUTES = "visit_minutes"
    REPEATS = "repeats"


@dataclass(frozen=True)
class Rules:
    """Rules of a visit day.

    Attributes:
        session_minutes: length of every session but no-DBS.
        washout_minutes: pause on the clinical stimulation after every session but the last, so that one does not colour the next.
        total_minutes: from the first session's start to the last one's end, at most.
        no_dbs: one session without stimulation, at the end of the day: what it does to the symptoms then reaches no other session.
        no_dbs_minutes: its length; no longer than another session, to spare the participant.
        random_sessions: sessions of the random controller, which widen what the replay buffer covers. held_sessions: those near a stated
            amplitude; they take the places of random ones, and count as such.
        repeats: sessions of each policy; each round has all of them.
        order: how the order of the policies is found. block: visits before this one that followed the same square.
        break_minutes: one rest in the middle of the visit; 0 for none.

    Raises:
        Invalid: a length outside its range.
    """

    session_minutes: float = 10.0
    washout_minutes: float = 5.0
    total_minutes: float = 120.0
    no_dbs: bool = False
    no_dbs_minutes: float = 5.0
    random_sessions: int = 0
    held_sessions: int = 0
    repeats: int = 1
    order: Order = Order.DRAWN
    block: int = 0
    break_minutes: float = 0.0

    def __post_init__(self) -> None:
        shortest, longest = SESSION_MINUTES
        for name, minutes in (("A session", self.session_minutes), ("A no-DBS session", self.no_dbs_minutes)):
            if not shortest <= minutes <= longest:
                raise Invalid(
                    f"{name} of {counted(minutes, 'minute')} is not possible.",
                    f"Choose {shortest:g} to {longest:g} minutes.",
                    rule=Rule.SESSION_MINUTES,
                )
        if self.no_dbs and self.no_dbs_minutes > self.session_minutes:
            raise Invalid(
                f"The session without stimulation would take {counted(self.no_dbs_minutes, 'minute')}, longer than another session.",
                f"Make it short: {shortest:g} to {self.session_minutes:g} minutes.",
                rule=Rule.NO_DBS_SHORT,
            )
        if not 1 <= self.repeats <= MOST_REPEATS:
            raise Invalid(f"{self.repeats} sessions of each policy are not possible.", f"Choose 1 to {MOST_REPEATS}.", rule=Rule.REPEATS)
        if min(self.washout_minutes, self.random_sessions, self.held_sessions, self.break_minutes) < 0 or self.total_minutes <= 0:
            raise Invalid("The washout, the break, the visit's minutes and the random sessions cannot be negative.", "Correct them.")

    @property
    def exploring(self) -> int:
        """Sessions of the random arm: those of the random controller, and those near a stated amplitude."""
        return self.random_sessions + self.held_sessions


@dataclass(frozen=True)
class Candidate:
    """A policy to test, and what kind of controller it is."""

    policy_id: int
    controller: Controller


@dataclass(frozen=True)
class PlannedSession:
    """One session of a visit day; minutes count from the first session's start."""

    controller: Controller
    policy_id: int | None
    start_minute: float
    minutes: float
    washout_minutes: float
    break_minutes: float = 0.0


def schedule(candidates: Sequence[Candidate], rules: Rules, seed: int) -> list[PlannedSession]:
    """Lay out a visit day: the policies in the order of the rules, a cDBS session between any two of their sessions.

    A single policy gets its cDBS session first, so that it too has a control. So does a day of random sessions alone, an early visit that
    only fills the replay buffer. Random sessions, and those near an amplitude, have drawn places; the no-DBS session is at the end. The
    same arguments give the same day.

    Raises:
        Invalid: neither a policy nor a random session, a policy twice, more than four, or a day longer than `rules.total_minutes`. The
            message says how many policies would fit. The member `rule` names the rule of the protocol.
    """
    _check_candidates(candidates, rules)
    needed = total_minutes(len(candidates), rules)
    if needed > rules.total_minutes + 1e-9:
        raise _too_long(len(candidates), needed, rules)
    rng = np.random.default_rng(seed)
    order = [candidates[i] for turn in rounds(len(candidates), rules.repeats, rules.order, seed, rules.block) for i in turn]
    day: list[tuple[Controller, int | None]] = [(Controller.CDBS, None)] if len(order) <= 1 else []
    for i, candidate in enumerate(order):
        if i:
            day.append((Controller.CDBS, None))
        day.append((candidate.controller, candidate.policy_id))
    for _ in range(rules.exploring):
        # without policies the one cDBS session stays first
        day.insert(int(rng.integers(0 if order else 1, len(day) + 1)), (Controller.RANDOM, None))
    if rules.no_dbs:
        day.append((Controller.NO_DBS, None))
    return _timed(day, rules)


def cdbs_sessions(tested: int) -> int:
    """Count cDBS sessions of a day with so many sessions of policies: one between any two, one before a single one or before none."""
    return max(tested - 1, 1)


def total_minutes(policies: int, rules: Rules) -> float:
    """Compute the minutes from the first session's start to the last one's end of a day with this many policies."""
    tested = policies * rules.repeats
    controls = cdbs_sessions(tested) if tested or rules.exploring else 0
    full = tested + controls + rules.exploring
    sessions = full + rules.no_dbs
    rest = rules.break_minutes if sessions > 1 else 0.0
    return full * rules.session_minutes + rules.no_dbs * rules.no_dbs_minutes + max(sessions - 1, 0) * rules.washout_minutes + rest


def most_policies(rules: Rules) -> int:
    """Count how many policies fit into the day."""
    count = 0
    while count < POLICIES[1] and total_minutes(count + 1, rules) <= rules.total_minutes + 1e-9:
        count += 1
    return count


def require_controls(day: Sequence[tuple[Controller, int | None]]) -> None:
    """Raise Invalid where two sessions of policies have no cDBS session between them.

    Args:
        day: controller and policy of each session, in order; sessions without a policy, as random ones, are no control.
    """
    waiting: int | None = None
    for number, (controller, policy_id) in enumerate(day, start=1):
        if controller is Controller.CDBS:
            waiting = None
        elif policy_id is not None:
            if waiting is not None:
                raise Invalid(
                    f"Sessions {waiting} and {number} would test policies without a cDBS session between them.",
                    "Move the session to a place on the other side of a cDBS session.",
                    rule=Rule.CDBS_BETWEEN,
                )
            waiting = number


def _check_candidates(candidates: Sequence[Candidate], rules: Rules) -> None:
    if not candidates and not rules.exploring:
        raise Invalid(
            "A plan needs at least one policy, or one random or held session.",
            "Choose a policy in the ranking, or add random sessions or ones held near an amplitude.",
        )
    ids = [c.policy_id for c in candidates]
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise Invalid(f"Policy {twice[0]} is named twice.", "Name each policy once; `repeats` says how many sessions each has.")
    if len(candidates) > POLICIES[1]:
        raise Invalid(
            f"{len(candidates)} policies are chosen; the protocol tests {POLICIES[0]} to {POLICIES[1]} in a visit.",
            "Leave some for another visit.",
            rule=Rule.POLICIES,
        )


def _too_long(policies: int, needed: float, rules: Rules) -> Invalid:
    most = most_policies(rules)
    extras = [
        name
        for name, there in (
            ("the no-DBS session", rules.no_dbs),
            ("random sessions", rules.random_sessions),
            ("held sessions", rules.held_sessions),
        )
        if there
    ]
    ways = ["shorten sessions or washout", "give the visit more minutes"] + ([f"leave out {' and '.join(extras)}"] if extras else [])
    kinds = [name for name, there in (("random", rules.random_sessions), ("held", rules.held_sessions)) if there]
    tested = _policies(policies) if policies else f"The {' and '.join(kinds)} sessions"
    detail = f"{tested} with the sessions around them take {counted(needed, 'minute')}; the visit has {rules.total_minutes:g}."
    if not policies:
        return Invalid(
            detail,
            f"Plan fewer of them, or {', or '.join(ways[:2])}.",
            minutes_needed=needed,
            policies_that_fit=0,
            rule=Rule.VISIT_MINUTES,
        )
    return Invalid(
        detail,
        f"{'Choose ' + ('at most ' if most > 1 else '') + _policies(most) if most else 'Not even one policy fits'}, "
        f"or {', or '.join(ways)}.",
        minutes_needed=needed,
        policies_that_fit=most,
        rule=Rule.VISIT_MINUTES,
    )


def _policies(count: int) -> str:
    return counted(count, "policy", "policies")


def _timed(day: Sequence[tuple[Controller, int | None]], rules: Rules) -> list[PlannedSession]:
    sessions: list[PlannedSession] = []
    start = 0.0
    middle = (len(day) - 1) // 2 if len(day) > 1 else None
    for place, (controller, policy_id) in enumerate(day):
        rest = rules.break_minutes if place == middle else 0.0
        minutes = rules.no_dbs_minutes if controller is Controller.NO_DBS else rules.session_minutes
        sessions.append(PlannedSession(controller, policy_id, start, minutes, rules.washout_minutes, rest))
        start += minutes + rules.washout_minutes + rest
    sessions[-1] = replace(sessions[-1], washout_minutes=0.0)
    return sessions


# When medication is due: the schedule of the participant next to the sessions of a plan, with which it is signed.


def due_before(lengths: Sequence[float], starts_at: time | None, schedule: Sequence[PlannedDose]) -> list[str]:
    """Describe what is due before each session and after the start of the one before it; empty where no time of day is planned.

    Args:
        lengths: minutes from each session's start to the next one's. starts_at: of the first, by the clinic's clock.
        schedule: doses of a visit day, by the same clock.
    """
    if starts_at is None:
        return [""] * len(lengths)
    found, since, begins = [], -1.0, 60.0 * starts_at.hour + starts_at.minute
    for length in lengths:
        due = [d for d in schedule if since < _minutes(d.at) <= begins]
        found.append("; ".join(f"{d.at} {DRUGS[d.drug].name} {d.mg:g} mg" for d in due))
        since, begins = begins, begins + length
    return found


def _minutes(at: str) -> int:
    hours, minutes = at.split(":")
    return 60 * int(hours) + int(minutes)
