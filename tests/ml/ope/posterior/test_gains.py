"""What sweeps go by: the energy that a constant amplitude saves is known, whatever a patient's beta does."""

from __future__ import annotations

import pytest

from ml.ope.posterior.gains import gains_over_cdbs
from ml.policies.policy import ConstantPolicy
from ml.population.virtual import world


def test_the_energy_that_a_constant_saves_is_one_less_its_square() -> None:
    found = gains_over_cdbs(world("A", 0).data("stratified", visits=2), {"half": ConstantPolicy(0.5), "cdbs": ConstantPolicy(1.0)})
    assert found["half"].saves == pytest.approx(0.75, abs=0.01)
    assert found["cdbs"].saves == pytest.approx(0.0, abs=0.01)
    assert found["half"].within is not None
    assert found["cdbs"].within == pytest.approx(1.0)
