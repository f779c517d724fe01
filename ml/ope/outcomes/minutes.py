"""What the outcomes of a session are predicted from: dose and burden of beta, minute by minute."""

from __future__ import annotations

from collections.abc import Sequence
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

AMPLITUDE, ENERGY, OVER, BETA, ABOVE, DOSE = range(6)
FEATURES: Final = 5 + len(SHAPES)
"""Features of a step: a, a^2, over-stimulation, beta, beta at or above the threshold, and the dose by each of `SHAPES`."""


def effects(a: Floats) -> Floats:
    """Dose by each of `SHAPES`, 0 without stimulation and 1 at the amplitude of cDBS; a of any shape, [..., len(SHAPES)]."""
    square = a * a
    fourth = square * square
    result = np.empty((*a.shape, len(SHAPES)))
    result[..., 0] = a
    for k, (half, steep) in enumerate(SHAPES[1:], start=1):
        power, level = (square, half**2) if steep == 2 else (fourth, half**4)
        result[..., k] = (1 + level) * power / (level + power)
    return result


def step_features(beta: Floats, amplitude: Floats, xi_beta: float) -> Floats:
    """`FEATURES` of steps, [..., F]; the amplitude cut to [0, 1]. NaN where beta or amplitude is."""
    a = np.clip(amplitude, 0.0, 1.0)
    over = np.maximum(0.0, a * a - TOLERATED) / (1 - TOLERATED)
    above = np.where(np.isfinite(beta), np.asarray(beta) >= xi_beta, np.nan)
    return np.concatenate([np.stack([a, a * a, over, beta, above], axis=-1), effects(a)], axis=-1)


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
        """Sessions of which only means over the whole are known, [..., F]: one minute that stands for all."""
        ones = np.ones((*means.shape[:-1], 1))
        return cls(means[..., None, :], ones, ones)

    @property
    def means(self) -> Floats:
        """Means over the session, [..., F]."""
        return np.asarray(np.einsum("...m,...mf->...f", self.share, self.features), dtype=np.float64)


def by_minute(beta: Floats, amplitude: Floats, settings: MdpSettings) -> Minutes:
    """Sessions by minute, counted from the end, so that the last one is whole.

    Args:
        beta: unit of the buffer, [..., T]. amplitude: fraction, [..., T]. Steps where either is NaN are left out.
    """
    shape, steps = beta.shape[:-1], beta.shape[-1]
    bounds = minute_bounds(steps, settings.period_s)
    features, counts = np.zeros((*shape, len(bounds), FEATURES)), np.zeros((*shape, len(bounds)))
    # minute by minute: all features of all steps at once would be gigabytes for replays of many draws
    for m, (i, j) in enumerate(bounds):
        found = step_features(beta[..., i:j], amplitude[..., i:j], settings.xi_beta)
        known = np.isfinite(beta[..., i:j]) & np.isfinite(amplitude[..., i:j])
        counts[..., m] = known.sum(-1)
        if known.all():
            features[..., m, :] = found.mean(-2)
        else:
            total = np.where(known[..., None], found, 0.0).sum(-2)
            features[..., m, :] = total / np.maximum(counts[..., m, None], 1.0)
    return with_shares(features, counts)


def minute_bounds(steps: int, period_s: float) -> list[tuple[int, int]]:
    """First step and end of every minute; the first minute may be shorter."""
    per = max(1, round(MINUTE_S / period_s))
    ends = list(range(steps, 0, -per))[::-1]
    return [(max(0, end - per), end) for end in ends]


def with_shares(features: Floats, counts: Floats) -> Minutes:
    """Minutes of sessions from means over their steps [..., M, F] and numbers of known steps [..., M]."""
    last = np.where(np.arange(counts.shape[-1]) >= counts.shape[-1] - LATE_MINUTES, counts, 0.0)
    return Minutes(features, _shares(counts), _shares(np.where(last.sum(-1, keepdims=True) > 0, last, counts)))


def of_buffer(buffer: ReplayBuffer) -> Minutes:
    """All sessions of a buffer, [n, M, ...]; shorter ones have minutes of share 0 at their beginning."""
    parts = [by_minute(s.beta, s.amplitude, buffer.settings) for s in buffer.sessions]
    longest = max(p.share.shape[-1] for p in parts)

    def stacked(arrays: Sequence[Floats]) -> Floats:
        return np.stack([np.pad(x, [(longest - len(x), 0)] + [(0, 0)] * (x.ndim - 1)) for x in arrays])

    return Minutes(stacked([p.features for p in parts]), stacked([p.share for p in parts]), stacked([p.late for p in parts]))


def _shares(counts: Floats) -> Floats:
    total = counts.sum(-1, keepdims=True)
    return np.asarray(np.where(total > 0, counts / np.maximum(total, 1e-300), 1 / counts.shape[-1]), dtype=np.float64)
