"""Each controller against the cDBS sessions of the same visit: primary results, sensitivity, the verdict on its locked margins."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis import evidence
from app.analysis.evidence import Evidence
from app.analysis.facts import METRICS, BetaKind, Facts, choose, comparable_beta, of_controller, with_comparable_beta
from app.analysis.primary_results import ControllerResult, results
from app.analysis.primary_verdict import LockedMargins, VerdictResult, confirmed_policies, earlier_verdicts, policy_verdicts, verdicts
from app.platform.errors import NotFound
from app.platform.kept import kept
from app.study.margins import declarations, margins_of
from app.study.recordings.controller_log import CONTROLLER_OF_KIND
from app.tables.learning import Policy
from app.tables.participants import Participant
from app.tables.plans import Plan, PlanItem
from app.tables.sessions import LEARNED, Controller
from ml.outcomes import BY_KEY
from ml.statistics.power import Power, Target, power
from ml.statistics.within_visits.contrasts import Unavailable
from ml.statistics.within_visits.mixed_models import MixedComparison, linear_comparison, minutes_comparison, ordinal_comparison

# Queries of the primary analyses: names of policies, and when each was last picked for a visit.


def find_policy_names(db: Session, participant_ids: Collection[int]) -> dict[int, dict[int, str]]:
    """Return names of the participants' policies: by participant, then by policy."""
    found: dict[int, dict[int, str]] = {i: {} for i in participant_ids}
    for mine, policy, name in db.execute(select(Policy.participant_id, Policy.id, Policy.name).where(Policy.participant_id.in_(found))):
        found[mine][policy] = name
    return found


def last_picked(db: Session, participant_ids: Collection[int]) -> dict[int, dict[int, datetime]]:
    """Find when each policy was last put on an approved plan, by participant: what was known then may have picked it."""
    found: dict[int, dict[int, datetime]] = {i: {} for i in participant_ids}
    rows = db.execute(
        select(Policy.participant_id, PlanItem.policy_id, func.max(Plan.created_at))
        .join(Plan, Plan.id == PlanItem.plan_id)
        .join(Policy, Policy.id == PlanItem.policy_id)
        .where(Policy.participant_id.in_(found), Plan.approved_at.is_not(None))
        .group_by(Policy.participant_id, PlanItem.policy_id)
    )
    for mine, policy, moment in rows:
        if policy is not None:
            found[mine][policy] = moment
    return found


# Primary results of a participant: each controller against the same visit's cDBS, and the verdict on its margins.


@dataclass(frozen=True)
class Primary:
    """Results of one participant.

    Attributes:
        evidence: the sessions, and the excluded ones. sessions: those that count, with comparable beta. beta_kind: which beta that is.
        results: controllers, then policies. verdicts: of the learned controllers. locked: the margins that they go by.
        earlier: verdicts under the locks before, oldest first.
    """

    evidence: Evidence
    sessions: tuple[Facts, ...]
    beta_kind: BetaKind | None
    results: tuple[ControllerResult, ...]
    verdicts: tuple[VerdictResult, ...]
    locked: LockedMargins
    earlier: tuple[VerdictResult, ...]

    @property
    def controllers(self) -> tuple[ControllerResult, ...]:
        return tuple(r for r in self.results if r.tested.policy_id is None)

    @property
    def policies(self) -> tuple[ControllerResult, ...]:
        return tuple(r for r in self.results if r.tested.policy_id is not None)


def primary(db: Session, participant: Participant, caller: Caller) -> Primary:
    """Compute the primary results, as the caller may know them; errors as in `app.study.blinding`."""
    return of_all(db, [participant], evidence.of_all(db, [participant], caller))[0]


