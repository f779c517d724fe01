"""Values that sweeps use: the energy saved by a constant amplitude is known, whatever beta does; tested sessions move what acts alike."""

from __future__ import annotations

import pytest

from ml.ope.posterior import gains
from ml.ope.posterior.gains import Tests, gains_over_cdbs
from ml.ope.posterior.gaussian import TestedDifference
from ml.policies.policy import ConstantPolicy
from ml.population.virtual import world
from ml.trajectories import ReplayBuffer


def test_the_energy_that_a_constant_saves_is_one_less_its_square() -> None:
    found = gains_over_cdbs(world("A", 0).data("stratified", visits=2), {"half": ConstantPolicy(0.5), "cdbs": ConstantPolicy(1.0)})
    assert found["half"].saves == pytest.approx(0.75, abs=0.01)
    assert found["cdbs"].saves == pytest.approx(0.0, abs=0.01)
    assert found["half"].within is not None
    assert found["cdbs"].within == pytest.approx(1.0)


def test_sessions_that_tested_another_policy_move_what_acts_alike(known_buffer: ReplayBuffer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sweep's policies were not tested themselves; one that acts nearly as a tested one did inherits what that one's sessions showed."""
    sweep = {"near": ConstantPolicy(0.72), "far": ConstantPolicy(1.0)}
    before = gains_over_cdbs(known_buffer, sweep)
    shown = {"return": before["near"].gain.value - 15.0, "rating": -4.0}
    differences = tuple(TestedDifference("near", visit, 4, shown, {"return": 1.0, "rating": 0.3}) for visit in (4, 5, 6))
    tests = Tests(differences, {"near": ConstantPolicy(0.7)})
    after = gains_over_cdbs(known_buffer, sweep, tests=tests)
    assert list(after) == ["near", "far"], "the tested policy is no member of the sweep"
    assert after["near"].gain.value < before["near"].gain.value - 7
    assert after["near"].within < before["near"].within - 0.2
    assert after["far"].gain.value == pytest.approx(0.0, abs=0.5), "cDBS by another name"
    monkeypatch.setattr(gains, "AT_A_TIME", 1)
    in_parts = gains_over_cdbs(known_buffer, sweep, tests=tests)
    assert in_parts["near"].gain.value == pytest.approx(after["near"].gain.value, abs=2), "the tested one is replayed beside every part"


def test_a_test_of_a_policy_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match="'gone', which is not among"):
        Tests((TestedDifference("gone", 1, 1, {"return": 1.0}, {"return": 1.0}),))
