"""Which candidates to test at one visit: those whose tests together are expected to leave the best policy in hand.

A visit tests several policies, and what counts afterwards is the best of them. So a set S is worth the expected improvement
E[max(0, max over i in S of d_i)], d the difference of the return to that of cDBS, over joint posterior draws: a second policy that does
what the first does adds nothing, one that may turn out better adds much. Chosen greedily, which is within 1 - 1/e of the best set because
this value is submodular (Nemhauser, Wolsey, Fisher 1978; batch expected improvement: Ginsbourger, Le Riche, Carraro 2010).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEAST_GAIN = 0.01
"""A policy that adds less than this share of what the set is worth already adds nothing worth a patient's minutes."""


@dataclass(frozen=True)
class Suggestion:
    """One policy of a portfolio.

    Attributes:
        name: of the policy.
        expected: mean difference of its return to that of cDBS, reward units.
        adds: expected improvement that it adds to those chosen before it, reward units.
        better: probability that it returns more than all chosen before it; for the first, than cDBS.
        informs: share of the variance of the other candidates that its test alone would explain, from 0 to 1.
    """

    name: str
    expected: float
    adds: float
    better: float
    informs: float


def portfolio(differences: Mapping[str, Floats], slots: int, careful: Collection[str] = ()) -> tuple[Suggestion, ...]:
    """The policies that teach most together, in the order in which they were chosen.

    Args:
        differences: returns less that of cDBS by policy, aligned posterior draws, [draws] each; only what may be proposed.
        slots: how many policies the visit has time for.
        careful: policies to be tested with care, of which a visit takes one.

    Returns:
        At most `slots` policies, fewer where further ones would add nothing.

    Raises:
        ValueError: draws that are not aligned or not finite.
    """
    if not differences or slots < 1:
        return ()
    names = sorted(differences)
    sizes = {differences[n].size for n in names}
    if len(sizes) != 1:
        raise ValueError(f"draws are not aligned: {sorted(sizes)}")
    draws = np.stack([np.asarray(differences[n], dtype=np.float64) for n in names])
    if not np.isfinite(draws).all():
        raise ValueError("draws must be finite")
    best = np.zeros(draws.shape[1])
    chosen: list[Suggestion] = []
    while len(chosen) < slots:
        taken = {s.name for s in chosen}
        held_back = taken | (set(careful) if taken & set(careful) else set())
        left = [i for i, name in enumerate(names) if name not in held_back]
        if not left:
            break
        adds = np.array([np.maximum(draws[i] - best, 0.0).mean() for i in left])
        i = left[int(np.argmax(adds))]
        if adds.max() <= LEAST_GAIN * float(best.mean()):
            break
        better, informs = float(np.mean(draws[i] > best)), _informs(draws, i)
        chosen.append(Suggestion(names[i], float(draws[i].mean()), float(adds.max()), better, informs))
        best = np.maximum(best, draws[i])
    return tuple(chosen)


def _informs(draws: Floats, i: int) -> float:
    """Share of the variance of the others that goes with policy i; 0 where there are no others, or nothing varies."""
    centred = draws - draws.mean(axis=1, keepdims=True)
    others = np.delete(centred, i, axis=0)
    total, own = float((others**2).sum()), float((centred[i] ** 2).sum())
    if total < 1e-12 or own < 1e-12:
        return 0.0
    return float(((others @ centred[i]) ** 2).sum() / own / total)