def of_all(db: Session, participants: Sequence[Participant], held: Sequence[Evidence]) -> list[Primary]:
    """Compute the primary results of several participants, whose evidence is `held`."""
    ids = [p.id for p in participants]
    names, picked, declared = find_policy_names(db, ids), last_picked(db, ids), declared_margins(db, ids)
    for i, of_participant in declared.items():  # a declared confirmation counts whatever is planned afterwards
        picked[i] |= {policy: margins.declared_at for policy, margins in of_participant.items() if margins.declared_at is not None}
    return [_of(h, locked_margins(p), names[p.id], picked[p.id]) for p, h in zip(participants, held, strict=True)]


def _of(held: Evidence, locks: Sequence[LockedMargins], names: Mapping[int, str], picked: Mapping[int, datetime]) -> Primary:
    *before, locked = locks
    key = ("primary", held.key, tuple(locks), tuple(sorted(names.items())), tuple(sorted(picked.items())))

    def compute() -> Primary:
        kind = comparable_beta(held.sessions, held.beta_unit, held.beta_source)
        sessions = with_comparable_beta(held.sessions, kind)
        earlier = tuple(earlier_verdicts(sessions, _tested(sessions), before, held.failed))
        return Primary(held, sessions, kind, results(sessions, names, picked), _verdicts(held, locked), locked, earlier)

    return kept(key, compute)


def verdicts_of(db: Session, participant: Participant, caller: Caller) -> tuple[VerdictResult, ...]:
    """Return only the verdicts of `primary`, for pages that show no comparison: those of forty policies take many times as long."""
    return verdicts_on(evidence.of_all(db, [participant], caller)[0], participant)


def verdicts_on(facts: Evidence, participant: Participant) -> tuple[VerdictResult, ...]:
    """Compute the verdicts on evidence that is already loaded."""
    return _verdicts(facts, locked_margins(participant)[-1])


def declared_margins(db: Session, participant_ids: Collection[int]) -> dict[int, dict[int, LockedMargins]]:
    """Return the margins of every declared confirmation, by participant and policy."""
    return {
        participant_id: {
            row.policy_id: LockedMargins(
                margins_of(row.lock.margins),
                row.lock.margins.version,
                row.lock.created_at,
                row.lock.created_by,
                row.lock.reason,
                declared_at=row.created_at,
                declared_by=row.created_by,
            )
            for row in rows
        }
        for participant_id, rows in declarations(db, participant_ids).items()
    }


def confirmed_policies_of(db: Session, facts: Evidence) -> dict[int, VerdictResult]:
    """Return by policy the verdict on the sessions after its confirmation was declared."""
    declared = declared_margins(db, [facts.participant_id])[facts.participant_id]
    if not declared:
        return {}
    kinds = db.execute(select(Policy.id, Policy.kind).where(Policy.id.in_(declared)))
    controllers = {i: CONTROLLER_OF_KIND.get(kind, Controller.RL) for i, kind in kinds}

    def compute() -> dict[int, VerdictResult]:
        sessions = with_comparable_beta(facts.sessions, comparable_beta(facts.sessions, facts.beta_unit, facts.beta_source))
        return confirmed_policies(sessions, controllers, declared, facts.failed)

    return kept(("confirmed policies", facts.key, tuple(declared.items())), compute)


def policy_verdicts_of(facts: Evidence, participant: Participant) -> dict[int, VerdictResult]:
    """Return by policy the verdict on its own sessions, by the margins in force."""
    locked = locked_margins(participant)[-1]

    def compute() -> dict[int, VerdictResult]:
        sessions = with_comparable_beta(facts.sessions, comparable_beta(facts.sessions, facts.beta_unit, facts.beta_source))
        return policy_verdicts(sessions, locked, facts.failed)

    return kept(("policy verdicts", facts.key, locked), compute)


@dataclass(frozen=True)
class PolicyVerdict:
    """The verdict on one policy by itself."""

    policy_id: int
    name: str
    result: VerdictResult


