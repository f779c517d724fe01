"""What a visit's plan suggests: the portfolio of candidates that may be proposed, then sessions that would tell of others.

The clinician decides."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from app.evaluation.ranking.answer import answer
from app.evaluation.ranking.assessment import Assessment
from app.evaluation.ranking.judged import Judged
from app.evaluation.repository import PolicyHead
from app.planning.protocol.schedule import cdbs_sessions
from ml.ope import FEWEST_DRAWS, Suggestion, portfolio
from ml.ope.posterior.further_sessions import Hold, Place, worth_exploring, worth_holding


@dataclass(frozen=True)
class Suggested:
    """A policy of the portfolio, and why it is in it."""

    policy: PolicyHead
    why: Suggestion


@dataclass(frozen=True)
class Held:
    """Sessions to hold near an amplitude, and the policies of which they would tell."""

    hold: Hold
    policies: tuple[PolicyHead, ...]


def held_in(found: Judged | None, slots: int, place: Place) -> tuple[Held, ...]:
    """What to hold in slots that no policy takes; nothing before there is a ranking, or where it would tell nothing.

    Args:
        found: the ranking. slots: of the visit that are free. place: within what the visit's sessions are held.
    """
    if found is None:
        return ()
    rows = {str(row.one.policy.id): row for row in found.answer.undecided}
    waiting = {name: (row.decided.further, row.within) for name, row in rows.items() if row.decided.further is not None}
    holds = worth_holding(waiting, slots) if found.answer.ordered else worth_exploring(place, slots)
    return tuple(Held(hold, tuple(rows[name].one.policy for name in hold.names)) for hold in holds)


def suggested(found: Judged | None, slots: int) -> tuple[Suggested, ...]:
    """Return the policies that teach most in a visit with so many slots, each behaviour once.

    Only candidates whose verdict is *test* or *test with care* are asked, and at most one of the latter is taken.
    """
    if found is None:
        return ()
    return found.kept(("suggested", slots), lambda: _portfolio(found.with_draws, slots))


def _portfolio(found: Assessment, slots: int) -> tuple[Suggested, ...]:
    if found.cdbs is None or found.cdbs.posterior is None:
        return ()
    theirs = np.asarray(found.cdbs.posterior.details.get("draws") or [], dtype=np.float64)
    answered = answer(found)
    careful = {str(row.one.policy.id) for row in answered.of("test_with_care")}
    differences, policies, tested = {}, {}, set()
    for row in (*answered.of("test"), *answered.of("test_with_care")):
        own = row.one.posterior
        ours = np.asarray(own.details.get("draws") or [], dtype=np.float64) if own is not None else np.empty(0)
        if ours.size == theirs.size >= FEWEST_DRAWS:
            differences[str(row.one.policy.id)] = ours - theirs
            policies[str(row.one.policy.id)] = row.one.policy
            if any(own.one.tested is not None for own in (row, *row.twins)):
                tested.add(str(row.one.policy.id))
    # of one session
    noise = float(found.cdbs.posterior.details.get("return_noise") or 0.0)
    for number in range(slots, 0, -1):
        # a day of fewer policies has fewer cDBS sessions, and each policy is held against their mean
        chosen = portfolio(differences, number, careful, tested, noise * math.sqrt(1 + 1 / cdbs_sessions(number)))
        if len(chosen) == number:
            return tuple(Suggested(policies[s.name], s) for s in chosen)
    return ()
