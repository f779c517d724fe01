"""The rules of a visit day, pure: which controller runs when. Source: Gao et al. 2023, section 6.1.

From the paper: 2-4 policies a visit, a cDBS session between any two of them as control, sessions of 5-20 minutes, a short session without
stimulation. Ours: the washout, the minutes of a visit, the drawn order, and where no-DBS and random sessions stand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.platform.errors import Invalid
from app.study.models import Controller

SESSION_MINUTES = (5.0, 20.0)
"""Shortest and longest session of the paper, minutes."""


@dataclass(frozen=True)
class Rules:
    """What a visit day must keep to.

    Attributes:
        session_minutes: length of every session but no-DBS.
        washout_minutes: pause on the clinical stimulation after every session but the last, so that one does not colour the next.
        total_minutes: from the first session's start to the last one's end, at most.
        no_dbs: one session without stimulation, at the end of the day: what it does to the symptoms then reaches no other session.
        no_dbs_minutes: its length; short, to spare the participant.
        random_sessions: sessions of the random controller, which widen what the replay buffer covers.

    Raises:
        Invalid: a length outside its range.
    """

    session_minutes: float = 10.0
    washout_minutes: float = 5.0
    total_minutes: float = 120.0
    no_dbs: bool = False
    no_dbs_minutes: float = 5.0
    random_sessions: int = 0

    def __post_init__(self) -> None:
        shortest, longest = SESSION_MINUTES
        for name, minutes in (("A session", self.session_minutes), ("A no-DBS session", self.no_dbs_minutes)):
            if not shortest <= minutes <= longest:
                raise Invalid(f"{name} of {minutes:g} minutes is not possible.", f"Choose {shortest:g} to {longest:g} minutes.")
        if self.washout_minutes < 0 or self.total_minutes <= 0 or self.random_sessions < 0:
            raise Invalid("The washout, the visit's minutes and the number of random sessions cannot be negative.", "Correct them.")


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

    @property
    def end_minute(self) -> float:
        """When it ends, before its washout."""
        return self.start_minute + self.minutes


def schedule(candidates: Sequence[Candidate], rules: Rules, seed: int) -> list[PlannedSession]:
    """Lay out a visit day: the policies in an order drawn from the seed, a cDBS session between any two of them.

    A single policy gets its cDBS session first, so that it too has a control, and so does a day of random sessions alone: an early visit
    that only fills the replay buffer. Random-controller sessions stand at drawn places, the no-DBS session at the end. The same arguments
    give the same day.

    Raises:
        Invalid: neither a policy nor a random session, a policy twice, or a day longer than `rules.total_minutes`; the message says how
            many policies would fit.
    """
    _check_candidates(candidates, rules)
    needed = total_minutes(len(candidates), rules)
    if needed > rules.total_minutes + 1e-9:
        raise _too_long(len(candidates), needed, rules)
    rng = np.random.default_rng(seed)
    order = [candidates[i] for i in rng.permutation(len(candidates))]
    day: list[tuple[Controller, int | None]] = [(Controller.CDBS, None)] if len(order) <= 1 else []
    for i, candidate in enumerate(order):
        if i:
            day.append((Controller.CDBS, None))
        day.append((candidate.controller, candidate.policy_id))
    for _ in range(rules.random_sessions):
        # without policies the one cDBS session stays first
        day.insert(int(rng.integers(0 if order else 1, len(day) + 1)), (Controller.RANDOM, None))
    if rules.no_dbs:
        day.append((Controller.NO_DBS, None))
    return _timed(day, rules)


def total_minutes(policies: int, rules: Rules) -> float:
    """Minutes from the first session's start to the last one's end of a day with this many policies."""
    controls = max(policies - 1, 1) if policies or rules.random_sessions else 0
    full = policies + controls + rules.random_sessions
    sessions = full + rules.no_dbs
    return full * rules.session_minutes + rules.no_dbs * rules.no_dbs_minutes + max(sessions - 1, 0) * rules.washout_minutes


def most_policies(rules: Rules) -> int:
    """How many policies fit into the day."""
    count = 0
    while total_minutes(count + 1, rules) <= rules.total_minutes + 1e-9:
        count += 1
    return count


def _check_candidates(candidates: Sequence[Candidate], rules: Rules) -> None:
    if not candidates and not rules.random_sessions:
        raise Invalid("A plan needs at least one policy or one random session.", "Choose a policy in the ranking, or add random sessions.")
    ids = [c.policy_id for c in candidates]
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise Invalid(f"Policy {twice[0]} is named twice.", "Name each policy once; a visit tests each in one session.")


def _too_long(policies: int, needed: float, rules: Rules) -> Invalid:
    most = most_policies(rules)
    extras = (["the no-DBS session"] if rules.no_dbs else []) + (["random sessions"] if rules.random_sessions else [])
    ways = ["shorten sessions or washout", "give the visit more minutes"] + ([f"leave out {' and '.join(extras)}"] if extras else [])
    tested = _policies(policies) if policies else "The random sessions"
    said = f"{tested} with the sessions around them take {needed:g} minutes; the visit has {rules.total_minutes:g}."
    if not policies:
        return Invalid(said, f"Plan fewer random sessions, or {', or '.join(ways[:2])}.", minutes_needed=needed, policies_that_fit=0)
    return Invalid(
        said,
        f"{'Choose ' + ('at most ' if most > 1 else '') + _policies(most) if most else 'Not even one policy fits'}, "
        f"or {', or '.join(ways)}.",
        minutes_needed=needed,
        policies_that_fit=most,
    )


def _policies(count: int) -> str:
    return f"{count} policy" if count == 1 else f"{count} policies"


def _timed(day: Sequence[tuple[Controller, int | None]], rules: Rules) -> list[PlannedSession]:
    sessions: list[PlannedSession] = []
    start = 0.0
    for controller, policy_id in day:
        minutes = rules.no_dbs_minutes if controller is Controller.NO_DBS else rules.session_minutes
        sessions.append(PlannedSession(controller, policy_id, start, minutes, rules.washout_minutes))
        start += minutes + rules.washout_minutes
    sessions[-1] = replace(sessions[-1], washout_minutes=0.0)
    return sessions
