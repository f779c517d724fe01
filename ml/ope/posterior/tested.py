"""Tested sessions as differences to the same visit's cDBS, with their standard errors.

A day moves policy and cDBS alike, so that their difference at one visit says more than either. The noise of a session is pooled within
policy (or cDBS) and visit over all tests; where no policy or cDBS ran twice at a visit it is the spread of all sessions of a kind around
their mean, which holds the differences between days too and therefore claims less.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ml.ope.posterior.gaussian import QUANTITIES, TestedDifference

LEAST_ERROR = {"return": 0.1, "energy": 0.005, "grasp_hz": 0.02, "rating": 0.25, "tremor_percent": 0.5}
"""Smallest standard deviation of a session, by quantity: what its measurement resolves. Sessions that happen to agree prove no more."""

FEWEST = 3
"""Degrees of freedom from which the noise of a session is known."""


@dataclass(frozen=True)
class TestSession:
    """What one session showed.

    Attributes:
        policy: name under which its policy is evaluated; None for cDBS. visit: its number.
        values: by `QUANTITIES`; a quantity that was not measured is absent.
    """

    __test__ = False  # no test class of pytest

    policy: str | None
    visit: int
    values: Mapping[str, float]


def differences_to_cdbs(sessions: Sequence[TestSession]) -> list[TestedDifference]:
    """One difference per policy and visit with sessions of both the policy and cDBS, in order of visit and name.

    A quantity is left out where the noise of a session is not known: fewer than three degrees of freedom in all.
    """
    groups: dict[tuple[str | None, int], list[TestSession]] = defaultdict(list)
    for session in sessions:
        groups[session.policy, session.visit].append(session)
    noise = {name: _noise(name, groups) for name in QUANTITIES}
    found = []
    for policy, visit in sorted((p, v) for p, v in groups if p is not None and (None, v) in groups):
        ours, theirs = groups[policy, visit], groups[None, visit]
        differences, errors = {}, {}
        for name, sd in noise.items():
            a, b = _known(name, ours), _known(name, theirs)
            if sd is not None and a.size and b.size:
                differences[name] = float(a.mean() - b.mean())
                errors[name] = float(sd * np.sqrt(1 / a.size + 1 / b.size))
        if differences:
            found.append(TestedDifference(policy, visit, len(ours), differences, errors, len(theirs)))
    return sorted(found, key=lambda test: (test.visit, test.policy_name))


def _known(name: str, sessions: Sequence[TestSession]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([s.values[name] for s in sessions if name in s.values], dtype=np.float64)


def _noise(name: str, groups: Mapping[tuple[str | None, int], Sequence[TestSession]]) -> float | None:
    """Standard deviation of a session of one policy at one visit, or an upper bound of it; None where neither is known."""
    within = _pooled([_known(name, rows) for rows in groups.values()])
    if within is None:
        of_policy: dict[str | None, list[TestSession]] = defaultdict(list)
        for (policy, _), rows in groups.items():
            of_policy[policy] += rows
        within = _pooled([_known(name, rows) for rows in of_policy.values()])
    return None if within is None else max(within, LEAST_ERROR[name])


def _pooled(groups: Sequence[np.ndarray[tuple[int], np.dtype[np.float64]]]) -> float | None:
    freedom = sum(max(g.size - 1, 0) for g in groups)
    if freedom < FEWEST:
        return None
    return float(np.sqrt(sum(float(((g - g.mean()) ** 2).sum()) for g in groups if g.size) / freedom))
