"""Suggestions for a visit's plan: the portfolio of candidates that may be proposed, then sessions that would decide about others.

The clinician decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation.ranking.answer import answer
from app.evaluation.ranking.assessment import Assessment, cdbs_amplitude_now
from app.evaluation.ranking.judged import Judged
from app.evaluation.repository import PolicyHead
from app.planning.plans import repository
from app.planning.plans.designs import offered
from app.planning.plans.visits import today
from app.planning.protocol.schedule import Rules, cdbs_sessions, most_policies, total_minutes
from app.platform.numbers import counted
from app.study.access import may
from app.tables.participants import Participant
from app.tables.visits import Visit
from ml.designs import EARLY_RANDOM_SESSIONS
from ml.ope import FEWEST_DRAWS, Suggestion, portfolio
from ml.ope.posterior.further_sessions import Hold, Place, worth_exploring, worth_holding


@dataclass(frozen=True)
class Suggested:
    """A policy of the portfolio, and why it is in it."""

    policy: PolicyHead
    why: Suggestion


@dataclass(frozen=True)
class Held:
    """Sessions near an amplitude, and the policies that they would decide about."""

    hold: Hold
    policies: tuple[PolicyHead, ...]


def held_in(found: Judged | None, slots: int, place: Place) -> tuple[Held, ...]:
    """Suggest sessions near an amplitude for slots that no policy takes; empty before there is a ranking, or where none would decide.

    Args:
        found: the ranking. slots: of the visit that are free. place: range of the visit's amplitudes.
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
        # a day of fewer policies has fewer cDBS sessions, and each policy is compared with their mean
        chosen = portfolio(differences, number, careful, tested, noise * math.sqrt(1 + 1 / cdbs_sessions(number)))
        if len(chosen) == number:
            return tuple(Suggested(policies[s.name], s) for s in chosen)
    return ()


# The visit that the ranking suggests, filled in: one button drafts it.


@dataclass(frozen=True)
class SuggestedVisit:
    """A visit as the protocol fills it.

    Attributes:
        sessions: how many, those of cDBS among them. minutes: from the first one's start to the last one's end.
        alone: minutes of a visit that tests one policy: its cDBS session, the washout and the test.
        policies: what is tested. sessions_near: sessions near an amplitude, in words. visit: for which; None where one is to be chosen.
        fields: names and values of the form for a draft.
    """

    sessions: int
    minutes: float
    alone: float
    policies: tuple[PolicyHead, ...]
    sessions_near: tuple[str, ...]
    visit: Visit | None
    fields: tuple[tuple[str, str], ...]


def suggested_visit(db: Session, participant: Participant, caller: Caller, ranking: Judged) -> SuggestedVisit | None:
    """Fill the next visit without a plan: policies worth a test, else sessions near an amplitude, else random ones.

    None where the caller drafts no plans, the participant has withdrawn, or every visit to come has its plan.
    """
    if participant.status == "withdrawn" or not may(caller, can.DRAFT_PLAN, participant):
        return None
    visits = repository.open_visits(db, participant.id, today())
    planned = {plan.visit_id for plan, _ in repository.plans(db, participant.id, 500, 0)[0] if plan.status != "superseded"}
    free = [visit for visit in visits if visit.id not in planned]
    if visits and not free:
        return None
    rules, settings = Rules(), participant.current_settings
    slots = most_policies(rules)
    place = Place(settings.bound, round(60 * rules.session_minutes / settings.period_s), settings.period_s)
    policies = tuple(s.policy for s in suggested(ranking, slots))
    holds = held_in(ranking, slots, place) if ranking.answer.cheapest and not policies else ()
    rules = replace(rules, random_sessions=0 if policies or holds else EARLY_RANDOM_SESSIONS, held_sessions=sum(h.hold.here for h in holds))
    cdbs_ma = cdbs_amplitude_now(participant)
    near = [(str(h.hold.here), offered(h.hold.fraction, settings.bound, cdbs_ma)) for h in holds]
    name, unit = ("amplitude_fraction", "of cDBS") if cdbs_ma is None else ("amplitude_ma", "mA")
    fields = [("evaluation_id", str(ranking.evaluation.id)), ("random_sessions", str(rules.random_sessions))]
    fields += [("policy_ids", str(p.id)) for p in policies]
    fields += [f for here, ma in near for f in (("held_unit", name), ("held_amplitude", ma), ("held_sessions", here))]
    return SuggestedVisit(
        sessions=len(policies) + cdbs_sessions(len(policies)) + rules.exploring,
        minutes=total_minutes(len(policies), rules),
        alone=total_minutes(1, Rules()),
        policies=policies,
        sessions_near=tuple(f"{counted(int(here), 'session')} near {level} {unit}" for here, level in near),
        visit=free[0] if free else None,
        fields=(*fields, *([("visit_id", str(free[0].id))] if free else [])),
    )
