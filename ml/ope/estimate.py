"""Input and output of every off-policy estimator. Source of the quantity: Gao et al. 2023, eq:ope_total_return."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Protocol

from ml.ope.flags import Flag
from ml.outcomes import PREDICTED
from ml.policies.policy import Policy
from ml.progress import Report, silent
from ml.trajectories import ReplayBuffer

LEVEL = 0.90
"""Coverage of the intervals that estimators report."""

STORED_VERSION = 2
"""Version of `Estimate.to_json`."""

OUTCOMES = ("r_end", *(o.field for o, _ in PREDICTED))
"""End-of-session outcomes, in the order of every array that holds them."""


@dataclass(frozen=True)
class Estimate:
    """One method's estimate of one policy's expected return E[r_end + sum over t < H of gamma^t r_t], not normalised.

    Attributes:
        method: `dlsm`, `linear`, `pdis`, `wis`, ...
        value: the estimate; finite.
        low, high: interval of `level`.
        level: coverage aimed at.
        standard_error: of `value`.
        step_return: the part of `value` from the steps.
        end_reward: the part from r_end; None where no session of the buffer has an r_end (then `value` lacks it and a flag says so).
        predicted: what the method predicts besides: `energy` (mean a^2), `mean_amplitude`, `mean_beta` (participant's unit), and outcomes
            by their field. A key is absent where the method cannot say.
        supported: False when the data cannot speak about this policy.
        flags: the reasons why the data cannot speak, and warnings.
        n: sessions or roll-outs behind the value.
        details: everything else, JSON-able; `draws` (aligned over the policies of one method) feeds the probability of being best.
    """

    method: str
    value: float
    low: float
    high: float
    level: float
    standard_error: float
    step_return: float
    end_reward: float | None
    predicted: dict[str, float]
    supported: bool
    flags: tuple[Flag, ...]
    n: int
    details: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("value", "low", "high", "standard_error", "step_return"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{self.method}: {name} of an estimate must be finite, not {getattr(self, name)}")

    def to_json(self) -> dict[str, Any]:
        """Convert every field and the version of their form to JSON."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return values | {"flags": [flag.to_json() for flag in self.flags], "version": STORED_VERSION}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Estimate:
        """Read what `to_json` made.

        Raises:
            ValueError: another version than this betaloop knows.
        """
        if (version := stored.get("version")) != STORED_VERSION:
            raise ValueError(f"an estimate of form {version} was stored by another betaloop; this one reads form {STORED_VERSION}")
        values = {f.name: stored[f.name] for f in fields(cls)}
        return cls(**values | {"flags": tuple(Flag.from_json(flag) for flag in stored["flags"])})


class Fitted(Protocol):
    """An estimator that has seen the data."""

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Estimate every policy, by its name; the horizon H defaults to the buffer's median session length."""


class Estimator(Protocol):
    """A method of off-policy evaluation."""

    @property
    def method(self) -> str:
        """Key of the method, such as `dlsm`."""

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> Fitted:
        """Learn from the buffer; with a `checkpoint_dir` an interrupted fit goes on where it stopped."""


def require_two_sessions(what: str, with_steps: int) -> None:
    """Refuse to fit where no second session shows how sessions differ.

    Args:
        what: is fitted, as a sentence begins with it. with_steps: sessions with usable steps.

    Raises:
        ValueError: there are fewer than two.
    """
    if with_steps < 2:
        raise ValueError(f"{what} needs at least two sessions with usable steps; the buffer has {with_steps}")


def checked_horizon(buffer: ReplayBuffer, horizon_steps: int | None) -> int:
    """Check H, defaulting to the median session length. Raises ValueError when it is not a positive number of steps."""
    horizon = buffer.median_steps() if horizon_steps is None else horizon_steps
    if horizon < 1:
        raise ValueError(f"the horizon must be at least 1 step, not {horizon}")
    return horizon
