"""Joint draws of what policies return, spend and do to symptoms, out of replays in all structures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.ope.estimate import OUTCOMES
from ml.ope.flags import Flag
from ml.ope.observed import mean_over_days
from ml.ope.outcomes.model import EndModel
from ml.ope.posterior.constants import COMMON_SHARE, MODEL_ERRORS, ModelError, error_unit
from ml.ope.posterior.gaussian import correlated
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

KEPT = 400
"""Draws that are kept, aligned over policies and quantities."""


STATISTICAL = "return without model errors"
"""Among the quantities of `Draws`: the return as structures, coefficients and days alone spread it."""


@dataclass(frozen=True)
class Replays:
    """Sessions under policies in all structures: P policies, D draws, n sessions.

    Attributes:
        step_return, energy, amplitude, beta: [P, D, n]. outcomes: [P, D, n, 4]. weights: of the draws, [D], summing to 1.
        summaries: `support.SUMMARIES` of each policy, [P, 4]. behaviour: see `FittedPosterior`, by policy.
    """

    step_return: Floats
    energy: Floats
    amplitude: Floats
    beta: Floats
    outcomes: Floats
    weights: Floats
    summaries: Floats
    behaviour: tuple[dict[str, float], ...]


@dataclass(frozen=True)
class Draws:
    """Draws [P, KEPT] by quantity: `steps`, `r_end`, `return`, `energy` and the QoCs that sessions have.

    `STATISTICAL` is the return without what structures get wrong: tested sessions move it with the others, so that the rest of either error
    is known.

    Attributes:
        between_visits: standard deviation of a policy's true difference to cDBS between visits, by quantity.
        unknown: a flag where days cannot be distinguished.
    """

    values: dict[str, Floats]
    between_visits: dict[str, float]
    unknown: Flag | None


def joint_draws(
    buffer: ReplayBuffer,
    replays: Replays,
    ends: EndModel,
    alike: Floats,
    leverage: Floats,
    horizon: int,
    seed: int,
    model_errors: Mapping[str, ModelError] = MODEL_ERRORS,
    common_share: float = COMMON_SHARE,
) -> Draws:
    """Draw coefficients and structures, the days that were not seen, and of what the structures get wrong.

    Args:
        replays: P policies, cDBS last. ends: model of r_end. alike: correlation of what structures get wrong, [P, P]. leverage: [P].
        horizon: steps. seed: of the draws. model_errors, common_share: of `constants`.
    """
    settings = buffer.settings
    visits = np.array([s.visit for s in buffer.sessions])
    parts = {"steps": replays.step_return, "energy": replays.energy}
    parts |= {name: replays.outcomes[..., j] for j, name in enumerate(OUTCOMES) if j and ends.seen[j]}
    constants = ends.constants if ends.seen[0] else None
    total = replays.step_return + (replays.outcomes[..., 0] if ends.seen[0] else 0.0)
    days = mean_over_days(np.einsum("pdn,d->pn", total, replays.weights), visits, KEPT, seed)
    rng = np.random.default_rng([seed, 0x9057])
    picked = systematic(replays.weights, KEPT, rng)
    reach = float(np.sum(settings.gamma ** np.arange(horizon))) * abs(settings.r_a - settings.r_b)
    drawn, between, exact = {}, {}, {}
    for name, values in parts.items():
        base, over_draws = values @ days.weights, np.einsum("pdn,d->pn", values, replays.weights)
        own = mean_over_days(over_draws, visits, KEPT, seed)
        rows = base[:, picked] + common_share * own.common + own.own
        # what was picked has a mean of its own: the draws keep that of all
        rows += (base @ replays.weights - rows.mean(1))[:, None]
        exact[name] = rows
        if name in model_errors:
            sd = error_unit(name, rows.mean(1), reach) * np.array([model_errors[name].sd(v) for v in leverage])
            rows = rows + correlated(alike, sd, KEPT, rng)
        drawn[name] = rows
        between[name] = _between_visits(over_draws - over_draws[-1], visits)
    drawn["r_end"] = _end_rewards(drawn, constants)
    drawn["return"] = drawn["steps"] + drawn["r_end"]
    drawn[STATISTICAL] = exact["steps"] + _end_rewards(exact, constants)
    between["return"] = _between_visits(np.einsum("pdn,d->pn", total - total[-1], replays.weights), visits)
    return Draws(drawn, between, days.unknown)


def _end_rewards(drawn: Mapping[str, Floats], constants: Floats | None) -> Floats:
    """Compute r_end of every draw, [P, KEPT], from its QoCs; 0 without constants."""
    none = np.zeros_like(drawn["steps"])
    if constants is None:
        return none
    return np.asarray(np.einsum("k,kpd->pd", constants, np.stack([drawn.get(name, none) for name in OUTCOMES[1:]])), dtype=np.float64)


def systematic(weights: Floats, number: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw indices [number] in random order, each about weight times number often (systematic resampling)."""
    at = (np.arange(number) + rng.random()) / number
    picked = np.minimum(np.searchsorted(np.cumsum(weights / weights.sum()), at), weights.size - 1)
    return rng.permutation(picked)


def _between_visits(gaps: Floats, visits: NDArray[np.int64]) -> float:
    """Compute the root mean squared standard deviation between visits of differences [P, n], over policies; 0 with one visit."""
    means = np.stack([gaps[:, visits == v].mean(1) for v in np.unique(visits)])
    return float(np.sqrt(np.mean(means.var(0, ddof=1)))) if len(means) > 1 else 0.0
