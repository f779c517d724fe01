"""Predictors of a session's outcomes: dose and burden of beta, minute by minute."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ml.mdp import MdpSettings
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

MINUTE_S: Final = 60.0
LATE_MINUTES: Final = 2
"""Minutes before the end that a grasp test follows most."""

TOLERATED: Final = 0.6
"""Squared amplitude above which stimulation counts as over-stimulation (ours; cDBS is 1)."""

HALVES: Final = (0.3, 0.5, 0.7, 0.9)
"""Amplitudes of half effect."""

SHAPES: Final[tuple[tuple[float, int], ...]] = ((0.0, 1), *((half, steep) for half in HALVES for steep in (2, 4)))
"""Dose shapes as (amplitude of half effect, steepness): the line, and Emax (Hill) curves that saturate early to late."""

ENERGY, OVER, BETA, ABOVE, DOSE = range(5)
AMPLITUDE: Final = DOSE
FEATURES: Final = DOSE + len(SHAPES)
"""Features of a step: a^2, over-stimulation, beta, beta at or above the threshold, and the dose by each of `SHAPES`, a the first of them.
All but beta lie within [0, 1] and those of the amplitude grow with it."""


def each_feature(beta: Floats, amplitude: Floats, xi_beta: float) -> Iterator[Floats]:
    """Yield the `FEATURES` of steps one after the other, each of the shape of beta; the amplitude is cut to [0, 1]."""
    a = np.clip(amplitude, 0.0, 1.0)
    square = a * a
    yield square
    yield np.maximum(0.0, square - TOLERATED) / (1 - TOLERATED)
    yield beta
    yield (beta >= xi_beta).astype(np.float64)
    yield a
    fourth = square * square
    for half, steep in SHAPES[1:]:
        power, level = (square, half**2) if steep == 2 else (fourth, half**4)
        yield (1 + level) * (1 - level / (level + power))


def step_features(beta: Floats, amplitude: Floats, xi_beta: float) -> Floats:
    """Compute `FEATURES` of steps, [..., F]; beta and amplitude must be known."""
    return np.stack(list(each_feature(beta, amplitude, xi_beta)), axis=-1)


@dataclass(frozen=True)
class Minutes:
    """Sessions by minute; any leading shape.

    Attributes:
        features: means of `step_features` over the known steps of a minute, [..., M, F]; 0 where it has none.
        share: of each minute in the session's known steps, [..., M], sums to 1.
        late: the same within the last `LATE_MINUTES`, [..., M], sums to 1.
    """

    features: Floats
    share: Floats
    late: Floats

    @classmethod
    def of_means(cls, means: Floats) -> Minutes:
        """Make sessions of which only means over the whole are known, [..., F]: one minute that represents all."""
        ones = np.ones((*means.shape[:-1], 1))
        return cls(means[..., None, :], ones, ones)

    @property
    def means(self) -> Floats:
        """Means over the session, [..., F]."""
        return np.asarray(np.einsum("...m,...mf->...f", self.share, self.features), dtype=np.float64)


def by_minute(beta: Floats, amplitude: Floats, settings: MdpSettings) -> Minutes:
    """Split sessions into minutes, counted from the end, so that the last one is whole.

    Args:
        beta: unit of the buffer, [..., T]. amplitude: fraction, [..., T]. Steps where either is NaN are ignored.
    """
    shape, steps = beta.shape[:-1], beta.shape[-1]
    bounds = minute_bounds(steps, settings.period_s)
    features, counts = np.zeros((*shape, len(bounds), FEATURES)), np.zeros((*shape, len(bounds)))
    # minute by minute: all features of all steps at once would be gigabytes for replays of many draws
    for m, (i, j) in enumerate(bounds):
        b, a = np.ascontiguousarray(beta[..., i:j]), np.ascontiguousarray(amplitude[..., i:j])
        known = (np.isfinite(b) & np.isfinite(a)).astype(np.float64)
        counts[..., m] = known.sum(-1)
        share = known / np.maximum(counts[..., m, None], 1.0)
        b, a = np.where(known > 0, b, 0.0), np.where(known > 0, a, 0.0)
        for k, values in enumerate(each_feature(b, a, settings.xi_beta)):
            np.einsum("...t,...t->...", values, share, out=features[..., m, k])
    return with_shares(features, counts)


def minute_bounds(steps: int, period_s: float) -> list[tuple[int, int]]:
    """List first step and end of every minute; the first minute may be shorter."""
    per = max(1, round(MINUTE_S / period_s))
    ends = list(range(steps, 0, -per))[::-1]
    return [(max(0, end - per), end) for end in ends]


def with_shares(features: Floats, counts: Floats) -> Minutes:
    """Make minutes of sessions from means over their steps [..., M, F] and numbers of known steps [..., M]."""
    last = np.where(np.arange(counts.shape[-1]) >= counts.shape[-1] - LATE_MINUTES, counts, 0.0)
    return Minutes(features, _shares(counts), _shares(np.where(last.sum(-1, keepdims=True) > 0, last, counts)))


def of_buffer(buffer: ReplayBuffer) -> Minutes:
    """Stack all sessions of a buffer, [n, M, ...]; shorter ones have minutes of share 0 at their beginning."""
    longest = max(s.steps for s in buffer.sessions)
    beta, amplitude = (np.full((len(buffer.sessions), longest), np.nan) for _ in range(2))
    for i, session in enumerate(buffer.sessions):
        beta[i, longest - session.steps :], amplitude[i, longest - session.steps :] = session.beta, session.amplitude
    return by_minute(beta, amplitude, buffer.settings)


def _shares(counts: Floats) -> Floats:
    total = counts.sum(-1, keepdims=True)
    return np.asarray(np.where(total > 0, counts / np.maximum(total, 1e-300), 1 / counts.shape[-1]), dtype=np.float64)
