"""One hierarchical model of the end-of-session outcomes and r_end, for all methods of off-policy evaluation.

Outcomes follow the minutes of a session (`regressions`). r_end is the weighted sum of their predictions, so that a session without one
outcome still counts for the others. Draws are those of one joint posterior. Draw d of two policies shares its coefficients, so that a
common error of the model cancels in their difference.
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
from ml.ope.outcomes.regressions import FOLLOWING, LEADING, ORDER, PERCENT, WIDER, Left, Outcome, Regression, Sessions, burden_of, fit
from ml.ope.scale import FEWEST_OUTCOMES, outcome_table
from ml.outcomes import PREDICTED
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

COLUMN: dict[Outcome, int] = {o.key: OUTCOMES.index(o.field) for o, _ in PREDICTED}
"""Place of an outcome in `ml.ope.estimate.OUTCOMES`; r_end is 0."""

RANGES = {COLUMN[o.key]: o.limits for o, _ in PREDICTED}
"""Possible values of the outcome in a column, in its unit."""


@dataclass(frozen=True)
class LeftOut:
    """Predictions of held-out sessions; columns are `OUTCOMES`.

    Attributes:
        predicted: [n, 4]; NaN where there is none.
        mean: prediction without a model, [n, K]: the mean of the sessions, for a held-out visit that of the other visits. NaN where none is
            known.
        residual: root mean squared error, [K]; of sessions 0 where unseen, of visits NaN where unseen or where there is one visit.
        skill: 1 - squared error / that of saying the mean, [K]; NaN where unseen.
    """

    predicted: Floats
    mean: Floats
    residual: Floats
    skill: Floats


@dataclass(frozen=True)
class EndModel:
    """Outcomes of sessions; columns of every result are the K `OUTCOMES` in their units.

    Attributes:
        constants: r_end = constants . outcomes, [K - 1].
        regressions: of the outcomes that enough sessions have. unseen: mean of the others' few sessions, 0 without one, [K].
        centre, spread: of beta and of the share above the threshold between sessions, [2].
        sessions: of the buffer.
        draws: D.
        seen: outcomes that are predicted; r_end where every QoC that counts in it is, or where none counts.
        by_session: predictions of sessions from all others; an outcome that follows another is given that of the session. by_visit: from
            the other visits, as a future day is predicted.
        day_share: share of an outcome's unexplained variance that sessions of one visit have in common, [K]; NaN where unseen.
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
        """Compute the posterior mean [..., K] of sessions of any leading shape on a new day; with `own` their last axis is those
        sessions."""
        burden = burden_of(minutes, self.centre, self.spread)
        result = self._unseen(minutes.share.shape[:-1])
        leading: Floats | None = None
        for outcome, r in self.ordered():
            mean = np.zeros(minutes.share.shape[:-1])
            for weight, member in zip(r.weights, r.members, strict=True):
                mean += weight * r.mean(member, minutes, burden, leading, own)
            leading = mean if outcome == LEADING else leading
            result[..., COLUMN[outcome]] = PERCENT[outcome] * mean
        return self.joined(result)

    def each(self, minutes: Minutes, own: Sessions | None = None) -> Floats:
        """Compute the same by every draw: sessions [..., D, n] (the d-th by draw d) or [..., 1, n] (all by all); [..., D, n, K].

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
            leading: Floats | None = None
            for outcome, r in self.ordered():
                mean = r.mean(r.drawn[d], one, burden, leading, own)
                leading = mean if outcome == LEADING else leading
                result[..., d, :, COLUMN[outcome]] = PERCENT[outcome] * mean
        return self.joined(result)

    def carried(self, predicted: Floats, known: Floats, seen: Floats) -> Floats:
        """Predict outcomes [..., n, K] of sessions under another policy, where what each session had of its own stays with it.

        A share y that was s on average becomes y p / s where p < s. It becomes y + (1 - y)(p - s) / (1 - s) where p > s. The average is
        then p, the range is kept, and p = s gives back y. (For a yes or no this compares one uniform number with s and with p.)

        Args:
            predicted: under the other policy, [..., n, K]. known: measured, [n, K], NaN where not. seen: prediction of the session as it
                was, [..., n, K].
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
        """Return the same model with some of its draws; with none of them for `number` 0."""
        chosen = {name: replace(r, drawn=r.drawn[first : first + number]) for name, r in self.regressions.items()}
        return replace(self, regressions=chosen, draws=number)

    def joined(self, outcomes: Floats) -> Floats:
        """Append r_end, made of the outcomes, to them."""
        outcomes[..., 0] = outcomes[..., 1:] @ self.constants if self.seen[0] else self.unseen[0]
        return outcomes

    def predictability(self) -> dict[str, dict[str, float | None]]:
        """Summarise errors and skill of held-out sessions and visits, JSON-able, by outcome: those that are predicted, r_end where a QoC
        counts."""
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
        """List the regressions in the order in which they are predicted."""
        return [(outcome, self.regressions[outcome]) for outcome in ORDER if outcome in self.regressions]

    def _unseen(self, shape: tuple[int, ...]) -> Floats:
        return np.broadcast_to(self.unseen, (*shape, len(OUTCOMES))).copy()


