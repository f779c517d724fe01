"""Additions for the error of the structures: in which unit, and as much as is stated."""

from __future__ import annotations

import numpy as np
import pytest

from ml.ope.posterior.constants import LEAST_POINTS, ModelError, error_unit
from ml.ope.posterior.estimator import Posterior, PosteriorConfig
from ml.policies.policy import ConstantPolicy
from tests.ml.ope.posterior.known_system import KnownSystem

BUFFER = KnownSystem().buffer()
POLICIES = {"half": ConstantPolicy(0.5), "cdbs": ConstantPolicy(1.0)}


def test_a_share_of_time_that_is_nearly_none_or_all_is_hardly_wrong() -> None:
    found = error_unit("tremor_percent", np.array([0.0, 10.0, 50.0, 90.0, 100.0]), 80.0)
    assert found == pytest.approx([LEAST_POINTS, 9.0, 25.0, 9.0, LEAST_POINTS])


def test_step_returns_err_in_units_of_what_they_can_reach_and_others_in_their_own() -> None:
    assert error_unit("steps", np.zeros(2), 80.0).tolist() == [80.0, 80.0]
    assert error_unit("rating", np.array([3.0, 9.0]), 80.0).tolist() == [1.0, 1.0]


def test_draws_differ_by_the_error_that_is_stated() -> None:
    """Of step returns, whose unit does not depend on them: variances add."""

    def spread(errors: dict[str, ModelError]) -> tuple[float, float]:
        fitted = Posterior(PosteriorConfig(draws=24, model_errors=errors)).fit(BUFFER)
        _, supports, draws = fitted.joint(POLICIES, 40)
        return float(draws.values["steps"][0].var()), supports[0].leverage

    without, leverage = spread({})
    stated = ModelError(0.2, 0.4)
    s = BUFFER.settings
    unit = float(np.sum(s.gamma ** np.arange(40))) * abs(s.r_a - s.r_b)
    # 400 draws give a variance to some 14 % at two standard errors
    assert spread({"steps": stated})[0] - without == pytest.approx((unit * stated.sd(leverage)) ** 2, rel=0.2)
