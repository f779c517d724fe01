"""Check of whether the data can order policies at all, before any order is shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from ml.ope.behaviour import controllers
from ml.ope.doses import held_amplitude
from ml.ope.outcomes.model import COLUMN, EndModel
from ml.ope.posterior.held_out import HeldOut
from ml.ope.scale import outcome_table
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

FEWEST = 6
"""Left-out sessions below which nothing is concluded from them."""
OPPOSITE = 2.0
"""An observed contrast of so many standard errors whose predicted sign is the other one is not reproduced."""
NO_BETTER, LEVELS, CONTRASTS = "no_better_than_equal", "levels_follow_dose", "contrasts_not_reproduced"
TOO_FEW = "too_few_left_out_sessions"
MARGIN = 2.0
"""Squared errors of held-out sessions must be smaller than those of calling all doses equal by so many of their standard errors. This is
asked of the reward by beta, or of one of the outcomes.

On part A of the virtual population (60 worlds of 21 sessions, `benchmarks/evaluation/verdicts.py`) an order is given in 82 % of the
worlds with stratified sessions and 77 % with the paper's. Where nothing answers to the amplitude it is given in 20 and 17 % of the data."""
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""How much of the level of a visit its other sessions may predict; the share that errs least counts."""
CHANCE = 0.001
"""Chance below which levels that go with the dose are no chance."""


@dataclass(frozen=True)
class Skill:
    """Skill of ordering.

    Attributes:
        `told`: False where the data give no reason to believe an order of policies. reasons: codes of what speaks against it.
        held_out_correlation: of predicted with observed reward of left-out sessions; None where there are too few or they do not differ.
    """

    told: bool
    reasons: tuple[str, ...]
    held_out_correlation: float | None

    def to_json(self) -> dict[str, Any]:
        """Return all fields, JSON-able."""
        return {"told": self.told, "reasons": list(self.reasons), "held_out_correlation": self.held_out_correlation}


def ordering_skill(buffer: ReplayBuffer, predictions: HeldOut, equal: Floats, ends: EndModel, levels: Floats) -> Skill:
    """Compare predictions of held-out sessions with calling all doses equal, and with contrasts between controllers.

    The reward of the amplitude's price is known and orders nothing by itself. The level of a visit, or of the window before a session,
    orders no doses either: the prediction that they are compared with has both. Beta may answer to nothing while outcomes do. Where an
    outcome of held-out sessions is predicted better than by its visit's level, that alone is skill. Outcomes are asked whether or not they
    count in r_end, because verdicts rest on each of them.

    Args:
        equal: mean reward of each left-out session where beta answers to no amplitude (`structures.no_answer`), as `predictions.predicted`.
        levels: what the structures leave of each session's beta once its doses are accounted for, [n].
    """
    keys = list(predictions.weights)
    predicted = np.sum([predictions.weights[k] * predictions.predicted[k] for k in keys], axis=0)
    seen = predictions.observed
    known = np.isfinite(predicted) & np.isfinite(seen)
    if known.sum() < FEWEST:
        return Skill(False, (TOO_FEW,), None)
    said, was = predicted[known], seen[known]
    correlation = float(np.corrcoef(said, was)[0, 1]) if min(said.std(), was.std()) > 1e-9 else None
    reasons = [] if _better(was, said, equal[known]) or _outcomes_told(buffer, ends) else [NO_BETTER]
    if _follow_dose(buffer, levels):
        reasons.append(LEVELS)
    if _contradicted(buffer, predicted, seen):
        reasons.append(CONTRASTS)
    return Skill(not reasons, tuple(reasons), correlation)


def _better(was: Floats, said: Floats, equal: Floats) -> bool:
    """Decide whether squared errors fall, session by session, by more than chance would let them."""
    gain = (was - equal) ** 2 - (was - said) ** 2
    return bool(gain.mean() > MARGIN * gain.std(ddof=1) / np.sqrt(gain.size))


def _outcomes_told(buffer: ReplayBuffer, ends: EndModel) -> bool:
    """Decide whether an outcome of held-out sessions is predicted better than by the other sessions, however much those of its visit
    count."""
    table, visits = outcome_table(buffer), np.array([s.visit for s in buffer.sessions])
    return any(_outcome_told(table[:, j], ends.by_session.predicted[:, j], visits) for j in COLUMN.values() if ends.seen[j])


def _outcome_told(found: Floats, predicted: Floats, visits: NDArray[np.int64]) -> bool:
    """Decide the same for one outcome [n], NaN where not measured, and its held-out predictions [n] for sessions of the visits [n]."""
    known = np.isfinite(found) & np.isfinite(predicted)
    if known.sum() < FEWEST:
        return False
    was, own_visits = found[known], visits[known]
    everyone, own = np.ones((was.size, was.size)), (own_visits[:, None] == own_visits).astype(np.float64)
    all_others, of_visit = (_mean_of_others(was, among) for among in (everyone, own))
    of_visit = np.where(np.isfinite(of_visit), of_visit, all_others)
    shrunk = [all_others + share * (of_visit - all_others) for share in SHARES]
    equal = min(shrunk, key=lambda values: float(np.mean((was - values) ** 2)))
    return _better(was, predicted[known], equal)


def _mean_of_others(values: Floats, among: Floats) -> Floats:
    """Average the other values of each value's group, [n], by a matrix of 0 and 1, [n, n]; NaN where it is alone."""
    others = among - np.eye(values.size)
    count = others.sum(1)
    return np.asarray(np.where(count > 0, others @ values / np.maximum(count, 1), np.nan), dtype=np.float64)


def _follow_dose(buffer: ReplayBuffer, levels: Floats) -> bool:
    """Decide whether levels of random sessions go with their mean dose within visits: then the answer to a dose is not what structures say.

    What a controller gives in answer to beta follows beta; random doses follow nothing.
    """
    random = [i for i, s in enumerate(buffer.sessions) if s.controller == "random" and s.usable().any()]
    visits = np.array([buffer.sessions[i].visit for i in random])
    if len(random) - np.unique(visits).size < FEWEST:
        return False
    dose, level = np.array([held_amplitude(buffer.sessions[i]).mean() for i in random]), levels[random]
    for v in np.unique(visits):
        dose[visits == v] -= dose[visits == v].mean()
        level[visits == v] -= level[visits == v].mean()
    freedom, size = len(random) - np.unique(visits).size - 1, float(np.sqrt((dose @ dose) * (level @ level)))
    r = float(dose @ level) / size if size > 1e-12 else 0.0
    return bool(2 * stdtr(freedom, -abs(r) * np.sqrt(freedom / max(1 - r**2, 1e-12))) < CHANCE)


def _contradicted(buffer: ReplayBuffer, predicted: Floats, seen: Floats) -> bool:
    """Decide whether a clear contrast between two controllers is predicted with the other sign."""
    arms = []
    for indices in controllers(buffer).values():
        own = np.array([i for i in indices if np.isfinite(predicted[i]) and np.isfinite(seen[i])])
        if own.size >= 2:
            arms.append((seen[own].mean(), seen[own].var(ddof=1) / own.size, predicted[own].mean()))
    for k, (mean, variance, said) in enumerate(arms):
        for other, other_variance, other_said in arms[:k]:
            gap, error = mean - other, float(np.sqrt(variance + other_variance))
            if abs(gap) > OPPOSITE * error and (said - other_said) * gap < 0 and abs(said - other_said) > error:
                return True
    return False
