"""What is known of a policy before learned constants are asked (`networks`): what structures say, and what tells how far to believe them.

All numbers are differences to cDBS, shares or counts, so that constants learned on one population can be applied to a person whose beta has
another unit. Each policy's numbers depend on no other policy that is evaluated with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.ope.estimate import OUTCOMES
from ml.ope.fqe.steps import held_amplitude
from ml.ope.outcomes.model import EndModel
from ml.ope.posterior.held_out import HeldOut
from ml.ope.posterior.learned.neighbours import contrasts
from ml.ope.posterior.replays import Replays
from ml.ope.posterior.support import SessionSupport
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

Parts = dict[str, Floats]

UNITS = {"steps": 1.0, "grasp_hz": 1.0, "rating": 3.0, "tremor_percent": 50.0}
"""Differences that would be large; those of `steps` are of the share of steps at or above the threshold, weighted as in the return."""
STRUCTURES = ("linear", "impulse", "modes")


@dataclass(frozen=True)
class Evidence:
    """Evidence on P policies, cDBS last.

    Attributes:
        parts: numbers by name, [P] each.
        expected: difference to cDBS by the structures, [P, 4], columns and units of `UNITS`. spread: its standard deviation over draws.
        known: whether a quantity is measured, [4].
    """

    parts: Parts
    expected: Floats
    spread: Floats
    known: NDArray[np.bool_]


def reach_of(buffer: ReplayBuffer, horizon: int) -> float:
    """Return that is lost where every step is at or above the threshold."""
    s = buffer.settings
    return float(np.sum(s.gamma ** np.arange(horizon))) * abs(s.r_a - s.r_b)


def differences(buffer: ReplayBuffer, replays: Replays, horizon: int) -> Floats:
    """Differences to cDBS by draw, [P, D, 4] in `UNITS`."""
    steps = replays.step_return.mean(-1) / reach_of(buffer, horizon)
    rows = [steps, *(replays.outcomes[..., j].mean(-1) / UNITS[name] for j, name in enumerate(OUTCOMES) if j)]
    found = np.stack(rows, axis=-1)
    return np.asarray(found - found[-1:], dtype=np.float64)


def evidence(
    buffer: ReplayBuffer,
    replays: Replays,
    leverage: Floats,
    shares: Mapping[str, int],
    predictions: HeldOut,
    equal: Floats,
    ends: EndModel,
    horizon: int,
) -> Evidence:
    """Evidence out of replays of every session under every policy.

    Args:
        replays: P policies, cDBS last. leverage: of them, [P]. shares: draws of every structure in their order.
        predictions, equal: of left-out sessions, by the structures and without any answer. ends: model of the outcomes. horizon: steps.
    """
    known, summaries = np.array([True, *ends.seen[1:]]), replays.summaries
    count = len(summaries)
    drawn = differences(buffer, replays, horizon) * known
    mean = np.einsum("pdq,d->pq", drawn, replays.weights)
    spread = np.sqrt(np.einsum("pdq,d->pq", (drawn - mean[:, None]) ** 2, replays.weights))
    parts = _doses(buffer, replays)
    price = parts["price"]
    first = 0
    by = {}
    for key, number in shares.items():
        by[key] = drawn[:, first : first + number].mean(1)
        first += number
    for key in STRUCTURES:
        own = by.get(key, mean)
        parts[f"{key} effect"] = own[:, 0] - price
        parts[f"{key} weight"] = np.full(count, predictions.weights[key])
    parts["apart"] = np.std([parts[f"{key} effect"] for key in STRUCTURES], axis=0)
    parts |= {"effect": mean[:, 0] - price, "effect sd": spread[:, 0], "leverage": leverage}
    parts |= {"burden": summaries[:, 2], "burden gained": summaries[:, 2] - summaries[-1, 2]}
    for j, name in enumerate(OUTCOMES):
        if j:
            q = list(UNITS).index(name)
            parts |= {name: mean[:, q], f"{name} sd": spread[:, q]}
            parts[f"{name} skill"] = np.full(count, float(np.clip(ends.skill[j], -1, 1)) if known[q] else 0.0)
    parts |= _near(buffer, summaries)
    for name, value in {**_skill(predictions, equal), **_design(buffer)}.items():
        parts[name] = np.full(count, value)
    return Evidence(parts, mean, spread, known)


def _doses(buffer: ReplayBuffer, replays: Replays) -> Parts:
    """What policies give, and what that costs by itself."""
    s, summaries = buffer.settings, replays.summaries
    amount, square = (np.einsum("pdn,d->p", v, replays.weights) / v.shape[-1] for v in (replays.amplitude, replays.energy))
    return {
        "price": -s.c1 * (amount - amount[-1]) / abs(s.r_a - s.r_b),
        "dose": summaries[:, 0] - 1,
        "late dose": summaries[:, 1] - 1,
        "switching": summaries[:, 3],
        "moving": np.sqrt(np.maximum(square - amount**2, 0.0)),
    }


def _near(buffer: ReplayBuffer, summaries: Floats) -> Parts:
    """The share above the threshold by sessions of similar doses alone."""
    sessions = SessionSupport(buffer)
    doses, asked = sessions.points[:, [0, 1, 3]], summaries[:, [0, 1, 3]]
    found = contrasts(doses, sessions.visits, sessions.points[:, 2], 1.0, asked, asked[-1])
    return {"near effect": found.mean, "near effect sd": found.sd}


def _design(buffer: ReplayBuffer) -> dict[str, float]:
    """Visits, and how the random sessions switch: draws of every step say little of a lasting dose."""
    random = [float(np.abs(np.diff(held_amplitude(s))).mean()) for s in buffer.sessions if s.controller == "random" and s.steps > 1]
    visits = len({s.visit for s in buffer.sessions})
    return {"log visits": float(np.log(visits)), "random switching": float(np.mean(random)) if random else 0.0}


def _skill(predictions: HeldOut, equal: Floats) -> dict[str, float]:
    """How much better left-out sessions are predicted than without any answer: as a share, in standard errors; error without any."""
    said = np.sum([predictions.weights[k] * predictions.predicted[k] for k in predictions.weights], axis=0)
    fine = np.isfinite(said) & np.isfinite(predictions.observed) & np.isfinite(equal)
    if fine.sum() < 3:
        return {"skill": 0.0, "skill z": 0.0, "miss": 0.3}
    seen = predictions.observed[fine]
    gain = (seen - equal[fine]) ** 2 - (seen - said[fine]) ** 2
    base = float(np.mean((seen - equal[fine]) ** 2))
    error = float(gain.std(ddof=1) / np.sqrt(gain.size))
    share = float(np.clip(gain.mean() / base, -1, 1)) if base > 1e-9 else 0.0
    return {"skill": share, "skill z": float(np.clip(gain.mean() / max(error, 1e-9), -5, 5)), "miss": float(np.sqrt(base))}
