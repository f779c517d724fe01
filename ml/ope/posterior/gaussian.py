"""The Gaussian process over candidates: what the structures leave out, and what tested sessions add.

Candidates are alike as far as they would do the same in logged states (Konyushkova et al. 2021): k(i, j) = exp(-d^2 / (2 l^2)), d the root
mean squared difference of their amplitudes. What a structure gets wrong for one, it gets wrong for its neighbours. Draws are joint over
policies and quantities, and a tested session moves them by Matheron's rule: a draw f of the prior becomes
f + K_o (K_oo + R)^-1 (y - f_o - e), with o what was observed, e ~ N(0, R), and K the covariance of the draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.policies.policy import Policy

Floats = NDArray[np.float64]

QUANTITIES = ("return", "energy", "grasp_hz", "rating", "tremor_percent")
"""What a policy is judged by; the draws of each are aligned over policies and quantities."""

LENGTH = 0.15
"""Amplitude fraction by which policies may differ and still share most of what a structure gets wrong."""
MOST_STATES = 600
JITTER = 1e-6


@dataclass(frozen=True)
class TestedDifference:
    """What sessions of one policy showed at one visit, less what that visit's cDBS sessions showed.

    Attributes:
        policy_name: name under which the policy is evaluated. visit: its number. n_sessions: of the policy at that visit.
        differences: by `QUANTITIES`, in the unit of each (`energy`: mean squared amplitude fraction); a key is absent where not measured.
        standard_errors: of the same keys.

    Raises:
        ValueError: no session, an unknown quantity, keys that differ, or a standard error that is not positive.
    """

    __test__ = False  # no test class of pytest

    policy_name: str
    visit: int
    n_sessions: int
    differences: Mapping[str, float]
    standard_errors: Mapping[str, float]

    def __post_init__(self) -> None:
        who = f"the test of {self.policy_name!r} at visit {self.visit}"
        if self.n_sessions < 1:
            raise ValueError(f"{who} needs at least one session, not {self.n_sessions}")
        unknown = sorted(set(self.differences) - set(QUANTITIES))
        if unknown:
            raise ValueError(f"{who} has a difference of {unknown[0]!r}; what can be compared: {', '.join(QUANTITIES)}")
        if set(self.differences) != set(self.standard_errors):
            raise ValueError(f"{who} needs one standard error for each difference")
        for name, error in self.standard_errors.items():
            if not (np.isfinite(error) and error > 0 and np.isfinite(self.differences[name])):
                raise ValueError(
                    f"{who}: the difference of {name} and its standard error must be finite and the error above 0, not {error}"
                )


def similarity(policies: Sequence[Policy], states: Floats) -> Floats:
    """Correlation of what structures get wrong for two policies, [P, P], from their amplitudes on logged states [N, W]."""
    keep = np.unique(np.linspace(0, len(states) - 1, MOST_STATES).astype(np.int64))
    actions = np.stack([np.clip(p.act(states[keep].copy()), 0.0, 1.0) for p in policies])
    squared = np.mean((actions[:, None] - actions[None]) ** 2, axis=-1)
    return np.asarray(np.exp(-0.5 * squared / LENGTH**2), dtype=np.float64)


def correlated(correlation: Floats, sd: Floats, draws: int, rng: np.random.Generator) -> Floats:
    """Zero-mean normal draws [P, draws] with standard deviations [P] and a correlation [P, P]."""
    lower = np.linalg.cholesky(correlation + JITTER * np.eye(len(correlation)))
    found = sd[:, None] * (lower @ rng.standard_normal((len(correlation), draws)))
    return np.asarray(found - found.mean(1, keepdims=True), dtype=np.float64)


def updated(
    draws: Mapping[str, Floats],
    names: Sequence[str],
    reference: int,
    tests: Sequence[TestedDifference],
    spread_between_visits: Mapping[str, float],
    rng: np.random.Generator,
) -> dict[str, Floats]:
    """Draws [P, K] by quantity after tested sessions.

    Args:
        draws: by quantity. names: of the policies, in the order of the rows. reference: row of cDBS.
        tests: differences to the same visit's cDBS; a difference of a quantity without draws says nothing here.
        spread_between_visits: standard deviation of a policy's true difference to cDBS between visits, by quantity: a test shows one visit.
        rng: of the errors.

    Raises:
        ValueError: a test of a policy that is not among the names.
    """
    quantities = list(draws)
    observed, noise, values = [], [], []
    for test in tests:
        if test.policy_name not in names:
            raise ValueError(f"the test of {test.policy_name!r} at visit {test.visit} is of a policy that is not evaluated: name it too")
        row = names.index(test.policy_name)
        for quantity in quantities:
            if quantity in test.differences and row != reference:
                observed.append(draws[quantity][row] - draws[quantity][reference])
                noise.append(test.standard_errors[quantity] ** 2 + spread_between_visits.get(quantity, 0.0) ** 2)
                values.append(test.differences[quantity])
    if not observed:
        return dict(draws)
    seen, error, y = np.stack(observed), np.array(noise), np.array(values)
    flat = np.concatenate([draws[q] for q in quantities])
    k = flat.shape[1] - 1
    centred, centred_seen = flat - flat.mean(1, keepdims=True), seen - seen.mean(1, keepdims=True)
    gain = (centred @ centred_seen.T / k) @ np.linalg.inv(centred_seen @ centred_seen.T / k + np.diag(error))
    said = y[:, None] - seen - np.sqrt(error)[:, None] * rng.standard_normal(seen.shape)
    moved = flat + gain @ said
    return {q: moved[i * len(names) : (i + 1) * len(names)] for i, q in enumerate(quantities)}
