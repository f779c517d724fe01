"""Support by what sessions are as a whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ml.ope.posterior.support import SessionSupport
from ml.ope.support.coverage import AmplitudeSupport
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer
from tests.ml.ope.posterior.known_system import STEPS, KnownSystem


def buffer_of(*doses: tuple[int, str, float]) -> ReplayBuffer:
    """Simulate one session of a constant dose for each (visit, controller, dose)."""
    system, rng = KnownSystem(), np.random.default_rng(0)
    sessions = [system.session(i, v, c, np.full(STEPS, a), rng) for i, (v, c, a) in enumerate(doses)]
    return replace(system.buffer(visits=1), sessions=tuple(sessions))


def at(support: SessionSupport, dose: float, switching: float = 0.0):
    """Compute the support of a policy of constant dose with the burden that the nearest session had."""
    nearest = support.points[np.argmin(np.abs(support.points[:, 0] - dose))]
    return support.of(np.array([dose, dose, nearest[2], switching]))


def test_two_sessions_on_two_visits_near_what_a_policy_would_do_support_it() -> None:
    support = SessionSupport(buffer_of((1, "random", 0.60), (2, "random", 0.66), (1, "cdbs", 1.0)))
    assert at(support, 0.63).supported
    assert at(support, 0.63).flags == ()
    far = at(support, 0.40)
    assert not far.supported
    assert [(f.code, f.value, f.limit, f.unit, f.refuses) for f in far.flags] == [("few_near_sessions", 0.0, 2.0, "sessions", True)]


def test_two_sessions_of_one_visit_are_one_day() -> None:
    support = SessionSupport(buffer_of((1, "random", 0.60), (1, "random", 0.66), (2, "cdbs", 1.0)))
    found = at(support, 0.63)
    assert (found.near_sessions, found.near_visits, found.supported) == (2, 1, False)
    assert [f.code for f in found.flags] == ["few_near_visits"]


def test_one_session_without_stimulation_supports_nothing_that_the_amplitudes_would() -> None:
    """The step-wise check calls stimulation off supported here, because a third of all steps are at 0."""
    buffer = buffer_of((1, "cdbs", 1.0), (2, "cdbs", 1.0), (1, "no_dbs", 0.0))
    assert AmplitudeSupport(buffer).of_policy(ConstantPolicy(0.0)).supported
    found = at(SessionSupport(buffer), 0.0)
    assert (found.near_sessions, found.supported) == (1, False)


def test_the_lowest_supported_dose_was_held_on_two_visits_and_is_no_session_without_stimulation() -> None:
    doses = (1, "random", 0.35), (1, "random", 0.45), (2, "random", 0.5), (2, "cdbs", 1.0), (1, "no_dbs", 0.0), (2, "no_dbs", 0.0)
    assert SessionSupport(buffer_of(*doses)).lowest == 0.5
    assert SessionSupport(buffer_of((1, "cdbs", 1.0), (1, "random", 0.4))).lowest is None


def test_leverage_grows_with_the_distance_from_all_sessions() -> None:
    support = SessionSupport(buffer_of(*((v, "random", a) for v in (1, 2) for a in (0.6, 0.7, 0.8))))
    found = [at(support, dose).leverage for dose in (0.7, 0.5, 0.3, 0.05)]
    assert found == sorted(found)
    assert found[0] < 0.15
    assert found[-1] > 0.9


def test_held_amplitudes_leave_open_what_switching_at_every_step_would_do() -> None:
    support = SessionSupport(buffer_of(*((v, "random", a) for v in (1, 2) for a in (0.6, 0.7, 0.8))))
    steady, switching = at(support, 0.7), at(support, 0.7, switching=0.25)
    assert steady.leverage < 0.15 < 0.8 < switching.leverage
    assert switching.supported
