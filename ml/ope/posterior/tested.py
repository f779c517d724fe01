"""Tested sessions as differences to the same visit's cDBS, with their standard errors.

A day moves policy and cDBS alike, so that their difference at one visit says more than either. The variance of a session is pooled over
tests, within policy (or cDBS) and visit, with a prior. The prior is the spread of the random sessions around visits and dose, as a scaled
inverse chi-square distribution of `PRIOR_FREEDOM` degrees of freedom (Gelman et al. 2013, section 2.6). Where both together have fewer than
`FEWEST` degrees of freedom, the spread of a policy (or of cDBS) between visits fills them up. It has the differences between days too and
therefore claims less. A variance that rests on few degrees of freedom is itself uncertain. So a standard error is the half-width of the
central 68.3 % of Student's t, with Satterthwaite's (1946) degrees of freedom, not of the normal.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from ml.ope.posterior.gaussian import QUANTITIES, TestedDifference
from ml.outcomes import PREDICTED
from ml.returns import actual_return
from ml.trajectories import ReplayBuffer, SessionTrajectory

Floats = NDArray[np.float64]

LEAST_ERROR = {"return": 0.1, "energy": 0.005} | {o.field: p.least_error for o, p in PREDICTED}
"""Smallest standard deviation of a session, by quantity: what its measurement resolves. Sessions that happen to agree prove no more."""

PRIOR_FREEDOM = 3
"""Weight of the random sessions' spread against that of the tests, degrees of freedom. The spread is a little too wide, as a dose acts
in curves."""

FEWEST = 3
"""Degrees of freedom below which the spread between visits is asked as well."""

_WITHIN_ONE = float(ndtr(1.0))


@dataclass(frozen=True)
class TestSession:
    """Result of one session.

    Attributes:
        policy: name under which its policy is evaluated; None for cDBS. visit: its number.
        values: by `QUANTITIES`; a quantity that was not measured is absent.
    """

    __test__ = False  # no test class of pytest

    policy: str | None
    visit: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class Spread:
    """Variance of a quantity between sessions, in its unit squared, and the degrees of freedom that it rests on."""

    variance: float
    freedom: int


@dataclass(frozen=True)
class Differences:
    """Differences that tested sessions show, and how many sessions show none.

    Attributes:
        tests: one per policy and visit with sessions of both the policy and cDBS, in order of visit and name.
        without_cdbs: sessions of policies at visits without a cDBS session.
        of_unknown_noise: sessions with a quantity that is excluded, because the noise of sessions is unknown.
    """

    tests: tuple[TestedDifference, ...]
    without_cdbs: int = 0
    of_unknown_noise: int = 0


def differences_to_cdbs(sessions: Sequence[TestSession], prior: Mapping[str, Spread] | None = None) -> Differences:
    """Compute every policy's difference to cDBS at every visit.

    Args:
        sessions: of policies and of cDBS. prior: of the noise by quantity, as `spread_of_random` has it; none where None.
    """
    groups: dict[tuple[str | None, int], list[TestSession]] = defaultdict(list)
    for session in sessions:
        groups[session.policy, session.visit].append(session)
    noise = {name: _noise(name, groups, (prior or {}).get(name)) for name in QUANTITIES}
    found, without_cdbs, of_unknown_noise = [], 0, 0
    for (policy, visit), ours in groups.items():
        if policy is None:
            continue
        theirs = groups.get((None, visit))
        if not theirs:
            without_cdbs += len(ours)
            continue
        both = {name: (_known(name, ours), _known(name, theirs)) for name in QUANTITIES}
        measured = {name: pair for name, pair in both.items() if pair[0].size and pair[1].size}
        of_unknown_noise += len(ours) if any(noise[name] is None for name in measured) else 0
        differences, errors = {}, {}
        for name, (a, b) in measured.items():
            if (sd := noise[name]) is not None:
                differences[name] = float(a.mean() - b.mean())
                errors[name] = float(sd * np.sqrt(1 / a.size + 1 / b.size))
        if differences:
            found.append(TestedDifference(policy, visit, len(ours), differences, errors, len(theirs)))
    return Differences(tuple(sorted(found, key=lambda test: (test.visit, test.policy_name))), without_cdbs, of_unknown_noise)


def spread_of_random(buffer: ReplayBuffer, horizon_steps: int) -> dict[str, Spread]:
    """Measure how far random sessions are from their visit's mean and a straight line over their energy, by quantity.

    What does not follow such a line counts as noise. A quantity is absent where no degree of freedom is left; energy always is, because it
    is the dose. Stopped sessions are excluded.

    Args:
        buffer: the sessions. horizon_steps: of the returns.
    """
    drawn = [s for s in buffer.sessions if s.controller == "random" and not s.stopped]
    values = list(map(partial(_values, buffer=buffer, horizon_steps=horizon_steps), drawn))
    found = {}
    for name in QUANTITIES:
        known = [(s.visit, v["energy"], v[name]) for s, v in zip(drawn, values, strict=True) if name in v and "energy" in v]
        if name != "energy" and known:
            visits, energy, y = (np.array(column, dtype=np.float64) for column in zip(*known, strict=True))
            x = np.column_stack([visits[:, None] == np.unique(visits), energy]).astype(np.float64)
            coefficients, _, rank, _ = np.linalg.lstsq(x, y)
            if (freedom := y.size - int(rank)) > 0:
                found[name] = Spread(float(((y - x @ coefficients) ** 2).sum()) / freedom, freedom)
    return found


def _values(session: SessionTrajectory, buffer: ReplayBuffer, horizon_steps: int) -> dict[str, float]:
    amplitude = session.amplitude[~np.isnan(session.amplitude)]
    energy = float(np.mean(amplitude**2)) if amplitude.size else None
    whole = actual_return(session, buffer.settings, horizon_steps).value
    return {name: float(v) for name, v in {**asdict(session.qoc), "energy": energy, "return": whole}.items() if v is not None}


def _known(name: str, sessions: Sequence[TestSession]) -> Floats:
    return np.array([s.values[name] for s in sessions if name in s.values], dtype=np.float64)


def _noise(name: str, groups: Mapping[tuple[str | None, int], Sequence[TestSession]], prior: Spread | None) -> float | None:
    """Estimate the standard deviation of a session of one policy at one visit, as the module's docstring says; None where it is unknown."""
    of_policy: dict[str | None, list[TestSession]] = defaultdict(list)
    for (policy, _), rows in groups.items():
        of_policy[policy] += rows
    squares, freedom = _squares([_known(name, rows) for rows in groups.values()])
    with_visits, more = _squares([_known(name, rows) for rows in of_policy.values()])
    # (sum of squares that counts, its weight, the degrees of freedom that it rests on)
    parts = [(squares, freedom, freedom)]
    if prior is not None:
        weight = min(prior.freedom, PRIOR_FREEDOM)
        parts.append((weight * prior.variance, weight, prior.freedom))
    between, missing = more - freedom, FEWEST - sum(weight for _, weight, _ in parts)
    if between > 0 and missing > 0:
        weight = min(between, missing)
        parts.append((weight * (with_visits - squares) / between, weight, between))
    total = sum(part for part, _, _ in parts)
    weights = sum(weight for _, weight, _ in parts)
    if not weights:
        return None
    if not total:
        return LEAST_ERROR[name]
    rests_on = total**2 / sum(part**2 / of for part, _, of in parts if of)
    return max(float(np.sqrt(total / weights) * stdtrit(rests_on, _WITHIN_ONE)), LEAST_ERROR[name])


def _squares(groups: Sequence[Floats]) -> tuple[float, int]:
    """Compute the sum of squares around the groups' means, and its degrees of freedom."""
    return sum(float(((g - g.mean()) ** 2).sum()) for g in groups if g.size), sum(max(g.size - 1, 0) for g in groups)
