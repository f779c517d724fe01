"""Low-passes of polynomials of the dose against a readable loop, running twins, and sessions whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from ml.ope.lead import CDBS, dose_before
from ml.ope.posterior.modes import (
    COLUMNS,
    FALL,
    ONE_SIDED,
    RISE,
    TIMES,
    Filters,
    ModeTable,
    columns_of,
    fit_modes,
    polynomials,
)
from ml.ope.scale import learn_scale
from tests.ml.ope.posterior.known_system import KnownSystem


def readable(a: np.ndarray, first: float) -> np.ndarray:
    """Columns by their definition, one step after the other."""
    rows = []
    passed = {(m, j): float(polynomials(np.array(first))[j]) for m in range(len(TIMES)) for j in range(3)}
    sided = [first] * len(ONE_SIDED)
    for value in a:
        for (m, j), before in passed.items():
            keep = np.exp(-1 / TIMES[m]) if TIMES[m] else 0.0
            passed[m, j] = keep * before + (1 - keep) * float(polynomials(np.array(value))[j])
        for k, before in enumerate(sided):
            sided[k] = before + (RISE if value > before else FALL)[k] * (value - before)
        rows.append([passed[m, j] for m in range(len(TIMES)) for j in range(3)] + sided)
    return np.array(rows)


def test_bends_of_the_dose_are_none_at_both_ends() -> None:
    ends = polynomials(np.array([0.0, 1.0]))
    assert np.allclose(ends, [[0, 0, 0], [1, 0, 0]])


@pytest.mark.parametrize("first", [0.0, 0.4, 1.0])
def test_columns_are_those_of_the_definition_at_once_and_step_by_step(first: float) -> None:
    a = np.random.default_rng(0).random(60)
    expected = readable(a, first)
    assert columns_of(a, first).shape == (60, COLUMNS)
    assert np.allclose(columns_of(a, first), expected, atol=1e-12)
    running = Filters(np.full((2, 1), first))
    assert np.allclose([running.step(np.full((2, 1), value))[1, 0] for value in a], expected, atol=1e-12)


def sustained(buffer, before):
    """Draws of the fall of standardised beta from no stimulation to lasting cDBS, in log beta."""
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
