"""Gains of policies over cDBS by the posterior: what sweeps go by, before an evaluation with all its methods.

The structures and weights are those of the ranking, at the size of a first look. Draws are aligned, so that what policies share cancels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ml.ope.compare.gain import gain_over
from ml.ope.estimate import Estimate
from ml.ope.posterior.estimator import build
from ml.ope.posterior.verdict import outcome_draws, slacks
from ml.policies.policy import ConstantPolicy, Policy
from ml.progress import Report, silent
from ml.qoc import Margins
from ml.returns import Gain
from ml.trajectories import ReplayBuffer

AT_A_TIME = 8
"""Policies that are replayed side by side: every session of every draw is in memory."""


@dataclass(frozen=True)
class PosteriorGain:
    """One policy's gain over cDBS.

    Attributes:
        gain: of the return. supported: whether sessions lie near what the policy would do. told: whether the sessions can order policies.
        within: probability that every known QoC lies within its margin of cDBS; None where no QoC is known.
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


def gains_over_cdbs(
    buffer: ReplayBuffer, policies: Mapping[str, Policy], seed: int = 0, report: Report = silent, margins: Margins | None = None
) -> dict[str, PosteriorGain]:
    """Gain of every policy, by name; a policy that acts as cDBS has one of about 0. `margins` are the default ones where None.

    Raises:
        ValueError: fewer than two sessions with usable steps.
    """
    fitted, names = build("posterior", seed, "demo").fit(buffer), list(policies)
    found: dict[str, PosteriorGain] = {}
    for first in range(0, len(names), AT_A_TIME):
        part = names[first : first + AT_A_TIME]
        numbered = {str(k): policy for k, policy in enumerate([*(policies[n] for n in part), ConstantPolicy(1.0)])}
        *estimates, cdbs = fitted.evaluate(numbered).values()
        for name, one in zip(part, estimates, strict=True):
            within = _within(one, cdbs, margins or Margins())
            found[name] = PosteriorGain(gain_over(one, cdbs), one.supported, bool(one.details["skill"]["told"]), within, _saves(one, cdbs))
        report(len(found) / len(names), "estimating gains over cDBS")
    return found


def _saves(one: Estimate, cdbs: Estimate) -> float | None:
    ours, theirs = outcome_draws(one, "energy"), outcome_draws(cdbs, "energy")
    return float(1 - ours.mean() / theirs.mean()) if ours is not None and theirs is not None and theirs.mean() > 0 else None


def _within(one: Estimate, cdbs: Estimate, margins: Margins) -> float | None:
    """Share of the draws in which every known QoC lies within its margin."""
    gaps = slacks(one, cdbs, margins)
    return float(np.mean(np.min(np.stack(list(gaps.values())), axis=0) >= 0)) if gaps else None
