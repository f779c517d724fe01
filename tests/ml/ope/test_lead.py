"""The amplitude in force before a session: on record where there is one, else inferred, in every method that starts from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ml.ope.doses import fresh_memory, lead_doses, remember
from ml.ope.fqe.score import fqe_value
from ml.ope.fqe.steps import usable_steps
from ml.ope.lead import CDBS, dose_before
from ml.ope.posterior.structures import STRUCTURES
from ml.ope.scale import learn_scale
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer
from tests.ml.ope.posterior.known_system import KnownSystem
from tests.ml.ope.posterior.test_modes import sustained

AGED = (0.0, 0.5, 1.0)
"""Doses that the sessions of a buffer began after, in turn."""


def aged_differently(recorded: bool) -> ReplayBuffer:
    """Simulate sessions that began after doses of their own, which are on record or not."""
    rng, sessions = np.random.default_rng(1), []
    for i in range(24):
        before = AGED[i % 3]
        a = np.ones(200) if i % 4 == 0 else np.repeat(rng.uniform(0.3, 1.0, 10), 20)
        session = KnownSystem(steps_constant=60.0, before=before).session(i, 1 + i // 6, "cdbs" if i % 4 == 0 else "random", a, rng)
        sessions.append(replace(session, lead_amplitude=before if recorded else None))
    return replace(KnownSystem().buffer(visits=1), sessions=tuple(sessions))


@pytest.fixture(scope="module")
def recorded() -> ReplayBuffer:
    return aged_differently(True)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_each_session_starts_from_the_dose_on_record_in_every_structure(recorded: ReplayBuffer, structure: str) -> None:
    fit = STRUCTURES[structure](recorded, learn_scale(recorded), 40, 0, 0.2)
    np.testing.assert_array_equal(fit.drawn.before, [s.lead_amplitude for s in recorded.sessions])
    first = np.full((1, len(fit.drawn.levels), len(recorded.sessions)), 0.7)
    lasting = fit.drawn.response(first, 5).lasting()[0].mean(0)
    assert lasting[0] > lasting[1] > lasting[2], "the less had been on, the more beta there is"
    np.testing.assert_allclose(lasting, np.tile(lasting[:3], 8))
    # one dose, twice the same answer: by record, and by inference for sessions without one
    bare = replace(recorded, sessions=tuple(replace(s, lead_amplitude=None) for s in recorded.sessions))
    same = replace(recorded, sessions=tuple(replace(s, lead_amplitude=0.2) for s in recorded.sessions))
    a, b = (STRUCTURES[structure](buffer, learn_scale(buffer), 4, 0, 0.2).drawn.levels for buffer in (bare, same))
    np.testing.assert_array_equal(a, b)


def test_the_record_finds_the_answer_that_an_inferred_dose_misses(recorded: ReplayBuffer) -> None:
    def error(buffer: ReplayBuffer) -> float:
        return abs(float(np.mean(sustained(buffer, dose_before(buffer)))) + 0.8)

    assert error(recorded) < 0.15
    assert error(aged_differently(False)) > 0.3


def test_memories_of_value_functions_start_from_the_record(recorded: ReplayBuffer) -> None:
    table = usable_steps(recorded, otherwise=0.3)
    ages = np.array([s.lead_amplitude for s in recorded.sessions])
    np.testing.assert_array_equal(table.before, ages)
    first = table.step == 0
    np.testing.assert_allclose(table.memory[first], remember(fresh_memory(ages), table.actions[first]))
    a = np.full(len(ages), 0.6)
    np.testing.assert_allclose(table.first_memory(a), remember(fresh_memory(ages), a))
    np.testing.assert_allclose(table.first_memory(a[:2], recorded.sessions[1:3]), remember(fresh_memory(ages[1:3]), a[:2]))


def test_a_session_without_a_record_takes_the_inferred_dose_alone(recorded: ReplayBuffer) -> None:
    some = [replace(s, lead_amplitude=None) if i % 2 else s for i, s in enumerate(recorded.sessions[:4])]
    np.testing.assert_array_equal(lead_doses(some, 1.0), [0.0, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(lead_doses(some, None), [0.0, np.nan, 1.0, np.nan])
    above = [replace(s, lead_amplitude=1.2) for s in some]
    np.testing.assert_array_equal(lead_doses(above, None), np.ones(4))


def test_nothing_is_inferred_where_every_session_has_a_record(recorded: ReplayBuffer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ml.ope.lead.fit_dynamics", lambda *_: pytest.fail("weighed the accounts"))
    assert dose_before(recorded) == CDBS


def test_a_left_out_session_is_scored_from_its_own_record(recorded: ReplayBuffer) -> None:
    rest = replace(recorded, sessions=recorded.sessions[:12])
    policy, held = ConstantPolicy(0.7), recorded.sessions[12]
    low, high = (fqe_value(rest, policy, [replace(held, lead_amplitude=before)], horizon_steps=40).step_return for before in (0.0, 1.0))
    assert low != high
