"""Checks of what the data can say about a policy, made before any estimate is shown; a failing one is named."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from ml.ope.doses import memories
from ml.ope.estimate import checked_horizon
from ml.ope.flags import Flag
from ml.ope.fqe.steps import UsableSteps, usable_steps
from ml.ope.importance import ImportanceSampling, horizon_of_ten
from ml.ope.support.coverage import (
    FEW_EFFECTIVE,
    NEIGHBOUR_SHARE,
    NEIGHBOURHOOD,
    NOTICE_SHARE,
    UNSUPPORTED_SHARE,
    AmplitudeSupport,
    Coverage,
    effective_sample_size,
    few_effective,
)
from ml.policies.policy import Policy
from ml.progress import Report, silent
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

FAR = 2.0
"""Factor that makes a pair (s, pi(s)) far: no logged pair is within so many times the distance that 95 % of the logged pairs keep."""

FAR_SHARE = 0.20
"""Above this share of far pairs a policy is not supported by the data."""

LEAVES_SHARE = 0.20
"""Above this share of steps outside the logged amplitudes a policy is not supported by the data."""

MOST_PAIRS = 4000


Verdict = Literal["passed", "refused", "weights", "noted", "told"]


@dataclass(frozen=True)
class Check:
    """One check of one policy, with the limit that was in force.

    Attributes:
        name: `outside_range`, `thin`, `far`, `below_random_bound`, `unseen_dose` (shares of steps), `distance` (95 % of the logged pairs
            are within 1), `effective_sessions`, `largest_weight_share` (share), `horizon_of_ten` (steps).
        value: None where it is unknown.
        limit: what the value is compared with; None where it has none.
        at_least: whether the limit is the least value that passes; else it is the greatest.
        verdict: `refused`: the data cannot speak about the policy. `weights`: importance weights cannot, models may. `noted`: to be known
            before a policy is picked, and no refusal. `told`: a number without a limit.
    """

    name: str
    value: float | None
    limit: float | None
    at_least: bool
    verdict: Verdict


@dataclass(frozen=True)
class Diagnostics:
    """Coverage of one policy.

    Attributes:
        amplitudes: shares of steps outside the logged amplitudes and where they are thin.
        sessions, horizon_steps: sessions with importance weights, and the H that these are over.
        effective_sessions, largest_weight_share: of the importance weights over the horizon.
        horizon_of_ten: steps until the running weights fall below ten effective sessions.
        random_bound: B, the random controller's lower bound; None without random sessions.
        below_random_bound: share of steps that ask for less than B; None without random sessions.
        distance: median distance of (s, pi(s)) to the nearest logged pair of another session; 95 % of the logged pairs are within 1.
        far: share of pairs beyond `FAR`.
        unseen_dose: share of steps whose average amplitude of the last minute no session has come near. Random amplitudes
            cover every amplitude and yet one dose alone: what a lasting low one does is then a model's guess.
        failing: checks that make the policy unsupported for methods that predict. weights_failing: those that concern importance weights
            alone.
    """

    amplitudes: Coverage
    sessions: int
    horizon_steps: int
    effective_sessions: float
    largest_weight_share: float
    horizon_of_ten: int
    random_bound: float | None
    below_random_bound: float | None
    distance: float
    far: float
    unseen_dose: float
    failing: tuple[Flag, ...]
    weights_failing: tuple[Flag, ...]

    @property
    def checks(self) -> tuple[Check, ...]:
        """Every check with its limit, those that can refuse a policy first."""
        thin = _refusal("thin", self.amplitudes.thin, UNSUPPORTED_SHARE)
        if thin.verdict == "passed" and self.amplitudes.thin > NOTICE_SHARE:
            thin = replace(thin, verdict="noted")
        return (
            _refusal("outside_range", self.amplitudes.outside_range, LEAVES_SHARE),
            thin,
            _refusal("far", self.far, FAR_SHARE),
            _note("below_random_bound", self.below_random_bound),
            _note("unseen_dose", self.unseen_dose),
            Check("distance", self.distance, None, False, "told"),
            _weights("effective_sessions", self.effective_sessions, FEW_EFFECTIVE),
            Check("largest_weight_share", self.largest_weight_share, None, False, "told"),
            _weights("horizon_of_ten", self.horizon_of_ten, self.horizon_steps),
        )

    @property
    def notes(self) -> tuple[Flag, ...]:
        """Facts to know though they make no policy unsupported."""
        found = []
        if self.below_random_bound is not None and self.below_random_bound > NOTICE_SHARE:
            found.append(Flag.of("below_random_bound", self.below_random_bound, NOTICE_SHARE, "share", bound=self.random_bound))
        if self.unseen_dose > NOTICE_SHARE:
            found.append(Flag("unseen_dose", self.unseen_dose, NOTICE_SHARE, "share"))
        return tuple(found)

    @property
    def supported(self) -> bool:
        """True where methods that predict may estimate the policy."""
        return not self.failing

    def to_json(self) -> dict[str, Any]:
        """Return all numbers, by name, every check and every flag."""
        flags = {"failing": self.failing, "notes": self.notes, "weights_failing": self.weights_failing}
        shown = {name: [flag.to_json() for flag in found] for name, found in flags.items()}
        return asdict(self) | shown | {"supported": self.supported, "checks": [asdict(c) for c in self.checks]}


def _refusal(name: str, value: float, limit: float) -> Check:
    return Check(name, value, limit, False, "refused" if value > limit else "passed")


def _note(name: str, value: float | None) -> Check:
    return Check(name, value, NOTICE_SHARE, False, "told" if value is None else "noted" if value > NOTICE_SHARE else "passed")


def _weights(name: str, value: float, limit: float) -> Check:
    return Check(name, float(value), float(limit), True, "passed" if value >= limit else "weights")


def diagnose(
    buffer: ReplayBuffer, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent
) -> dict[str, Diagnostics]:
    """Check every policy. Raises ValueError when the buffer has no usable step or no session with a complete s_0."""
    horizon = checked_horizon(buffer, horizon_steps)
    support, table = AmplitudeSupport(buffer), usable_steps(buffer)
    weights = ImportanceSampling("wis").fit(buffer)
    near = _Neighbours(table)
    bounds = [s.random_bound for s in buffer.sessions if s.random_bound is not None]
    result = {}
    for k, (name, policy) in enumerate(policies.items()):
        report(k / len(policies), "checking what the data cover")
        log_ratio, mask, _ = weights.log_ratios(policy, horizon)
        effective, largest = effective_sample_size(np.where(mask, log_ratio, 0.0).sum(1))
        amplitudes = support.of_policy(policy)
        distances = near.of(policy)
        far = float(np.mean(distances > FAR))
        below = float(np.mean(policy.act(table.states) < min(bounds) - 1e-9)) if bounds else None
        result[name] = Diagnostics(
            amplitudes=amplitudes,
            sessions=len(mask),
            horizon_steps=horizon,
            effective_sessions=effective,
            largest_weight_share=largest,
            horizon_of_ten=horizon_of_ten(log_ratio, mask),
            random_bound=min(bounds) if bounds else None,
            below_random_bound=below,
            distance=float(np.median(distances)),
            far=far,
            unseen_dose=near.unseen_dose(policy),
            failing=_failing(amplitudes, far),
            weights_failing=() if effective >= FEW_EFFECTIVE else (few_effective("weights_need_sessions", effective, len(mask)),),
        )
    return result


def _failing(amplitudes: Coverage, far: float) -> tuple[Flag, ...]:
    found = []
    if amplitudes.outside_range > LEAVES_SHARE:
        low, high = amplitudes.logged_low, amplitudes.logged_high
        found.append(Flag.of("outside_range", amplitudes.outside_range, LEAVES_SHARE, "share", refuses=True, low=low, high=high))
    elif not amplitudes.supported:
        found += [flag for flag in amplitudes.flags() if flag.refuses]
    if far > FAR_SHARE:
        found.append(Flag.of("far", far, FAR_SHARE, "share", refuses=True, times=FAR))
    return tuple(found)


class _Neighbours:
    """Nearest logged pairs of (level of beta, amplitude), each axis in its own spread; 95 % of the logged pairs are within 1."""

    def __init__(self, table: UsableSteps) -> None:
        keep = np.unique(np.linspace(0, len(table.actions) - 1, MOST_PAIRS).astype(np.int64))
        self._states, self._session = table.states[keep], table.session[keep]
        levels = self._levels(table, self._states)
        self._spread = np.append(levels.std(0), table.actions.std())
        self._spread[self._spread <= 1e-9 * np.append(np.abs(levels).max(0), 1.0)] = 1.0  # beta may have any unit
        self._points = np.column_stack([levels, table.actions[keep]]) / self._spread
        self._levels_kept = levels
        self._trees = {
            int(i): (scipy.spatial.cKDTree(self._points[self._session != i]) if np.any(self._session != i) else None)
            for i in np.unique(self._session)
        }
        self._table, self._doses = table, np.sort(table.memory[:, 1])
        usual = float(np.quantile(self._distances(self._points), 0.95))
        self._unit = usual if usual > 0 else 1.0

    def of(self, policy: Policy) -> Floats:
        """Compute the distance of every state, with the policy's amplitude, to the nearest logged pair of another session."""
        actions = np.clip(policy.act(self._states.copy()), 0.0, 1.0)
        return self._distances(np.column_stack([self._levels_kept, actions]) / self._spread) / self._unit

    def unseen_dose(self, policy: Policy) -> float:
        """Compute the share of steps at a dose with hardly any logged dose near it, the policy acting on the logged windows in their
        order."""
        table, doses = self._table, []
        chosen = np.clip(policy.act(table.states.copy()), 0.0, 1.0)
        for i in np.unique(table.session):
            doses.append(memories(chosen[table.session == i])[:, 1])
        asked = np.concatenate(doses)
        near = np.searchsorted(self._doses, asked + NEIGHBOURHOOD, "right") - np.searchsorted(self._doses, asked - NEIGHBOURHOOD, "left")
        return float(np.mean(near < NEIGHBOUR_SHARE * self._doses.size))

    def _distances(self, points: Floats) -> Floats:
        result = np.zeros(len(points))
        for i, tree in self._trees.items():
            own = self._session == i
            if tree is not None:
                result[own] = tree.query(points[own])[0]
        return result

    @staticmethod
    def _levels(table: UsableSteps, states: Floats) -> Floats:
        window = table.scale.beta(states)
        return np.column_stack([window[:, -1], window.mean(1)])
