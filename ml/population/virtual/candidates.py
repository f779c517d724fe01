"""Policies to be evaluated in a virtual world: of every quality, from nearly off to always on, and none of which made the data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.policies.policy import ConstantPolicy, Policy, ProportionalPolicy

Floats = NDArray[np.float64]

HIDDEN = 8
MOST = 12
"""Candidates of a world at most."""


class RelayPolicy:
    """Two amplitudes with hysteresis, read from the window alone: up when smoothed beta passes `high`, down when it falls below `low`.

    Args:
        low, high: levels of beta, low < high. below, above: amplitude fractions. newest: betas averaged, at most the window.

    Raises:
        ValueError: levels that do not rise, or an amplitude outside [0, 1].
    """

    def __init__(self, low: float, high: float, below: float, above: float, newest: int = 3) -> None:
        if not low < high:
            raise ValueError(f"the levels of a relay must rise, not {low} and {high}")
        if not (0 <= below <= 1 and 0 <= above <= 1):
            raise ValueError(f"amplitude fractions lie in [0, 1], not {below} and {above}")
        self.low, self.high, self.below, self.above, self.newest = low, high, below, above, newest

    def act(self, states: NDArray[Any]) -> Floats:
        states = np.asarray(states, dtype=np.float64)
        smooth = np.lib.stride_tricks.sliding_window_view(states, self.newest, axis=1).mean(axis=-1)
        crossed = np.where(smooth >= self.high, 1, np.where(smooth <= self.low, -1, 0))
        # the newest smoothed beta outside the band decides; with none in the window it stays on
        newest_first = crossed[:, ::-1]
        at = np.argmax(newest_first != 0, axis=1)
        side = newest_first[np.arange(len(states)), at]
        return np.where(side >= 0, self.above, self.below)


class InversePolicy:
    """Controller that gives most where another gives least, within the range of that one.

    Args:
        policy: a proportional controller.
    """

    def __init__(self, policy: ProportionalPolicy) -> None:
        self.policy = policy

    def act(self, states: NDArray[Any]) -> Floats:
        return self.policy.floor + 1.0 - self.policy.act(states)


@dataclass(frozen=True)
class SmoothPolicy:
    """A random smooth function of the window, of the form that an actor network has: tanh units, a sigmoid at the end.

    Attributes:
        centre, spread: of beta, its unit. inner: [W, HIDDEN]. offset: [HIDDEN]. outer: [HIDDEN]. bias: before the sigmoid.
    """

    centre: float
    spread: float
    inner: Floats
    offset: Floats
    outer: Floats
    bias: float

    @classmethod
    def draw(
        cls, rng: np.random.Generator, centre: float, spread: float, *, bias: float, gain: float, follows: bool, window: int = 10
    ) -> SmoothPolicy:
        """Draw a policy around sigmoid(bias); with `follows` it rises with beta on the whole, else its answer has any sign."""
        rows = rng.normal(size=(window, HIDDEN))
        for _ in range(2):  # neighbouring betas have similar weights
            rows = (np.roll(rows, 1, axis=0) + rows + np.roll(rows, -1, axis=0)) / 3
        rows /= np.abs(rows).sum(axis=0)
        outer = gain * rng.normal(size=HIDDEN) / np.sqrt(HIDDEN)
        if follows:
            outer = np.abs(outer) * np.sign(rows.sum(axis=0))
        return cls(centre, spread, 2 * rows, 0.5 * rng.normal(size=HIDDEN), outer, bias)

    def act(self, states: NDArray[Any]) -> Floats:
        z = (np.asarray(states, dtype=np.float64) - self.centre) / self.spread
        return np.asarray(1 / (1 + np.exp(-(self.bias + np.tanh(z @ self.inner + self.offset) @ self.outer))))


def draw_candidates(rng: np.random.Generator, xi: float, spread: float, window: int = 10) -> dict[str, Policy]:
    """Draw eight to twelve candidates, by name: some far apart, several close to cDBS and to each other, as a training sweep leaves them.

    Args:
        rng: what they are drawn with. xi: beta threshold. spread: standard deviation of beta, both in the unit of beta.
        window: W.
    """

    def uniform(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def proportional(newest: int) -> ProportionalPolicy:
        low = xi - uniform(0.2, 1.2) * spread
        return ProportionalPolicy(low, low + uniform(1.0, 3.0) * spread, uniform(0.1, 0.6), newest)

    def smooth(bias: float, gain: float, follows: bool) -> SmoothPolicy:
        return SmoothPolicy.draw(rng, xi, spread, bias=bias, gain=gain, follows=follows, window=window)

    def relay() -> RelayPolicy:
        return RelayPolicy(xi - 0.3 * spread, xi + 0.3 * spread, uniform(0.2, 0.6), uniform(0.75, 1.0))

    def near_cdbs() -> SmoothPolicy:
        return smooth(uniform(1.2, 3.0), uniform(0.5, 2.0), bool(rng.random() < 0.7))

    found: dict[str, Policy] = {
        "constant low": ConstantPolicy(uniform(0.4, 0.55)),
        "constant middle": ConstantPolicy(uniform(0.55, 0.75)),
        "constant high": ConstantPolicy(uniform(0.75, 0.95)),
        "proportional slow": proportional(window),
        "proportional fast": proportional(int(rng.integers(1, 4))),
        "near cDBS 1": near_cdbs(),
        "near cDBS 2": near_cdbs(),
        "smooth following": smooth(uniform(-0.5, 1.5), uniform(1.0, 3.0), True),
    }
    # drawn whether they are taken or not, so that one of them does not change the others
    optional: dict[str, tuple[float, Policy]] = {
        "relay": (0.6, relay()),
        "near cDBS 3": (0.7, near_cdbs()),
        "smooth any": (0.5, smooth(uniform(-1.5, 2.0), uniform(0.5, 3.0), False)),
        "clone": (0.4, smooth(0.6, 0.4, True)),  # hardly moves from the mean of the random controller
        "nearly off": (0.3, smooth(-3.0, 0.5, True)),
    }
    taken = {name: policy for name, (share, policy) in optional.items() if rng.random() < share}
    return found | dict(list(taken.items())[: MOST - len(found)])


def draw_following(rng: np.random.Generator, xi: float, spread: float, window: int = 10) -> dict[str, Policy]:
    """Draw the twelve candidates of the second population, by name: half of them follow beta.

    Three are constants, two proportional and two dual-threshold controllers. Four have the form that training leaves. The inverse one gives
    least when beta is high.

    Args:
        rng: what they are drawn with. xi: beta threshold. spread: standard deviation of beta, both in the unit of beta.
        window: W.
    """

    def uniform(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def smooth(bias: float, gain: float, follows: bool) -> SmoothPolicy:
        return SmoothPolicy.draw(rng, xi, spread, bias=bias, gain=gain, follows=follows, window=window)

    def proportional(newest: int) -> ProportionalPolicy:
        centre, half = xi + uniform(-0.8, 0.8) * spread, uniform(0.3, 1.0) * spread
        return ProportionalPolicy(centre - half, centre + half, uniform(0.25, 0.7), newest)

    def dual() -> RelayPolicy:
        centre = xi + uniform(-0.8, 0.8) * spread
        return RelayPolicy(centre - 0.2 * spread, centre + 0.2 * spread, uniform(0.25, 0.7), uniform(0.85, 1.0))

    return {
        "constant low": ConstantPolicy(uniform(0.4, 0.55)),
        "constant middle": ConstantPolicy(uniform(0.55, 0.75)),
        "constant high": ConstantPolicy(uniform(0.75, 0.95)),
        "proportional slow": proportional(window),
        "proportional fast": proportional(int(rng.integers(1, 4))),
        "dual 1": dual(),
        "dual 2": dual(),
        "near cDBS 1": smooth(uniform(1.2, 3.0), uniform(0.5, 2.0), True),
        "near cDBS 2": smooth(uniform(1.2, 3.0), uniform(0.5, 2.0), bool(rng.random() < 0.7)),
        "smooth following": smooth(uniform(-0.5, 1.5), uniform(2.0, 4.0), True),
        "smooth any": smooth(uniform(-1.0, 2.0), uniform(0.5, 3.0), False),
        "inverse": InversePolicy(proportional(3)),
    }
