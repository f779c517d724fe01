from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from ml.designs import Bound
from ml.policies.policy import ConstantPolicy
from ml.population import PARTICIPANTS, plan_day, random_controller_buffer, run_day, run_sessions


@pytest.mark.parametrize("seed", range(5))
def test_a_cdbs_session_stands_between_any_two_learned_policies(seed):
    day = plan_day(["a", "b", "c", "d"], random_sessions=1, seed=seed)
    learned = [i for i, planned in enumerate(day) if planned.controller == "rl"]
    assert sorted(planned.policy for planned in day if planned.policy) == ["a", "b", "c", "d"]
    assert all("cdbs" in [planned.controller for planned in day[i:j]] for i, j in pairwise(learned))
    assert all(later.hour > earlier.hour + earlier.steps * 2 / 3600 for earlier, later in pairwise(day))
    assert [planned.steps for planned in day if planned.controller == "no_dbs"] == [150]


def test_impossible_days_are_refused():
    for names, steps in ((["a"] * 2, 300), (["a", "b", "c", "d", "e"], 300), (["a"], 100), (["a"], 601)):
        with pytest.raises(ValueError):
            plan_day(names, steps=steps)


def test_the_sessions_of_a_day_are_those_of_its_plan():
    settings = PARTICIPANTS["P2"].mdp_settings()
    day = plan_day(["half"], steps=150, no_dbs=False)
    sessions = run_day("P2", day, {"half": ConstantPolicy(0.5)}, visit=2, seed=5, settings=settings)
    assert [s.controller for s in sessions] == ["cdbs", "rl", "cdbs"]
    assert sessions[1].amplitude == pytest.approx(np.full(150, 0.5))
    assert not np.array_equal(sessions[0].beta, sessions[2].beta)


def test_an_early_buffer_holds_random_cdbs_and_few_no_dbs_sessions_in_order():
    buffer = random_controller_buffer("P3", visits=3, sessions_per_visit=3, steps=20, seed=1)
    assert [s.controller for s in buffer.sessions] == ["random", "random", "cdbs"] * 3 + ["no_dbs"]
    assert [s.session_id for s in buffer.sessions] == list(range(1, 11))
    assert [s.visit for s in buffer.sessions] == [1] * 3 + [2] * 3 + [3] * 4
    assert buffer.beta_unit == "uV"
    assert buffer.settings.xi_beta == PARTICIPANTS["P3"].reference.xi_beta
    assert buffer.transitions().actions.size == 200
    for session in buffer.sessions:
        if session.controller == "random":
            assert session.random_bound == 0.3
            assert 0.3 <= session.amplitude.min() < 0.5
            assert 0.8 < session.amplitude.max() <= 1
        assert None not in (session.qoc.grasp_hz, session.qoc.rating, session.qoc.tremor_percent)


def test_random_amplitudes_are_uniform_above_the_bound():
    buffer = random_controller_buffer("P1", visits=2, sessions_per_visit=2, steps=150, seed=2)
    drawn = np.sort(np.concatenate([s.amplitude for s in buffer.sessions if s.controller == "random"]))
    expected = 0.3 + 0.7 * (np.arange(drawn.size) + 0.5) / drawn.size
    assert np.abs(drawn - expected).max() < 0.7 * 1.63 / np.sqrt(drawn.size)  # Kolmogorov's bound at 1 %


def test_the_first_visits_of_a_buffer_do_not_depend_on_later_ones():
    short, long = (random_controller_buffer("P4", visits=v, sessions_per_visit=2, steps=15, seed=3) for v in (1, 2))
    assert all(np.array_equal(a.beta, b.beta) for a, b in zip(short.sessions, long.sessions, strict=False))


def test_a_session_can_follow_the_amplitudes_of_a_design():
    laid_out = np.repeat([1.0, 0.55, 0.7], 10)
    batch = run_sessions("P2", laid_out, seeds=[1, 2], steps=30, bound=Bound(0.3), resolution_ma=0.1)
    unit = 0.1 / PARTICIPANTS["P2"].cdbs_amplitude_ma
    np.testing.assert_allclose(batch.amplitude, np.tile(np.rint(laid_out / unit) * unit, (2, 1)))
    assert (batch.controller, batch.bound) == ("random", 0.3)
    for wrong in (laid_out[:20], np.full(30, 0.2), np.full(30, 1.1)):
        with pytest.raises(ValueError, match="a design needs 30 amplitudes"):
            run_sessions("P2", wrong, seeds=[1], steps=30, bound=Bound(0.3))
