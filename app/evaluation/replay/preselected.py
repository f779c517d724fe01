"""Which policies a comparison begins with: the best of the ranking, each behaviour once."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.evaluation.ranking.answer import Answer
from app.evaluation.ranking.service import current
from app.platform.errors import NotFound
from app.tables.learning import Policy
from app.tables.participants import Participant

TWO = 2
"""Policies that a comparison begins with: they already show a difference, and a third is one choice away."""


def best_first(db: Session, participant: Participant, policies: Sequence[Policy], caller: Caller) -> list[Policy]:
    """Policies by what the ranking says of them, as `ordered` has it; as given where there is no ranking."""
    try:
        return ordered(policies, current(db, participant, caller).answer)
    except NotFound:
        return list(policies)


def ordered(policies: Sequence[Policy], answered: Answer) -> list[Policy]:
    """What may be planned, what to test first; then what acts like cDBS, and what is not advised; each behaviour once before any twice.

    Policies that the ranking does not hold come last, as given.
    """
    distinct = (*answered.rows, *answered.like_cdbs, *answered.like_off)
    heads = [r.one.policy.id for r in sorted(distinct, key=lambda r: r.decided.needs_override)]
    places = {i: k for k, i in enumerate(dict.fromkeys((*heads, *answered.everyone())))}
    return sorted(policies, key=lambda p: places.get(p.id, len(places)))


def other_than(policy: Policy, policies: Sequence[Policy], answered: Answer | None) -> Policy | None:
    """The best of some policies to hold one against: of another behaviour where there is one; None where there is no other."""
    heads = answered.heads() if answered is not None else {}
    others = [p for p in (ordered(policies, answered) if answered is not None else policies) if p.id != policy.id]
    unlike = (p for p in others if heads.get(p.id, p.id) != heads.get(policy.id, policy.id))
    return next(unlike, others[0] if others else None)
