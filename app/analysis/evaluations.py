"""Methods of evaluation over seeds on one buffer snapshot, against what the policies returned afterwards."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from app.accounts.permissions import Caller
from app.evaluation.ranking.results import DrivenSession, driven_sessions, results_by_policy
from app.study import repository as study
from app.study.settings import mdp_settings
from app.tables.evaluations import EstimateRow, Evaluation
from app.tables.learning import BufferSnapshot, SnapshotSession
from app.tables.participants import Participant
from ml.ope import accuracy, shown

# Queries of evaluations by seed.


def evaluations(db: Session, participant_id: int) -> Sequence[Evaluation]:
    """Load a participant's evaluations with their estimates less the details of these, oldest first."""
    query = select(Evaluation).where(Evaluation.participant_id == participant_id).order_by(Evaluation.id)
    wanted = selectinload(Evaluation.estimates).load_only(EstimateRow.policy_id, EstimateRow.method, EstimateRow.value)
    return db.scalars(query.options(wanted)).all()


def sessions_of_snapshot(db: Session, snapshot_id: int) -> set[int]:
    """Return the sessions that a snapshot rests on, excluded ones too: their outcomes could be seen."""
    return set(db.scalars(select(SnapshotSession.session_id).where(SnapshotSession.snapshot_id == snapshot_id)))


# How well each method did on one snapshot, by seed: estimates against the returns of later sessions. Source: Gao et al. 2023, figure 5.

WANTED_SEEDS = 3
LEAST_POLICIES = 2


@dataclass(frozen=True)
class SeedRow:
    """One method under one seed.

    Attributes:
        mae: mean absolute error, reward. mae_of_range, rank_correlation, regret_of_range: None where the returns or estimates are equal.
    """

    method: str
    name: str
    seed: int
    evaluation_id: int
    policies: int
    mae: float
    mae_of_range: float | None
    rank_correlation: float | None
    regret_of_range: float | None


@dataclass(frozen=True)
class BySeed:
    """The snapshot with most seeds under one horizon, settings version and preset, newest first among equals.

    Attributes:
        snapshot_id: None without an evaluation. seeds: that were run on it. rows: where later sessions have returns.
        policies: estimated under every seed, with a return after the snapshot (the errors are of these).
        sessions: ids of the sessions after the snapshot that those returns are of.
    """

    participant: str
    snapshot_id: int | None
    seeds: tuple[int, ...]
    policies: int
    rows: tuple[SeedRow, ...]
    sessions: tuple[int, ...] = ()


def by_seed(db: Session, participant: Participant, caller: Caller) -> BySeed:
    """Compute the errors of every method and seed on one snapshot; raises Forbidden as `app.study.blinding`."""
    alike: dict[tuple[int, int, int, str], dict[int, Evaluation]] = defaultdict(dict)
    for one in evaluations(db, participant.id):
        # Seeds are compared where nothing else differs. Returns under another horizon or settings are other numbers; a quick estimate is
        # not one of full size
        key = (one.snapshot_id, one.settings_version_id, one.horizon_steps, str(one.config.get("preset", "")))
        alike[key][int(one.config.get("seed", 0))] = one
    if not alike:
        return BySeed(participant.code, None, (), 0, ())
    chosen = max(alike, key=lambda k: (min(len(alike[k]), WANTED_SEEDS), k[0], max(e.id for e in alike[k].values())))
    snapshot_id, seeds = chosen[0], alike[chosen]
    everywhere = set.intersection(*({e.policy_id for e in one.estimates} for one in seeds.values()))
    later = _later_sessions(db, seeds[min(seeds)], caller)
    returns = {i: value for i, value in _returns(db, seeds[min(seeds)], later).items() if i in everywhere}
    behind = tuple(s.session_id for s in later if s.policy_id in returns)
    rows: list[SeedRow] = []
    if len(returns) >= LEAST_POLICIES:
        rows = [row for seed in sorted(seeds) for row in _rows(seeds[seed], seed, returns)]
    return BySeed(participant.code, snapshot_id, tuple(sorted(seeds)), len(returns), tuple(rows), behind)


def _later_sessions(db: Session, evaluation: Evaluation, caller: Caller) -> list[DrivenSession]:
    """Return the sessions of policies that are not in the snapshot."""
    seen = sessions_of_snapshot(db, evaluation.snapshot_id)
    return [s for s in driven_sessions(db, db.get_one(BufferSnapshot, evaluation.snapshot_id), caller) if s.session_id not in seen]


def _returns(db: Session, evaluation: Evaluation, ran: list[DrivenSession]) -> dict[int, float]:
    """Average the return of sessions by policy, under the evaluation's settings, horizon and discount."""
    settings = mdp_settings(study.settings_version(db, evaluation.settings_version_id))
    results = results_by_policy(ran, settings, evaluation.horizon_steps, None)
    return {i: r.mean_return for i, r in results.items() if r.mean_return is not None}


def _rows(evaluation: Evaluation, seed: int, returns: dict[int, float]) -> Sequence[SeedRow]:
    estimates: dict[str, dict[int, float]] = defaultdict(dict)
    for e in evaluation.estimates:
        if e.policy_id in returns:
            estimates[e.method][e.policy_id] = e.value
    found = []
    for method, values in estimates.items():
        if len(values) < LEAST_POLICIES:
            continue
        ids = sorted(values)
        a = accuracy([returns[i] for i in ids], np.array([values[i] for i in ids]))
        if a.mae is not None:
            numbers = (a.mae, a.mae_of_range, a.rank_correlation, a.regret_of_range)
            found.append(SeedRow(method, shown(method).short, seed, evaluation.id, len(ids), *numbers))
    return found
