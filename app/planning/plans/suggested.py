"""What a visit's plan suggests: the portfolio of candidates that may be proposed, then sessions that would tell of others.

The clinician decides."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from app.evaluation.ranking.answer import Answer, answer
from app.evaluation.ranking.assessment import Assessment
from app.evaluation.ranking.judged import Judged
from app.evaluation.repository import PolicyHead
from app.planning.plans.schemas import MOST_HELD
from ml.ope.posterior.portfolio import Suggestion, portfolio
from ml.ope.posterior.verdict import FEWEST_DRAWS

CDBS_SESSIONS = 2
"""Sessions of cDBS that a visit's policies are held against, at least."""


@dataclass(frozen=True)
class Suggested:
    """A policy of the portfolio, and why it is in it."""

    policy: PolicyHead
    why: Suggestion


ALIKE = 0.05
"""Amplitudes closer than this fraction of cDBS are held by the same sessions: their draws reach as far."""


@dataclass(frozen=True)
class Hold:
    """Sessions near an amplitude that would tell of policies.

    Attributes:
        fraction: of cDBS. amplitude_ma: the same; None where the cDBS amplitude is not known. sessions, visits: with which they would tell.
        here: how many of the sessions this visit has room for. policies: of which they would tell.
    """

    fraction: float
    amplitude_ma: float | None
    sessions: int
    visits: int
    here: int
    policies: tuple[PolicyHead, ...]


def worth_holding(found: Judged | None, slots: int) -> tuple[Hold, ...]:
    """What to hold in slots that no policy takes: near the amplitudes that would tell soonest of policies that cannot be told yet."""
    return () if found is None else held_for(found.answer, found.assessment.cdbs_ma, slots)


def held_for(answered: Answer, cdbs_ma: float | None, slots: int) -> tuple[Hold, ...]:
    """As `worth_holding`, of an answer.

    The fewest sessions come first, then the likeliest policy. Of sessions on two visits this one takes half.
    """
    waiting = [(row, row.decided.further) for row in answered.undecided if row.decided.further is not None]
    waiting.sort(key=lambda pair: (pair[1].sessions, -(pair[0].within or 0.0)))
    made: list[Hold] = []
    for row, further in waiting:
        near = next((i for i, hold in enumerate(made) if abs(hold.fraction - further.fraction) < ALIKE), None)
        if near is not None:
            if made[near].sessions == further.sessions:
                made[near] = replace(made[near], policies=(*made[near].policies, row.one.policy))
            continue
        room = slots - sum(hold.here for hold in made)
        if room < 1:
            continue
        ma = None if cdbs_ma is None else further.fraction * cdbs_ma
        here = min(room, MOST_HELD, math.ceil(further.sessions / further.visits))
        made.append(Hold(further.fraction, ma, further.sessions, further.visits, here, (row.one.policy,)))
    return tuple(made)


def suggested(found: Judged | None, slots: int) -> tuple[Suggested, ...]:
    """The policies that teach most in a visit with so many slots, each behaviour once; none where the data cannot order policies.

    Only candidates whose verdict is *test* or *test with care* are asked, and at most one of the latter is taken.
    """
    if found is None or not found.answer.ordered:
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
            if any(one.tested is not None for one in (row.one, *row.twins)):
                tested.add(str(row.one.policy.id))
    # of a session's difference to the visit's cDBS, of which a plan holds two sessions or more; evaluations of before do not say it
    noise = float(found.cdbs.posterior.details.get("return_noise") or 0.0) * math.sqrt(1 + 1 / CDBS_SESSIONS)
    chosen = portfolio(differences, slots, careful, tested, noise)
    return tuple(Suggested(policies[s.name], s) for s in chosen)
