"""Choice of candidates to test at one visit: those whose tests together are expected to leave the best policy in hand.

A visit tests several policies, and what counts afterwards is the best of those that have been tested. A set S is worth

    E[ max(0, max over i in S or tested of mu_i(S)) ],

mu_i(S) the posterior mean, after the visit, of policy i's difference of the return to that of cDBS. The visit shows one session of each,
with the noise of a session. A session informs about policies that act alike (linear prediction over joint posterior draws). So a second
policy that does what the first does adds nothing, nor does one that is known already. One that may be better adds much, whether it is new
or has shown one lucky session. Without noise, and before any test, this is the expected improvement of a batch (Ginsbourger, Le Riche,
Carraro 2010). With noise it is the knowledge gradient for correlated beliefs (Frazier, Powell, Dayanik 2009). Chosen greedily.

One session with much noise may change no mean enough to count, while several would: the value of information is not concave (Frazier and
Powell 2010). Slots that are left then go to policies that have never run, by what knowing them for certain would add.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEAST_GAIN = 0.001
"""A policy that adds less than this share of what the set is worth already adds nothing worth a patient's minutes."""
_NOTHING = 1e-9
_SEED = 0x7E57
"""Of what chance adds to a session; the same for every set, so that sets differ by what is in them alone."""


@dataclass(frozen=True)
class Suggestion:
    """One policy of a portfolio.

    Attributes:
        name: of the policy.
        expected: mean difference of its return to that of cDBS, reward units.
        adds: expected improvement of the best tested policy that its session adds to those chosen before it, reward units. It is about 0
            where only several sessions would show anything.
        better: probability that it returns more than all chosen before it; for the first, than cDBS.
        informs: share of the variance of the other candidates that its test alone would explain, from 0 to 1.
    """

    name: str
    expected: float
    adds: float
    better: float
    informs: float


def portfolio(
    differences: Mapping[str, Floats], slots: int, careful: Collection[str] = (), tested: Collection[str] = (), noise: float = 0.0
) -> tuple[Suggestion, ...]:
    """Choose the policies that teach most together, in the order in which they were chosen.

    Args:
        differences: returns less that of cDBS by policy, aligned posterior draws, [draws] each; only what may be proposed.
        slots: how many policies the visit has time for.
        careful: policies to be tested with care, of which a visit takes one.
        tested: policies that have run at a visit before; the draws know what they showed.
        noise: standard deviation of one session's difference to its visit's cDBS, reward units; 0 where it is not known.

    Returns:
        At most `slots` policies, fewer where further ones would add nothing, even if they were known for certain.

    Raises:
        ValueError: draws that are not aligned or not finite.
    """
    if not differences or slots < 1:
        return ()
    names = sorted(differences)
    draws = _aligned(differences, names)
    beliefs = _Beliefs.of(draws, noise)
    had = [i for i, name in enumerate(names) if name in tested]
    chosen: list[int] = []
    found: list[Suggestion] = []
    while len(chosen) < slots:
        taken = {names[i] for i in chosen}
        held_back = taken | (set(careful) if taken & set(careful) else set())
        left = [i for i, name in enumerate(names) if name not in held_back]
        if not left:
            break
        i, added = _next(beliefs, left, chosen, had)
        if i is None:
            break
        before = np.maximum(0.0, draws[chosen].max(axis=0)) if chosen else np.zeros(draws.shape[1])
        better = float(np.mean(draws[i] > before))
        found.append(Suggestion(names[i], float(draws[i].mean()), added, better, _informs(draws, i)))
        chosen.append(i)
    return tuple(found)


def _next(beliefs: _Beliefs, left: list[int], chosen: list[int], had: list[int]) -> tuple[int | None, float]:
    """Choose the next of the remaining policies, and compute what its session adds; None where none is worth a patient's minutes."""
    now = beliefs.worth(chosen, had)
    adds = np.array([beliefs.worth([*chosen, i], had) for i in left]) - now
    if adds.max() > max(LEAST_GAIN * now, _NOTHING):
        return left[int(np.argmax(adds))], float(adds.max())
    new = [k for k, i in enumerate(left) if i not in had]
    if not new:
        return None, 0.0
    best = np.maximum(0.0, beliefs.draws[[*chosen, *had]].max(axis=0)) if chosen or had else np.zeros(beliefs.draws.shape[1])
    known = np.array([np.maximum(beliefs.draws[left[k]] - best, 0.0).mean() for k in new])
    if known.max() <= max(LEAST_GAIN * float(best.mean()), _NOTHING):
        return None, 0.0
    k = new[int(np.argmax(known))]
    return left[k], max(float(adds[k]), 0.0)


@dataclass(frozen=True)
class _Beliefs:
    """Beliefs about all policies, and what sessions would show.

    Attributes:
        draws: [n, draws]. mean: [n]. covariance: [n, n]. noise: of a session's difference. shown: the draws as sessions with noise would
            show them, [n, draws].
    """

    draws: Floats
    mean: Floats
    covariance: Floats
    noise: float
    shown: Floats

    @staticmethod
    def of(draws: Floats, noise: float) -> _Beliefs:
        by_chance = np.random.default_rng(_SEED).standard_normal(draws.shape)
        # centred, or a policy whose draws of chance are high on average would seem to gain by any session
        by_chance -= by_chance.mean(axis=1, keepdims=True)
        covariance = np.atleast_2d(np.cov(draws, bias=True))
        return _Beliefs(draws, draws.mean(axis=1), covariance, noise, draws + noise * by_chance)

    def worth(self, chosen: list[int], had: list[int]) -> float:
        """Compute the expected mean of the best of those tested before and those chosen, after the sessions of those chosen; at least 0."""
        kept = sorted({*chosen, *had})
        if not kept:
            return 0.0
        after = self.mean[kept][:, None]
        if chosen:
            seen = self.covariance[np.ix_(chosen, chosen)] + self.noise**2 * np.eye(len(chosen))
            gain = self.covariance[np.ix_(kept, chosen)] @ np.linalg.pinv(seen, hermitian=True)
            after = after + gain @ (self.shown[chosen] - self.mean[chosen][:, None])
        return float(np.maximum(0.0, after.max(axis=0)).mean())


def _aligned(differences: Mapping[str, Floats], names: list[str]) -> Floats:
    sizes = {differences[n].size for n in names}
    if len(sizes) != 1:
        raise ValueError(f"draws are not aligned: {sorted(sizes)}")
    draws = np.stack([np.asarray(differences[n], dtype=np.float64) for n in names])
    if not np.isfinite(draws).all():
        raise ValueError("draws must be finite")
    return draws


def _informs(draws: Floats, i: int) -> float:
    """Compute the share of the variance of the others that goes with policy i; 0 where there are no others, or nothing varies."""
    centred = draws - draws.mean(axis=1, keepdims=True)
    others = np.delete(centred, i, axis=0)
    total, own = float((others**2).sum()), float((centred[i] ** 2).sum())
    if total < 1e-12 or own < 1e-12:
        return 0.0
    return float(((others @ centred[i]) ** 2).sum() / own / total)
