"""Standardisation learnt from a buffer, its end-of-session outcomes as one table, and groups of sessions to leave out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.ope.estimate import OUTCOMES
from ml.outcomes import OUTCOMES as RECORDS
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]

FEWEST_OUTCOMES = 3
"""Sessions that must have an outcome before anything is predicted about it."""


@dataclass(frozen=True)
class Scale:
    """Standardisation learnt from a buffer.

    Attributes:
        log: True when beta enters as its logarithm: all valid amplitudes are positive and their logarithm is less skewed.
        beta_mean, beta_std: of (log) beta. beta_low, beta_high: range of the raw beta, participant's unit.
        reward_mean, reward_std: of the usable rewards.
        outcome_mean, outcome_std: of `OUTCOMES`, each; 0 and 1 where the outcome is not seen. The deviation is 0 where
            all sessions have the same value, which is then the prediction.
        outcome_seen: which of `OUTCOMES` at least `FEWEST_OUTCOMES` sessions have.
    """

    log: bool
    beta_mean: float
    beta_std: float
    beta_low: float
    beta_high: float
    reward_mean: float
    reward_std: float
    outcome_mean: tuple[float, ...]
    outcome_std: tuple[float, ...]
    outcome_seen: tuple[bool, ...]

    def beta(self, raw: NDArray[Any]) -> Floats:
        """Convert the participant's unit to standardised."""
        values = np.asarray(raw, dtype=np.float64)
        if self.log:
            values = np.log(np.maximum(values, 1e-3 * self.beta_low))
        return (values - self.beta_mean) / self.beta_std

    def raw_beta(self, scaled: NDArray[Any]) -> Floats:
        """Convert standardised values to the participant's unit."""
        values = np.asarray(scaled, dtype=np.float64) * self.beta_std + self.beta_mean
        return np.exp(values) if self.log else values

    def to_json(self) -> dict[str, Any]:
        """Return all numbers, by name."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Scale:
        """Read what `to_json` made."""
        fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**fields)


def outcome_table(buffer: ReplayBuffer) -> Floats:
    """Stack `OUTCOMES` of every session, shape [n, K]; NaN where not measured. Where none has a weight r_end is 0 for all, measured or
    not."""
    settings = buffer.settings
    weighted = any(o.end is not None and o.end.weight(settings) for o in RECORDS)
    rows = []
    for s in buffer.sessions:
        qoc, end = s.counted_qoc, s.end_reward(settings) if weighted else 0.0
        rows.append([np.nan if v is None else float(v) for v in (end, *(getattr(qoc, name) for name in OUTCOMES[1:]))])
    return np.array(rows, dtype=np.float64)


def learn_scale(buffer: ReplayBuffer) -> Scale:
    """Learn the standardisation of a buffer. Raises ValueError when it has no usable step."""
    beta = np.concatenate([s.measured_beta for s in buffer.sessions])
    beta = beta[np.isfinite(beta)]
    rewards = buffer.transitions().rewards
    log = bool(beta.min() > 0) and abs(_skewness(np.log(np.maximum(beta, 1e-300)))) < abs(_skewness(beta))
    shown = np.log(beta) if log else beta
    outcomes = outcome_table(buffer)
    seen = [bool(np.isfinite(outcomes[:, j]).sum() >= FEWEST_OUTCOMES) for j in range(len(OUTCOMES))]
    mean = np.array([outcomes[np.isfinite(outcomes[:, j]), j].mean() if seen[j] else 0.0 for j in range(len(OUTCOMES))])
    std = np.array([outcomes[np.isfinite(outcomes[:, j]), j].std() if seen[j] else 1.0 for j in range(len(OUTCOMES))])
    return Scale(
        log=log,
        beta_mean=float(shown.mean()),
        beta_std=_positive(float(shown.std()), float(np.abs(shown).max())),
        beta_low=float(beta.min()),
        beta_high=float(beta.max()),
        reward_mean=float(rewards.mean()),
        reward_std=_positive(float(rewards.std()), float(np.abs(rewards).max())),
        outcome_mean=tuple(float(v) for v in mean),
        outcome_std=tuple(float(v) if v > 1e-12 else 0.0 for v in std),
        outcome_seen=tuple(seen),
    )


def session_folds(sessions: Sequence[SessionTrajectory], folds: int, seed: int) -> list[list[int]]:
    """Split the sessions into `folds` groups of indices, every kind of controller spread over the groups as evenly as it goes."""
    order = np.random.default_rng(seed).permutation(len(sessions))
    ranked = sorted(order.tolist(), key=lambda i: sessions[i].controller)
    return [sorted(ranked[k::folds]) for k in range(min(folds, len(sessions)))]


def _skewness(values: Floats) -> float:
    centred = values - values.mean()
    spread = float(np.sqrt(np.mean(centred**2)))
    return float(np.mean(centred**3)) / spread**3 if spread > 0 else 0.0


def _positive(deviation: float, largest: float) -> float:
    """Return a standard deviation; 1 where it is only the rounding of values up to the largest."""
    return deviation if deviation > 1e-12 * largest else 1.0
