"""Joint draws of what policies return, spend and do to symptoms, out of replays in all structures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.ope.estimate import OUTCOMES
from ml.ope.flags import Flag
from ml.ope.observed import mean_over_days
from ml.ope.outcomes.model import EndModel
from ml.ope.posterior.constants import COMMON_SHARE
from ml.ope.posterior.gaussian import JITTER, correlated
from ml.ope.posterior.learned.evidence import UNITS
from ml.ope.posterior.learned.networks import Differences, Learned
from ml.ope.posterior.replays import Replays
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

KEPT = 400
"""Draws that are kept, aligned over policies and quantities."""


@dataclass(frozen=True)
class Draws:
    """Draws [P, KEPT] by quantity: `steps`, `r_end`, `return`, `energy` and the QoCs that sessions have.

    Attributes:
        between_visits: standard deviation of a policy's true difference to cDBS between visits, by quantity.
        unknown: a flag where days cannot be told apart.
    """

    values: dict[str, Floats]
    between_visits: dict[str, float]
    unknown: Flag | None


def joint_draws(
    buffer: ReplayBuffer,
    replays: Replays,
    ends: EndModel,
    differences: Differences,
    constants: Learned,
    alike: Floats,
    seed: int,
    reach: float,
) -> Draws:
    """Draws of the level under cDBS on days that were not seen, of energies, and of differences to cDBS.

    Args:
        replays: P policies, cDBS last. ends: model of r_end. differences: of the policies. constants: what errors have in common.
        alike: correlation of errors of the policies, [P, P]. seed: of the draws. reach: return that is lost above the threshold throughout.
    """
    visits = np.array([s.visit for s in buffer.sessions])
    parts = {"steps": replays.step_return}
    parts |= {name: replays.outcomes[..., j] for j, name in enumerate(OUTCOMES) if j and ends.seen[j]}
    weighed = {name: np.einsum("pdn,d->pn", values, replays.weights) for name, values in parts.items()}
    ended = np.einsum("pdn,d->pn", replays.outcomes[..., 0], replays.weights) if ends.seen[0] else 0.0
    total = weighed["steps"] + ended
    days = mean_over_days(total, visits, KEPT, seed)
    rng = np.random.default_rng([seed, 0x9057])
    drawn = {"energy": _energies(replays, days.weights, visits, seed, rng)}
    between = {}
    noise = _noises(alike, constants.together, rng)
    for name, over_draws in weighed.items():
        q, unit = list(UNITS).index(name), reach if name == "steps" else UNITS[name]
        size = level_sd(over_draws[-1], visits, unit, q, constants, seed)
        level = over_draws[-1] @ days.weights + size * _level_noise(noise[:-1, q], constants.level_against[q], rng)
        gaps = unit * (differences.mean[:, q, None] + differences.sd[:, q, None] * noise[:, q])
        drawn[name] = level + gaps
        between[name] = _between_visits(over_draws - over_draws[-1], visits)
    if ends.seen[0]:
        qoc = [drawn.get(name, np.zeros_like(drawn["steps"])) for name in OUTCOMES[1:]]
        drawn["r_end"] = np.einsum("k,kpd->pd", ends.constants, np.stack(qoc))
    drawn.setdefault("r_end", np.zeros_like(drawn["steps"]))
    drawn["return"] = drawn["steps"] + drawn["r_end"]
    between["return"] = _between_visits(total - total[-1], visits)
    energies = np.einsum("pdn,d->pn", replays.energy, replays.weights)
    between["energy"] = _between_visits(energies - energies[-1], visits)
    return Draws(drawn, between, days.unknown)


def level_sd(under_cdbs: Floats, visits: NDArray[np.int64], unit: float, quantity: int, constants: Learned, seed: int) -> float:
    """Standard deviation of the level of new days under cDBS: that of a mean over few days, and one of its own in units."""
    common = float(mean_over_days(under_cdbs[None], visits, KEPT, seed).common.std())
    return float(np.hypot(constants.level_common[quantity] * common, unit * constants.level_own[quantity]))


def _level_noise(noise: Floats, against: float, rng: np.random.Generator) -> Floats:
    """Standard normal draws [KEPT] with a correlation to what the policies' noises [P, KEPT] have in common."""
    shared, own = noise.mean(0), rng.standard_normal(KEPT)
    both = against * shared / max(float(shared.std()), 1e-9) + np.sqrt(1 - against**2) * (own - own.mean()) / own.std()
    return np.asarray(both - both.mean(), dtype=np.float64)


def _energies(replays: Replays, weights: Floats, visits: NDArray[np.int64], seed: int, rng: np.random.Generator) -> Floats:
    """Mean squared amplitudes [P, KEPT]: draws of coefficients and of days."""
    base, over_draws = replays.energy @ weights, np.einsum("pdn,d->pn", replays.energy, replays.weights)
    own = mean_over_days(over_draws, visits, KEPT, seed)
    rows = base[:, systematic(replays.weights, KEPT, rng)] + COMMON_SHARE * own.common + own.own
    # what was picked has a mean of its own: the draws keep that of all
    return np.asarray(rows + (base @ replays.weights - rows.mean(1))[:, None], dtype=np.float64)


def _noises(alike: Floats, together: Floats, rng: np.random.Generator) -> Floats:
    """Standard normal draws [P, 4, KEPT], correlated over policies and over quantities."""
    rows = np.stack([correlated(alike, np.ones(len(alike)), KEPT, rng) for _ in range(len(together))], axis=1)
    lower = np.linalg.cholesky(together + JITTER * np.eye(len(together)))
    rows = np.einsum("qr,prd->pqd", lower, rows)
    return np.asarray(rows / rows.std(-1, keepdims=True), dtype=np.float64)


def systematic(weights: Floats, number: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices [number] in random order, each about weight times number often (systematic resampling)."""
    at = (np.arange(number) + rng.random()) / number
    picked = np.minimum(np.searchsorted(np.cumsum(weights / weights.sum()), at), weights.size - 1)
    return rng.permutation(picked)


def _between_visits(gaps: Floats, visits: NDArray[np.int64]) -> float:
    """Root mean squared standard deviation between visits of differences [P, n], over policies; 0 with one visit."""
    means = np.stack([gaps[:, visits == v].mean(1) for v in np.unique(visits)])
    return float(np.sqrt(np.mean(means.var(0, ddof=1)))) if len(means) > 1 else 0.0
