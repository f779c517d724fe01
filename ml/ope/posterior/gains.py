"""Gains of policies over cDBS by the posterior: what sweeps go by, before an evaluation with all its methods.

The structures and weights are those of the ranking, at the size of a first look. Draws are aligned, so that what policies share cancels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ml.ope.compare.gain import gain_over
from ml.ope.posterior.estimator import build
from ml.policies.policy import ConstantPolicy, Policy
from ml.progress import Report, silent
from ml.returns import Gain
from ml.trajectories import ReplayBuffer

AT_A_TIME = 8
"""Policies that are replayed side by side: every session of every draw is in memory."""


@dataclass(frozen=True)
class PosteriorGain:
    """One policy's gain over cDBS.

    Attributes:
        gain: of the return. supported: whether sessions lie near what the policy would do. told: whether the sessions can order policies.
    """

    gain: Gain
    supported: bool
    told: bool


def gains_over_cdbs(
    buffer: ReplayBuffer, policies: Mapping[str, Policy], seed: int = 0, report: Report = silent
) -> dict[str, PosteriorGain]:
    """Gain of every policy, by name; a policy that acts as cDBS has one of about 0.

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
            found[name] = PosteriorGain(gain_over(one, cdbs), one.supported, bool(one.details["skill"]["told"]))
        report(len(found) / len(names), "estimating gains over cDBS")
    return found