def fit_end_model(
    buffer: ReplayBuffer,
    draws: int = 0,
    seed: int = 0,
    severity: Floats | None = None,
    wider: float = WIDER,
    shape_priors: Mapping[Outcome, Floats] | None = None,
) -> EndModel:
    """Fit to all sessions.

    A controller that follows beta gives more in a bad hour, so that more stimulation seems to do worse. Its amplitude depends on beta
    alone. The model also has the level of beta that the amplitude does not cause. Such sessions then compare like with like (the back-door
    criterion of Pearl 1995).

    Args:
        draws: D draws of the posterior besides its mean. seed: theirs.
        severity: that level of every session, [n], where the caller's model of beta knows it; it is adjusted for and no policy moves it.
        wider: factor on the spread of draws; 1 where the caller adds what models get wrong by itself.
        shape_priors: log prior of the dose shapes of an outcome, [K] (`pooling`); flat of those that have none.
    """
    settings, table, minutes = buffer.settings, outcome_table(buffer), of_buffer(buffer)
    means = minutes.means[:, [BETA, ABOVE]]
    centre, spread = means.mean(0), means.std(0)
    spread = np.where(spread > 1e-9 * np.abs(means).max(0), spread, 1.0)  # beta may have any unit
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
        y = table[:, column] / PERCENT[outcome]
        leading: Floats | None = None
        said: Floats | None = None
        if outcome == FOLLOWING and LEADING in regressions:
            leading = _filled(table[:, COLUMN[LEADING]] / PERCENT[LEADING])
            said = _put(leading, regressions[LEADING])
        prior = (shape_priors or {}).get(outcome)
        regressions[outcome] = fit(outcome, y, minutes, burden, leading, sessions, size, draws, wider, rng, said, prior)
    seen = (
        all(outcome in regressions or constants[column - 1] == 0 for outcome, column in COLUMN.items()),
        *(outcome in regressions for outcome in COLUMN),
    )
    unseen = np.array([float(np.nanmean(column)) if np.isfinite(column).any() else 0.0 for column in table.T])
    by_session, by_visit = (_left_out(how, table, regressions, constants, seen, visit) for how in ("session", "visit"))
    share = np.full(len(OUTCOMES), np.nan)
    for outcome, r in regressions.items():
        share[COLUMN[outcome]] = r.day_share
    return EndModel(constants, regressions, unseen, centre, spread, sessions, draws, seen, by_session, by_visit, share)


def _constants(settings: MdpSettings) -> Floats:
    """Return what one unit of each predicted outcome adds to r_end, [K - 1]."""
    return np.array([o.end.per_unit(settings) if o.end is not None else 0.0 for o, _ in PREDICTED])


def _standardised(severity: Floats) -> Floats:
    level = severity - severity.mean()
    return np.asarray(level / max(float(level.std()), 1e-9), dtype=np.float64)


def _filled(values: Floats) -> Floats:
    return np.where(np.isfinite(values), values, np.nanmean(values))


def _put(values: Floats, r: Regression) -> Floats:
    """Return the values of all sessions, [n], with the predictions of held-out visits where there are any."""
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
        predicted[r.sessions, COLUMN[outcome]] = r.left_out[how] * PERCENT[outcome]
    counted = np.flatnonzero(constants) + 1
    predicted[:, 0] = predicted[:, counted] @ constants[counted - 1]
    rest = [visit != v if how == "visit" else np.ones(len(visit), dtype=bool) for v in visit]
    mean = np.array([[_mean(column[others]) for column in table.T] for others in rest])
    skill, residual = np.full(len(OUTCOMES), np.nan), np.full(len(OUTCOMES), 0.0 if how == "session" else np.nan)
    for j in range(len(OUTCOMES)):
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
