"""Gains of policies over cDBS by the posterior: what sweeps go by, before an evaluation with all its methods.

The structures and weights are those of the ranking, at the size of a first look. Draws are aligned, so that what policies share cancels.
Sessions that tested other policies move the gains of those that act alike, as they do in the ranking.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ml.ope.compare.gain import gain_over
from ml.ope.estimate import Estimate
from ml.ope.posterior.estimator import build
from ml.ope.posterior.gaussian import TestedDifference
from ml.ope.posterior.verdict import outcome_draws, slacks
from ml.policies.policy import ConstantPolicy, Policy
from ml.progress import Report, silent
from ml.qoc import Margins
from ml.returns import Gain
from ml.trajectories import ReplayBuffer

AT_A_TIME = 8
"""Policies that are replayed side by side, with those that were tested: every session of every draw is in memory."""


@dataclass(frozen=True)
class PosteriorGain:
    """One policy's gain over cDBS.

    Attributes:
        gain: of the return. supported: whether sessions are near what the policy would do. `told`: whether the sessions can order policies.
        within: probability that every known QoC is within its margin of cDBS; None where no QoC is known.
        saves: share of cDBS's energy that it is expected to save; None where no energy is predicted.
    """

    gain: Gain
    supported: bool
    told: bool
    within: float | None = None
    saves: float | None = None

    @property
    def expected_saving(self) -> float | None:
        """Share of cDBS's energy that it saves times the probability of keeping the margins; None where either is unknown."""
        return None if self.within is None or self.saves is None else self.within * self.saves


@dataclass(frozen=True)
class Tests:
    """Results of tested sessions.

    Attributes:
        differences: to the same visit's cDBS, over the buffer's median session length. policies: that were tested, by the names in these.

    Raises:
        ValueError: a difference of a policy that is not among them.
    """

    __test__ = False  # no test class of pytest

    differences: tuple[TestedDifference, ...] = ()
    policies: Mapping[str, Policy] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if unknown := sorted({test.policy_name for test in self.differences} - set(self.policies)):
            raise ValueError(f"sessions tested {unknown[0]!r}, which is not among the tested policies")


def gains_over_cdbs(
    buffer: ReplayBuffer,
    policies: Mapping[str, Policy],
    seed: int = 0,
    report: Report = silent,
    margins: Margins | None = None,
    tests: Tests | None = None,
) -> dict[str, PosteriorGain]:
    """Compute the gain of every policy, by name; a policy that acts as cDBS has one of about 0.

    Args:
        buffer: the sessions. policies: whose gains are asked for. seed: of all draws. report: progress.
        margins: the default ones where None. tests: of any policies; each is replayed with those asked for, so that it informs them.

    Raises:
        ValueError: fewer than two sessions with usable steps.
    """
    tests, names = tests or Tests(), list(policies)
    # names of their own: a policy that is asked for may be called as a tested one is, and be another
    tested = {f"tested {name}": policy for name, policy in tests.policies.items()}
    differences = [replace(test, policy_name=f"tested {test.policy_name}") for test in tests.differences]
    fitted = build("posterior", seed, "demo").with_tests(differences).fit(buffer)
    found: dict[str, PosteriorGain] = {}
    for first in range(0, len(names), AT_A_TIME):
        part = names[first : first + AT_A_TIME]
        numbered = {str(k): policy for k, policy in enumerate([*(policies[n] for n in part), ConstantPolicy(1.0)])}
        found_here = fitted.evaluate({**numbered, **tested})
        *estimates, cdbs = (found_here[k] for k in numbered)
        for name, one in zip(part, estimates, strict=True):
            within = _within(one, cdbs, margins or Margins())
            found[name] = PosteriorGain(gain_over(one, cdbs), one.supported, bool(one.details["skill"]["told"]), within, _saves(one, cdbs))
        report(len(found) / len(names), "estimating gains over cDBS")
    return found


def _saves(one: Estimate, cdbs: Estimate) -> float | None:
    ours, theirs = outcome_draws(one, "energy"), outcome_draws(cdbs, "energy")
    return float(1 - ours.mean() / theirs.mean()) if ours is not None and theirs is not None and theirs.mean() > 0 else None


def _within(one: Estimate, cdbs: Estimate, margins: Margins) -> float | None:
    """Compute the share of the draws in which every known QoC is within its margin."""
    gaps = slacks(one, cdbs, margins)
    return float(np.mean(np.min(np.stack(list(gaps.values())), axis=0) >= 0)) if gaps else None
