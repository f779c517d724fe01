"""Low-passes of dose functions against a readable loop, running twins, and sessions whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from ml.mdp import MdpSettings
from ml.ope.lead import CDBS, dose_before
from ml.ope.posterior.modes import (
    COLUMNS,
    FALL,
    FALL_TIMES,
    ONE_SIDED,
    RISE,
    SHAPES,
    TIMES,
    Filters,
    ModeTable,
    columns_of,
    dose_functions,
    fit_modes,
)
from ml.ope.scale import learn_scale
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory
from tests.ml.ope.posterior.known_system import KnownSystem


def readable(a: np.ndarray, first: float) -> np.ndarray:
    """Compute columns by their definition, one step after the other."""
    rows = []
    passed = {(m, j): float(dose_functions(np.array(first))[j]) for m in range(len(TIMES)) for j in range(SHAPES)}
    sided, falls, last = [first] * len(ONE_SIDED), [0.0] * len(FALL_TIMES), first
    for value in a:
        for (m, j), before in passed.items():
            keep = np.exp(-1 / TIMES[m]) if TIMES[m] else 0.0
            passed[m, j] = keep * before + (1 - keep) * float(dose_functions(np.array(value))[j])
        for k, before in enumerate(sided):
            sided[k] = before + (RISE if value > before else FALL)[k] * (value - before)
        for k, time in enumerate(FALL_TIMES):
            falls[k] = np.exp(-1 / time) * falls[k] + (1 - np.exp(-1 / time)) * 5 * max(last - value, 0)
        last = value
        rows.append([passed[m, j] for m in range(len(TIMES)) for j in range(SHAPES)] + sided + falls)
    return np.array(rows)


def test_bends_of_the_dose_are_none_at_both_ends() -> None:
    ends = dose_functions(np.array([0.0, 1.0]))
    assert np.allclose(ends, [[0, 0, 0, 0], [1, 0, 0, 0]])


@pytest.mark.parametrize("first", [0.0, 0.4, 1.0])
def test_columns_are_those_of_the_definition_at_once_and_step_by_step(first: float) -> None:
    a = np.random.default_rng(0).random(60)
    expected = readable(a, first)
    assert columns_of(a, first).shape == (60, COLUMNS)
    assert np.allclose(columns_of(a, first), expected, atol=1e-12)
    running = Filters(np.full((2, 1), first))
    assert np.allclose([running.step(np.full((2, 1), value))[:, 1, 0].copy() for value in a], expected, atol=1e-12)


def sustained(buffer, before):
    """Draw the fall of standardised beta from no stimulation to lasting cDBS, in log beta."""
    scale = learn_scale(buffer)
    tables = [ModeTable.of(s, scale, before) for s in buffer.sessions]
    drawn = fit_modes(buffer, tables, before).drawn(300, np.random.default_rng(0))
    lasting = columns_of(np.ones(1), 1.0)[0] - columns_of(np.zeros(1), 0.0)[0]
    return drawn.gains @ lasting * scale.beta_std


def test_the_sustained_answer_of_a_slow_system_is_found_within_its_interval() -> None:
    low, middle, high = np.percentile(sustained(KnownSystem(steps_constant=60.0).buffer(), 1.0), [2.5, 50, 97.5])
    assert low < -0.8 < high
    assert middle == pytest.approx(-0.8, abs=0.2)
    assert high - low < 0.7


def test_what_was_on_before_the_sessions_is_told_by_beta() -> None:
    """cDBS is expected; sessions that began in balance with their own first dose say so."""
    assert dose_before(KnownSystem(steps_constant=40.0, before=1.0).buffer()) == CDBS
    assert dose_before(KnownSystem(steps_constant=40.0, before=None).buffer(visits=4)) is None


def test_a_wrong_account_of_the_dose_before_costs_the_answer_to_sustained_dose() -> None:
    buffer = KnownSystem(steps_constant=120.0, before=1.0).buffer(visits=4)
    right, wrong = (abs(float(np.mean(sustained(buffer, before))) + 0.8) for before in (1.0, None))
    assert right < wrong


def test_a_rebound_after_falls_is_not_taken_for_an_answer_to_the_dose() -> None:
    """Beta answers to no dose, yet rises after every fall: it is high under a random controller because that switches, not by its dose."""
    rng = np.random.default_rng(4)
    sessions = []
    for i in range(12):
        a = np.ones(300) if i % 3 == 0 else rng.uniform(0.3, 1.0, 300)
        fall, eta, x = 0.0, 0.0, []
        for last, value in zip(np.concatenate([[1.0], a[:-1]]), a, strict=True):
            fall = 0.8 * fall + max(last - value, 0.0)
            eta = 0.5 * eta + 0.1 * rng.standard_normal()
            x.append(0.8 * fall + eta)
        lead = 0.1 * rng.standard_normal(10)
        sessions.append(SessionTrajectory(i + 1, 1 + i // 4, "cdbs" if i % 3 == 0 else "random", np.exp(lead), np.exp(x), a, Qoc()))
    buffer = ReplayBuffer(MdpSettings(xi_beta=1.2, lower_bound=0.3), tuple(sessions), "uV", "table")
    scale = learn_scale(buffer)
    tables = [ModeTable.of(s, scale, 1.0) for s in buffer.sessions]
    gains = fit_modes(buffer, tables, 1.0).mean.gains[0]
    held, full = (columns_of(np.full(400, dose), 1.0)[-1] for dose in (0.65, 1.0))
    switching = np.concatenate([columns_of(rng.uniform(0.3, 1.0, 300), 1.0)[-50:] for _ in range(4)]).mean(0)
    rise = (switching - full) @ gains * scale.beta_std
    assert rise > 0.25  # what the random sessions showed: 0.8 x 0.1167 / 0.2 = 0.47
    assert abs((held - full) @ gains * scale.beta_std) < 0.5 * rise
