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
_ROOM = 1.1
"""Least variance of a session's return over that of its QoCs' part."""


@dataclass(frozen=True)
class TestedDifference:
    """What sessions of one policy showed at one visit, less what that visit's cDBS sessions showed.

    Attributes:
        policy_name: name under which the policy is evaluated. visit: its number. n_sessions: of the policy at that visit.
        differences: by `QUANTITIES`, in the unit of each (`energy`: mean squared amplitude fraction); a key is absent where not measured.
        standard_errors: of the same keys.
        n_reference: sessions of cDBS at that visit, whose chance all policies of the visit share; None where it is not known (tests stored
            before it was kept), and then their errors count as their own.

    Raises:
        ValueError: no session, an unknown quantity, keys that differ, or a standard error that is not positive.
    """

    __test__ = False  # no test class of pytest

    policy_name: str
    visit: int
    n_sessions: int
    differences: Mapping[str, float]
    standard_errors: Mapping[str, float]
    n_reference: int | None = None

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
    parts_of_return: Mapping[str, float] | None = None,
) -> dict[str, Floats]:
    """Draws [P, K] by quantity after tested sessions.

    Args:
        draws: by quantity. names: of the policies, in the order of the rows. reference: row of cDBS.
        tests: differences to the same visit's cDBS; a difference of a quantity without draws says nothing here.
        spread_between_visits: standard deviation of a policy's true difference to cDBS between visits, by quantity: a test shows one visit.
        rng: of the errors.
        parts_of_return: what one unit of a QoC adds to the return; a session's chance in it is then not counted a second time.

    Raises:
        ValueError: a test of a policy that is not among the names.
    """
    quantities = list(draws)
    observed, seen_of, values = [], [], []
    for test in tests:
        if test.policy_name not in names:
            raise ValueError(f"the test of {test.policy_name!r} at visit {test.visit} is of a policy that is not evaluated: name it too")
        row = names.index(test.policy_name)
        for quantity in quantities:
            if quantity in test.differences and row != reference:
                observed.append(draws[quantity][row] - draws[quantity][reference])
                seen_of.append((test, quantity))
                values.append(test.differences[quantity])
    if not observed:
        return dict(draws)
    seen, y = np.stack(observed), np.array(values)
    error = errors_of_tests(seen_of, spread_between_visits, parts_of_return or {})
    flat = np.concatenate([draws[q] for q in quantities])
    k = flat.shape[1] - 1
    centred, centred_seen = flat - flat.mean(1, keepdims=True), seen - seen.mean(1, keepdims=True)
    gain = (centred @ centred_seen.T / k) @ np.linalg.inv(centred_seen @ centred_seen.T / k + error)
    said = y[:, None] - seen - np.linalg.cholesky(error) @ rng.standard_normal(seen.shape)
    moved = flat + gain @ said
    return {q: moved[i * len(names) : (i + 1) * len(names)] for i, q in enumerate(quantities)}


def errors_of_tests(
    observed: Sequence[tuple[TestedDifference, str]], spread_between_visits: Mapping[str, float], parts_of_return: Mapping[str, float]
) -> Floats:
    """Covariance [n, n] of the errors of observed differences, each of one test and one quantity.

    Three things move a difference: its own sessions; the visit's cDBS sessions, which all tests of the visit share; and how the policy's
    true difference varies between visits. A return holds the session's QoCs, so that its chance goes with theirs: per session the
    covariance of return and QoC is the QoC's weight in the return times its variance.
    """
    n = len(observed)
    found = np.zeros((n, n))
    for i, (one, first) in enumerate(observed):
        found[i, i] += spread_between_visits.get(first, 0.0) ** 2
        for j, (other, second) in enumerate(observed):
            if one is other or (one.visit == other.visit and one.n_reference and one.n_reference == other.n_reference):
                chance = _chance(one, first, second, parts_of_return)
                reference = 1.0 / one.n_reference if one.n_reference else 0.0
                found[i, j] += chance * ((1.0 / one.n_sessions if one is other else 0.0) + reference)
    return found


def _chance(test: TestedDifference, first: str, second: str, parts_of_return: Mapping[str, float]) -> float:
    """Covariance of two quantities from session to session, as a test's standard errors tell it."""
    share = 1.0 / test.n_sessions + (1.0 / test.n_reference if test.n_reference else 0.0)

    def variance(name: str) -> float:
        return test.standard_errors[name] ** 2 / share

    of_qocs = sum(w**2 * variance(name) for name, w in parts_of_return.items() if name in test.standard_errors)
    if first == second:
        # at least what its QoCs bring, and a tenth more, so that the covariance stays one
        return max(variance(first), _ROOM * of_qocs) if first == "return" else variance(first)
    if "return" in (first, second):
        qoc = second if first == "return" else first
        return parts_of_return.get(qoc, 0.0) * variance(qoc)
    return 0.0
