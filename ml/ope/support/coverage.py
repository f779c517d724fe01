"""Coverage of a policy by the logged data: checks before any number is believed."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.ope.flags import Fact, Flag, Source
from ml.policies.policy import Policy
from ml.trajectories import ReplayBuffer

NEIGHBOURHOOD = 0.05
"""Logged amplitudes within this fraction of pi(s) count as its neighbours."""

NEIGHBOUR_SHARE = 0.005
"""Fewer neighbours than this share of all logged amplitudes: the data have next to nothing there."""

UNSUPPORTED_SHARE = 0.20
"""Above this share of steps at amplitudes that the data hold next to nothing of, a policy is not supported by the data."""

NOTICE_SHARE = 0.05
"""Above this share the page says so."""

SAME_AMPLITUDE = 0.02
"""A policy whose middle 98 % of amplitudes lie closer together than this does not answer to beta."""

AS_GOOD_AS_OFF = 0.10
"""Below this amplitude a step is as good as without stimulation, for the warning on the page."""

FEW_EFFECTIVE = 10.0
"""Effective sessions below this: importance weights rest on a handful of sessions."""


@dataclass(frozen=True)
class Coverage:
    """Coverage of one policy.

    Attributes:
        outside_range: share of states whose pi(s) is outside the logged amplitudes.
        thin: share of states whose pi(s) has next to no logged amplitude near it (this includes those outside).
        logged_low, logged_high: range of the logged amplitudes.
        n_states: states looked at.
        spread: width of the middle 98 % of the policy's amplitudes. median: of its amplitudes. off: share of steps as good as without
            stimulation.
    """

    outside_range: float
    thin: float
    logged_low: float
    logged_high: float
    n_states: int
    spread: float
    median: float
    off: float

    @property
    def supported(self) -> bool:
        """False when the policy works mostly where the data are silent."""
        return self.thin <= UNSUPPORTED_SHARE

    def flags(self, source: Source = "logged") -> tuple[Flag, ...]:
        """List failing and noteworthy checks: what the data cannot show, and what a clinician should know before picking the policy.

        Args:
            source: of the steps that this is the coverage of.
        """
        found = []
        if self.thin > NOTICE_SHARE:
            found.append(thin(self.thin, source, low=self.logged_low, high=self.logged_high))
        if self.spread < SAME_AMPLITUDE:
            found.append(Flag.of("no_closed_loop", self.median, None, "share", source=source))
        if self.off > NOTICE_SHARE:
            found.append(Flag.of("as_good_as_off", self.off, NOTICE_SHARE, "share", source=source, below=AS_GOOD_AS_OFF))
        return tuple(found)

    def to_json(self) -> dict[str, Any]:
        """Return all numbers, by name."""
        return asdict(self)


def thin(share: float, source: Source, **span: Fact) -> Flag:
    """Flag amplitudes with hardly any logged step near them in a share of the steps; `span` gives `low` and `high` of the logged ones."""
    limit = UNSUPPORTED_SHARE
    return Flag("thin", share, limit, "share", share > limit, source, tuple(span.items()))


class AmplitudeSupport:
    """Amplitudes for which a buffer has data.

    Raises:
        ValueError: the buffer has no usable step.
    """

    def __init__(self, buffer: ReplayBuffer) -> None:
        steps = buffer.transitions()
        self.states = steps.states
        self.sorted_actions = np.sort(steps.actions)

    def look(self, amplitudes: NDArray[Any]) -> Coverage:
        """Compute the coverage of a set of chosen amplitudes, any shape."""
        logged = self.sorted_actions
        chosen = np.asarray(amplitudes, dtype=np.float64).ravel()
        low, high = float(logged[0]), float(logged[-1])
        outside = (chosen < low - 0.5 * NEIGHBOURHOOD) | (chosen > high + 0.5 * NEIGHBOURHOOD)
        near = np.searchsorted(logged, chosen + NEIGHBOURHOOD, "right") - np.searchsorted(logged, chosen - NEIGHBOURHOOD, "left")
        thin = outside | (near < NEIGHBOUR_SHARE * logged.size)
        q01, median, q99 = (float(q) for q in np.quantile(chosen, (0.01, 0.5, 0.99)))
        off = float(np.mean(chosen < AS_GOOD_AS_OFF))
        return Coverage(float(outside.mean()), float(thin.mean()), low, high, chosen.size, q99 - q01, median, off)

    def of_policy(self, policy: Policy) -> Coverage:
        """Compute the coverage of a policy over the states of the buffer."""
        return self.look(policy.act(self.states))


def flags_of(logged: Coverage, simulated: Coverage) -> tuple[Flag, ...]:
    """List the flags of the logged steps under a policy, then what its simulated sessions show beyond them."""
    known = {flag.rounded for flag in logged.flags()}
    return (*logged.flags(), *(flag for flag in simulated.flags("simulated") if flag.rounded not in known))


def few_effective(code: str, effective: float, sessions: int, *, refuses: bool = False) -> Flag:
    """Flag importance weights that rest on a handful of sessions.

    Args:
        code: what rests on them. effective: sample size. sessions: that were weighted. refuses: whether nothing else speaks.
    """
    return Flag.of(code, effective, FEW_EFFECTIVE, "sessions", refuses=refuses, sessions=float(sessions))


def effective_sample_size(log_weights: NDArray[Any]) -> tuple[float, float]:
    """Compute the effective sample size (sum w)^2 / sum w^2 and the largest weight's share, from log weights, shape [N]; 0 and 1 where all
    are zero."""
    logs = np.asarray(log_weights, dtype=np.float64)
    if logs.size == 0 or not np.isfinite(logs.max()):
        return 0.0, 1.0
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    return float(1 / np.sum(weights**2)), float(weights.max())
