"""What the structures get wrong beside what they say they do: constants from part A of the virtual population, never from B or C.

Variance of the error of a component = what the draws say + base^2 + reach^2 leverage, leverage from `ml.ope.posterior.support`. Version 1
was set by hand so that standardised errors on eleven worlds of part A, with both designs, have a variance near 1; no fit over the whole
part was made.
"""

from __future__ import annotations

from dataclasses import dataclass

VERSION = 1
"""Raised with every refit; an estimate keeps it."""


@dataclass(frozen=True)
class ModelError:
    """Standard deviation of what structures get wrong. base: near the data. reach: more, where no session is near."""

    base: float
    reach: float

    def sd(self, leverage: float) -> float:
        """At a leverage in [0, 1]."""
        return float((self.base**2 + self.reach**2 * leverage) ** 0.5)


MODEL_ERRORS = {
    "steps": ModelError(0.025, 0.05),
    "r_end": ModelError(2.0, 4.0),
    "grasp_hz": ModelError(0.04, 0.06),
    "rating": ModelError(0.2, 0.35),
    "tremor_percent": ModelError(5.0, 6.0),
}
"""By component. `steps`: per unit of the reward between r_b and r_a and of the discounted length; the others in their own unit."""

COMMON_SHARE = 0.5
"""Share of the error of a mean over few days, common to all policies, that is drawn: its prior of how days differ is wider than they do."""
