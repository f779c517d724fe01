"""From estimates to a ranking that a clinician may pick from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.ope.estimate import Estimate
from ml.ope.registry import preference


@dataclass(frozen=True)
class Ranked:
    """One policy's place.

    Attributes:
        policy: its name. rank: 1 is best.
        probability_best: that its return is the highest among supported policies; 0 for the others.
        supported: whether the ranking's method may speak about it.
        estimate: of the ranking's method.
    """

    policy: str
    rank: int
    probability_best: float
    supported: bool
    estimate: Estimate


def default_method(estimates: Mapping[str, Mapping[str, Estimate]]) -> str:
    """Choose the method that the ranking rests on.

    It is the first of the usual order that supports a policy, else the first there is.

    Raises:
        ValueError: no method has any estimate.
    """
    there = [m for m in (*preference(), *estimates) if estimates.get(m)]
    if not there:
        raise ValueError("a ranking needs the estimates of at least one method")
    return next((m for m in there if any(e.supported for e in estimates[m].values())), there[0])


def rank_policies(
    estimates: Mapping[str, Mapping[str, Estimate]],
    method: str | None = None,
    draws: int = 4000,
    seed: int = 0,
    tiers: Mapping[str, int] | None = None,
) -> list[Ranked]:
    """Rank policies from best to worst by one method: by tier, then by value.

    Args:
        estimates: method -> policy -> estimate.
        method: whose estimates rank; `default_method` where not given.
        draws: draws behind the probability of being best. seed: theirs.
        tiers: by policy, a lower one first; where not given, policies that the data do not support come after all others.

    Raises:
        ValueError: the method has no estimate.
    """
    chosen = default_method(estimates) if method is None else method
    if not estimates.get(chosen):
        raise ValueError(
            f"there is no estimate by {chosen} to rank by; methods with estimates: {', '.join(m for m in estimates if estimates[m])}"
        )
    table = estimates[chosen]
    tier = {name: int(not e.supported) for name, e in table.items()} if tiers is None else tiers
    names = sorted(table, key=lambda name: (tier[name], -table[name].value, name))
    best = dict.fromkeys(names, 0.0) | probability_best({n: table[n] for n in names if table[n].supported}, draws, seed)
    return [Ranked(name, k + 1, best[name], table[name].supported, table[name]) for k, name in enumerate(names)]


def probability_best(estimates: Mapping[str, Estimate], draws: int = 4000, seed: int = 0) -> dict[str, float]:
    """Compute the probability that each policy has the highest return, summing to 1.

    Where every estimate keeps as many draws, those are counted: they are aligned over policies, so that what is common to them cancels.
    Else independent normals of value and standard error are counted.
    """
    names = list(estimates)
    if not names:
        return {}
    kept: Sequence[list[float]] = [estimates[n].details.get("draws") or [] for n in names]
    if len({len(k) for k in kept}) == 1 and len(kept[0]) >= 2:
        sample: NDArray[np.float64] = np.array(kept, dtype=np.float64)
    else:
        rng = np.random.default_rng(seed)
        sample = np.stack([rng.normal(estimates[n].value, estimates[n].standard_error, draws) for n in names])
    top = sample == sample.max(axis=0)
    share = (top / top.sum(axis=0)).mean(axis=1)  # a tie is shared
    return {name: float(p) for name, p in zip(names, share, strict=True)}
