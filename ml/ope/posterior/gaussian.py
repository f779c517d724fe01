"""The Gaussian process over candidates: what the structures leave out, and what tested sessions add.

Candidates are alike as far as they would do the same in logged states (Konyushkova et al. 2021). The kernel is k(i, j) = exp(-d^2 / (2
l^2)), with d the root mean squared difference of their amplitudes. What a structure gets wrong for one, it gets wrong for its neighbours.
Draws are joint over policies and quantities, and a tested session moves them by Matheron's rule. A draw f of the prior becomes f + K_o
(K_oo + R)^-1 (y - f_o - e), with o what was observed, e ~ N(0, R), and K the covariance of the draws.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.outcomes import PREDICTED
from ml.policies.policy import Policy

Floats = NDArray[np.float64]

QUANTITIES = ("return", "energy", *(o.field for o, _ in PREDICTED))
"""What a policy is judged by; the draws of each are aligned over policies and quantities."""

LENGTH = 0.15
"""Amplitude fraction by which policies may differ and still share most of what a structure gets wrong."""
MOST_STATES = 600
JITTER = 1e-6
_OWN = 0.1
"""Least variance of a return apart from its QoCs, as a share of theirs."""


@dataclass(frozen=True)
class TestedDifference:
    """Difference between sessions of one policy at one visit and that visit's cDBS sessions.

    Attributes:
        policy_name: name under which the policy is evaluated. visit: its number. n_sessions: of the policy at that visit.
        differences: by `QUANTITIES`, in the unit of each (`energy`: mean squared amplitude fraction); a key is absent where not measured.
        standard_errors: of the same keys.
        n_reference: sessions of cDBS at that visit, whose noise all policies of the visit share. None where it is not known, as in older
            tests: then their errors count as their own.

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
    """Compute the correlation of what structures get wrong for two policies, [P, P], from their amplitudes on logged states [N, W]."""
    keep = np.unique(np.linspace(0, len(states) - 1, MOST_STATES).astype(np.int64))
    actions = np.stack([np.clip(p.act(states[keep].copy()), 0.0, 1.0) for p in policies])
    squared = np.mean((actions[:, None] - actions[None]) ** 2, axis=-1)
    return np.asarray(np.exp(-0.5 * squared / LENGTH**2), dtype=np.float64)


def correlated(correlation: Floats, sd: Floats, draws: int, rng: np.random.Generator) -> Floats:
    """Draw zero-mean normal numbers [P, draws] with standard deviations [P] and a correlation [P, P]."""
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
    alike: Floats | None = None,
) -> dict[str, Floats]:
    """Return draws [P, K] by quantity after tested sessions.

    Args:
        draws: by quantity. names: of the policies, in the order of the rows. reference: row of cDBS.
        tests: differences to the same visit's cDBS; a difference of a quantity without draws says nothing here.
        spread_between_visits: standard deviation of a policy's true difference to cDBS between visits, by quantity: a test shows one visit.
        rng: of the errors.
        parts_of_return: what one unit of a QoC adds to the return; a session's chance in it is then not counted a second time.
        alike: correlation of the policies' days, [P, P]; without it only a policy's own tests of a visit share its day.

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
    rows = {name: i for i, name in enumerate(names)}
    days = {} if alike is None else {"alike": lambda a, b: float(alike[rows[a], rows[b]])}
    error = errors_of_tests(seen_of, spread_between_visits, parts_of_return or {}, **days)
    error += JITTER * np.diag(np.diag(error))
    flat = np.concatenate([draws[q] for q in quantities])
    k = flat.shape[1] - 1
    centred, centred_seen = flat - flat.mean(1, keepdims=True), seen - seen.mean(1, keepdims=True)
    gain = (centred @ centred_seen.T / k) @ np.linalg.inv(centred_seen @ centred_seen.T / k + error)
    said = y[:, None] - seen - np.linalg.cholesky(error) @ rng.standard_normal(seen.shape)
    moved = flat + gain @ said
    return {q: moved[i * len(names) : (i + 1) * len(names)] for i, q in enumerate(quantities)}


def errors_of_tests(
    observed: Sequence[tuple[TestedDifference, str]],
    spread_between_visits: Mapping[str, float],
    parts_of_return: Mapping[str, float],
    alike: Callable[[str, str], float] = lambda a, b: float(a == b),
) -> Floats:
    """Compute the covariance [n, n] of the errors of observed differences, each of one test and one quantity.

    Three things move a difference: its own sessions, the visit's cDBS sessions, and how the policy's true difference varies between visits.
    All tests of a visit share its cDBS sessions. Policies that act alike vary together. A return holds the session's QoCs, so that its
    chance, and its day, go with theirs. Every error is written as loadings on independent parts, so that the matrix is symmetric and
    positive definite whatever was measured in which test.

    Args:
        observed: tests and quantities. spread_between_visits: standard deviation by quantity. parts_of_return: as in `updated`.
        alike: correlation of two policies' days, by name; 1 of a policy with itself.
    """
    n = len(observed)
    chance = [_loadings(quantity, _session_sd(test), parts_of_return) for test, quantity in observed]
    day = [_loadings(quantity, spread_between_visits, parts_of_return) for _, quantity in observed]
    found = np.zeros((n, n))
    for i, (one, _) in enumerate(observed):
        for j, (other, _) in enumerate(observed):
            same_test = one is other
            shared = one.n_reference if same_test or (one.visit == other.visit and one.n_reference == other.n_reference) else None
            weight = (1.0 / one.n_sessions if same_test else 0.0) + (1.0 / shared if shared else 0.0)
            found[i, j] = weight * _common(chance[i], chance[j])
            if one.visit == other.visit:
                found[i, j] += alike(one.policy_name, other.policy_name) * _common(day[i], day[j])
    return found


def _session_sd(test: TestedDifference) -> dict[str, float]:
    """Derive the standard deviation of one session by quantity from a test's standard errors."""
    share = 1.0 / test.n_sessions + (1.0 / test.n_reference if test.n_reference else 0.0)
    return {name: error / np.sqrt(share) for name, error in test.standard_errors.items()}


def _loadings(quantity: str, sd: Mapping[str, float], parts_of_return: Mapping[str, float]) -> dict[str, float]:
    """Split what moves a quantity into independent parts: a QoC by itself, a return by its QoCs and by what else is in it."""
    if quantity != "return":
        return {quantity: sd.get(quantity, 0.0)}
    of_qocs = {name: weight * sd[name] for name, weight in parts_of_return.items() if name in sd}
    rest = sd.get("return", 0.0) ** 2 - sum(v**2 for v in of_qocs.values())
    # at least a tenth of what its QoCs bring is its own, so that a return is never taken for known from them
    return of_qocs | {"return": float(np.sqrt(max(rest, _OWN * sum(v**2 for v in of_qocs.values()))))}


def _common(a: Mapping[str, float], b: Mapping[str, float]) -> float:
    return float(sum(value * b[name] for name, value in a.items() if name in b))