def policies_judged(db: Session, facts: Evidence, participant: Participant) -> list[PolicyVerdict]:
    """Return the verdicts on each policy by itself: the confirmatory one where it was declared, then the exploratory one."""
    names = policy_names(db, participant)
    confirmed, explored = confirmed_policies_of(db, facts), policy_verdicts_of(facts, participant)
    judged = sorted(confirmed.keys() | explored.keys())
    return [PolicyVerdict(i, names[i], found[i]) for i in judged for found in (confirmed, explored) if i in found]


def _verdicts(held: Evidence, locked: LockedMargins) -> tuple[VerdictResult, ...]:
    def compute() -> tuple[VerdictResult, ...]:
        sessions = with_comparable_beta(held.sessions, comparable_beta(held.sessions, held.beta_unit, held.beta_source))
        return tuple(verdicts(sessions, _tested(sessions), locked, held.failed))

    return kept(("verdicts", held.key, locked), compute)


def _tested(sessions: Sequence[Facts]) -> list[Controller]:
    """List controllers that have a verdict."""
    return [c for c in LEARNED if any(s.controller is c for s in sessions)]


def locked_margins(participant: Participant) -> tuple[LockedMargins, ...]:
    """Return the margins of every lock, oldest first; those in force come last, locked or not."""
    if not participant.margins_locks:
        return (LockedMargins(margins_of(participant.margins_in_force), participant.margins_in_force.version, None, None),)
    until = [*(lock.created_at for lock in participant.margins_locks[1:]), None]
    return tuple(
        LockedMargins(margins_of(lock.margins), lock.margins.version, lock.created_at, lock.created_by, lock.reason, end)
        for lock, end in zip(participant.margins_locks, until, strict=True)
    )


def result_of(found: Primary, key: str) -> ControllerResult:
    """Return the result of a controller (`rl`) or policy (`policy-7`). Raises NotFound."""
    result = next((r for r in found.results if r.tested.key == key), None)
    if result is None:
        raise NotFound(f"Participant {found.evidence.participant} has no sessions of '{key}' that count.", "Choose one from the analyses.")
    return result


MixedFits = tuple[tuple[str, MixedComparison | Unavailable], ...]


def mixed_models(found: Primary, controller: Controller) -> MixedFits:
    """Fit mixed models by metric, policies nested in the controller, of the kind that an outcome's record names. Slow: up to 0.3 s."""
    return kept(("mixed", found.evidence.key, controller), lambda: tuple((m, _fit(found.sessions, m, controller)) for m in METRICS))


def policy_names(db: Session, participant: Participant) -> dict[int, str]:
    """Return names of a participant's policies."""
    return find_policy_names(db, [participant.id])[participant.id]


def _fit(sessions: Sequence[Facts], metric: str, controller: Controller) -> MixedComparison | Unavailable:
    chosen = choose(sessions, metric, of_controller(controller))
    policies = chosen.policy if len({int(p) for p in chosen.policy[chosen.data.tested]}) > 1 else None
    model = BY_KEY[metric].model if metric in BY_KEY else "linear"
    if model == "ordinal":
        return ordinal_comparison(chosen.data, policies)
    if model == "minutes":
        minutes = np.array([s.duration_s / 60 for s in chosen.sessions])
        counted = replace(chosen.data, value=chosen.data.value / 100 * minutes)
        return minutes_comparison(counted, minutes, policies)
    return linear_comparison(chosen.data, policies)


def next_visits(found: Primary, controller: Controller, sessions_per_arm: int) -> tuple[tuple[str, Power | Unavailable], ...]:
    """Estimate the power of the primary test after each number of further visits, by metric: simulated from the posterior of both
    variances.
    """

    def compute() -> tuple[tuple[str, Power | Unavailable], ...]:
        tested = of_controller(controller)
        return tuple((m, power(choose(found.sessions, m, tested).data, Target(), sessions_per_arm=sessions_per_arm)) for m in METRICS)

    return kept(("power", found.evidence.key, controller, sessions_per_arm), compute)
