"""One hierarchical model of the end-of-session outcomes and r_end, for all methods of off-policy evaluation.

Grasp, rating and tremor follow the minutes of a session (`regressions`); r_end is C2 grasp + C3 rating - C4 tremor of what is predicted, so
that a session without one QoC still counts for the others. Draws are those of one joint posterior: draw d of two policies shares its
coefficients, and what the model gets wrong for both cancels in their difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.ope.estimate import OUTCOMES
from ml.ope.outcomes.medication import worn_off
from ml.ope.outcomes.minutes import ABOVE, BETA, Minutes, of_buffer
from ml.ope.outcomes.regressions import ORDER, WIDER, Left, Outcome, Regression, Sessions, burden_of, fit
from ml.ope.scale import FEWEST_OUTCOMES, outcome_table
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

COLUMN: dict[Outcome, int] = {"grasp": 1, "rating": 2, "tremor": 3}
"""Place of an outcome in `ml.ope.estimate.OUTCOMES`; r_end is 0."""

RANGES = {1: (0.0, np.inf), 2: (1.0, 10.0), 3: (0.0, 100.0)}
"""Possible grasp (Hz), rating and tremor (%)."""


@dataclass(frozen=True)
class LeftOut:
    """What is said of sessions that are left out; columns are r_end, grasp, rating and tremor.

    Attributes:
        predicted: [n, 4]; NaN where there is none.
        mean: what to say without a model, [n, 4]: the mean of the sessions, for a left-out visit that of the other visits; NaN where none
            is known.
        residual: root mean squared error, [4]; of sessions 0 where unseen, of visits NaN where unseen or where there is one visit.
        skill: 1 - squared error / that of saying the mean, [4]; NaN where unseen.
    """

    predicted: Floats
    mean: Floats
    residual: Floats
    skill: Floats


@dataclass(frozen=True)
class EndModel:
    """Outcomes of sessions; columns of every result are r_end, grasp, rating and tremor in their units.

    Attributes:
        constants: r_end = constants . (grasp, rating, tremor), [3].
        regressions: of the outcomes that enough sessions have. unseen: mean of the others' few sessions, 0 without one, [4].
        centre, spread: of beta and of the share above the threshold between sessions, [2].
        sessions: of the buffer.
        draws: D.
        seen: outcomes that are predicted; r_end where every QoC that counts in it is, or where none counts.
        by_session: predictions of sessions from all others; ratings given the tremor that the session had. by_visit: from the other visits,
            as a day to come is predicted.
        day_share: share of an outcome's unexplained variance that sessions of one visit have in common, [4]; NaN where unseen.
    """

    constants: Floats
    regressions: dict[Outcome, Regression]
    unseen: Floats
    centre: Floats
    spread: Floats
    sessions: Sessions
    draws: int
    seen: tuple[bool, ...]
    by_session: LeftOut
    by_visit: LeftOut
    day_share: Floats

    def predict(self, minutes: Minutes, own: Sessions | None = None) -> Floats:
        """Posterior mean [..., 4] of sessions of any leading shape on a new day; with `own` their last axis is those sessions."""
        burden = burden_of(minutes, self.centre, self.spread)
        result = self._unseen(minutes.share.shape[:-1])
        tremor: Floats | None = None
        for outcome, r in self.ordered():
            mean = np.zeros(minutes.share.shape[:-1])
            for weight, member in zip(r.weights, r.members, strict=True):
                mean += weight * r.mean(member, minutes, burden, tremor, own)
            tremor = mean if outcome == "tremor" else tremor
            result[..., COLUMN[outcome]] = 100 * mean if outcome == "tremor" else mean
        return self.joined(result)

    def each(self, minutes: Minutes, own: Sessions | None = None) -> Floats:
        """The same by every draw: sessions [..., D, n] (the d-th by draw d) or [..., 1, n] (all by all); [..., D, n, 4].

        Raises:
            ValueError: the model has no draws, or the sessions are those of another number of them.
        """
        *lead, given, n = minutes.share.shape[:-1]
        if self.draws == 0 or given not in (1, self.draws):
            raise ValueError(f"sessions of {given} draws for an outcome model of {self.draws}")
        result = self._unseen((*lead, self.draws, n))
        for d in range(self.draws):
            k = d if given > 1 else 0
            one = Minutes(minutes.features[..., k, :, :, :], minutes.share[..., k, :, :], minutes.late[..., k, :, :])
            burden = burden_of(one, self.centre, self.spread)
            tremor: Floats | None = None
            for outcome, r in self.ordered():
                mean = r.mean(r.drawn[d], one, burden, tremor, own)
                tremor = mean if outcome == "tremor" else tremor
                result[..., d, :, COLUMN[outcome]] = 100 * mean if outcome == "tremor" else mean
        return self.joined(result)

    def carried(self, predicted: Floats, known: Floats, seen: Floats) -> Floats:
        """Outcomes [..., n, 4] of sessions under another policy, where what each session had of its own stays with it.

        A share y that was s on average becomes y p / s where p < s and y + (1 - y)(p - s) / (1 - s) where p > s: what is left on
        average is p, the range is kept, and p = s gives back y. (Of a yes or no this is the same uniform number held against s and p.)

        Args:
            predicted: under the other policy, [..., n, 4]. known: measured, [n, 4], NaN where not. seen: prediction of the session as it
                was, [..., n, 4].
        """
        result = predicted.copy()
        for column, (low, high) in RANGES.items():
            y = known[:, column] - low
            p, s = (np.maximum(v[..., column] - low, 0.0) for v in (predicted, seen))
            less = y * np.minimum(p / np.maximum(s, 1e-12), 1.0)
            room = (high - low - y) / np.maximum(high - low - s, 1e-12) if np.isfinite(high) else 1.0
            found = np.where(p <= s, less, y + room * (p - s))
            result[..., column] = np.where(np.isfinite(y), found + low, predicted[..., column])
        return self.joined(result)

    def part(self, first: int, number: int) -> EndModel:
        """The same model with some of its draws; with none of them for `number` 0."""
        chosen = {name: replace(r, drawn=r.drawn[first : first + number]) for name, r in self.regressions.items()}
        return replace(self, regressions=chosen, draws=number)

    def joined(self, outcomes: Floats) -> Floats:
        """The outcomes with r_end made of the three QoCs."""
        outcomes[..., 0] = outcomes[..., 1:] @ self.constants if self.seen[0] else self.unseen[0]
        return outcomes

    def predictability(self) -> dict[str, dict[str, float | None]]:
        """Errors and skill of left-out sessions and visits, JSON-able, by outcome: those that are predicted, r_end where a QoC counts."""
        return {
            name: {
                "session_error": _rounded(self.by_session.residual[j]),
                "session_skill": _rounded(self.by_session.skill[j]),
                "visit_error": _rounded(self.by_visit.residual[j]),
                "visit_skill": _rounded(self.by_visit.skill[j]),
            }
            for j, name in enumerate(OUTCOMES)
            if self.seen[j] and (j > 0 or self.constants.any())
        }

    @property
    def shape_evidence(self) -> dict[Outcome, Floats]:
        """Log evidence of the dose shapes of every outcome, [K], by these data alone."""
        return {outcome: r.shape_evidence for outcome, r in self.regressions.items()}

    def ordered(self) -> list[tuple[Outcome, Regression]]:
        """The regressions in the order in which they are predicted."""
        return [(outcome, self.regressions[outcome]) for outcome in ORDER if outcome in self.regressions]

    def _unseen(self, shape: tuple[int, ...]) -> Floats:
        return np.broadcast_to(self.unseen, (*shape, 4)).copy()


def fit_end_model(
    buffer: ReplayBuffer,
    draws: int = 0,
    seed: int = 0,
    severity: Floats | None = None,
    wider: float = WIDER,
    shape_priors: Mapping[Outcome, Floats] | None = None,
) -> EndModel:
    """Fit to all sessions.

    A controller that follows beta gives more in a bad hour, so that more stimulation seems to do worse. What it gives depends on beta
    alone: with the level of beta that is not the amplitude's doing beside the amplitude, such sessions compare like with like (the
    back-door criterion of Pearl 1995).

    Args:
        draws: D draws of the posterior besides its mean. seed: theirs.
        severity: that level of every session, [n], where the caller's model of beta knows it; it is adjusted for and no policy moves it.
        wider: factor on the spread of draws; 1 where the caller adds what models get wrong by itself.
        shape_priors: log prior of the dose shapes of an outcome, [K] (`pooling`); flat of those that have none.
    """
    settings, table, minutes = buffer.settings, outcome_table(buffer), of_buffer(buffer)
    means = minutes.means[:, [BETA, ABOVE]]
    centre, spread = means.mean(0), means.std(0)
    spread = np.where(spread > 1e-9, spread, 1.0)
    _, visit = np.unique([s.visit for s in buffer.sessions], return_inverse=True)
    adjusted = {} if severity is None else {"severity": _standardised(severity)}
    sessions = Sessions(visit.astype(np.int64), adjusted | worn_off(buffer))
    burden, rng = burden_of(minutes, centre, spread), np.random.default_rng([seed, 0xE2D])
    size = np.array([max(1.0, s.steps * settings.period_s / 60.0) for s in buffer.sessions])
    constants = _constants(settings)
    known = np.isfinite(table).sum(0)
    regressions: dict[Outcome, Regression] = {}
    for outcome in ORDER:
        column = COLUMN[outcome]
        if known[column] < FEWEST_OUTCOMES:
            continue
        y = table[:, column] / (100.0 if outcome == "tremor" else 1.0)
        tremor: Floats | None = None
        said: Floats | None = None
        if outcome == "rating" and "tremor" in regressions:
            tremor = _filled(table[:, 3] / 100.0)
            said = _put(tremor, regressions["tremor"])
        prior = (shape_priors or {}).get(outcome)
        regressions[outcome] = fit(outcome, y, minutes, burden, tremor, sessions, size, draws, wider, rng, said, prior)
    seen = (
        all(outcome in regressions or constants[column - 1] == 0 for outcome, column in COLUMN.items()),
        *(outcome in regressions for outcome in ("grasp", "rating", "tremor")),
    )
    unseen = np.array([float(np.nanmean(column)) if np.isfinite(column).any() else 0.0 for column in table.T])
    by_session, by_visit = (_left_out(how, table, regressions, constants, seen, visit) for how in ("session", "visit"))
    share = np.full(4, np.nan)
    for outcome, r in regressions.items():
        share[COLUMN[outcome]] = r.day_share
    return EndModel(constants, regressions, unseen, centre, spread, sessions, draws, seen, by_session, by_visit, share)


def _constants(settings: MdpSettings) -> Floats:
    """C2, C3, -C4 per percent of tremor."""
    return np.array([settings.c2, settings.c3, -settings.c4 / (100.0 if settings.tremor_as_fraction else 1.0)])


def _standardised(severity: Floats) -> Floats:
    level = severity - severity.mean()
    return np.asarray(level / max(float(level.std()), 1e-9), dtype=np.float64)


def _filled(values: Floats) -> Floats:
    return np.where(np.isfinite(values), values, np.nanmean(values))


def _put(values: Floats, r: Regression) -> Floats:
    """Values of all sessions, [n], with what a regression says of left-out visits, where it says something."""
    result, said = values.copy(), r.left_out["visit"]
    result[r.sessions] = np.where(np.isfinite(said), said, values[r.sessions])
    return result


def _left_out(
    how: Left,
    table: Floats,
    regressions: Mapping[Outcome, Regression],
    constants: Floats,
    seen: tuple[bool, ...],
    visit: NDArray[np.int64],
) -> LeftOut:
    predicted = np.full(table.shape, np.nan)
    for outcome, r in regressions.items():
        predicted[r.sessions, COLUMN[outcome]] = r.left_out[how] * (100.0 if outcome == "tremor" else 1.0)
    counted = np.flatnonzero(constants) + 1
    predicted[:, 0] = predicted[:, counted] @ constants[counted - 1]
    rest = [visit != v if how == "visit" else np.ones(len(visit), dtype=bool) for v in visit]
    mean = np.array([[_mean(column[others]) for column in table.T] for others in rest])
    skill, residual = np.full(4, np.nan), np.zeros(4) if how == "session" else np.full(4, np.nan)
    for j in range(4):
        both = np.isfinite(table[:, j]) & np.isfinite(predicted[:, j]) & np.isfinite(mean[:, j])
        if not seen[j] or not both.any():
            continue
        error, without = (float(np.mean((table[both, j] - values[both, j]) ** 2)) for values in (predicted, mean))
        residual[j], skill[j] = np.sqrt(error), 1 - error / without if without > 0 else 0.0
    return LeftOut(predicted, mean, residual, skill)


def _mean(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
