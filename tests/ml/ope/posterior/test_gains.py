"""Which policy the gains by the posterior prefer, and when none."""

from __future__ import annotations

from ml.ope.posterior.gains import PosteriorGain, preferred
from ml.returns import Gain


def one(value: float, low: float, supported: bool = True, told: bool = True) -> PosteriorGain:
    return PosteriorGain(Gain(value, low, 1.0), supported, told)


def test_the_largest_lower_bound_of_a_supported_policy_is_preferred() -> None:
    gains = {"sure": one(3.0, 1.0), "lucky": one(9.0, 0.5), "extrapolated": one(60.0, 50.0, supported=False)}
    assert preferred(gains) == "sure"


def test_none_is_preferred_where_no_bound_lies_above_0_or_nothing_can_be_told() -> None:
    assert preferred({}) is None
    assert preferred({"cDBS": one(0.0, 0.0), "unsure": one(5.0, -1.0)}) is None
    assert preferred({"extrapolated": one(60.0, 50.0, supported=False)}) is None
    assert preferred({"untold": one(60.0, 50.0, told=False)}) is None
