"""Beta by amplitude of one session, against windows whose beta follows from the amplitude."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from app.study.sessions.charts import beta_by_amplitude, notes
from app.study.sessions.usable_steps import SessionData


def data(amplitude_ma: np.ndarray[Any, Any], beta: np.ndarray[Any, Any]) -> SessionData:
    """Build a session whose step k has these values, and two windows before it that count for nothing."""
    lead = np.full(2, 99.0)
    table = SimpleNamespace(
        t_s=2.0 * (np.arange(beta.size + 2) - 1),
        beta=np.r_[lead, beta],
        amplitude_ma=np.r_[lead, amplitude_ma],
        fraction=np.r_[lead, amplitude_ma / 4],
        beta_trace=SimpleNamespace(unit="uV"),
    )
    return cast(SessionData, SimpleNamespace(table=table, threshold=1.5))


def test_each_amplitude_has_the_median_and_quartiles_of_its_own_windows() -> None:
    amplitude = np.repeat([1.0, 2.0, 3.0], 101)
    beta = np.concatenate([a + np.linspace(-0.5, 0.5, 101) for a in (9.0, 5.0, 2.0)])
    beta[5] = np.nan
    chart = beta_by_amplitude(data(amplitude, beta))
    assert chart is not None
    rows = [
        [pytest.approx(v, abs=0.02) for v in row] for row in ([1, 100, 9, 8.75, 9.25], [2, 101, 5, 4.75, 5.25], [3, 101, 2, 1.75, 2.25])
    ]
    assert list(chart.rows) == rows
    assert "n = 302 windows" in chart.subtitle


def test_many_amplitudes_are_drawn_in_ten_bins_that_lose_no_window() -> None:
    amplitude = np.random.default_rng(0).uniform(1, 4, 500)
    chart = beta_by_amplitude(data(amplitude, 10 - amplitude))
    assert chart is not None
    assert (len(chart.rows), sum(cast(int, row[1]) for row in chart.rows)) == (10, 500)
    for row in chart.rows:
        assert row[2] == pytest.approx(10 - cast(float, row[0]), abs=0.05)


def test_one_amplitude_says_nothing() -> None:
    assert beta_by_amplitude(data(np.full(50, 3.0), np.ones(50))) is None


def test_notes_are_those_of_the_session_in_its_own_time() -> None:
    times = {"2.0 mA": 130.0, "before": 99.0, "0 mA": 101.0, "after": 900.0}
    events = [{"kind": "operator_note", "t_s": t, "label": label, "data": {}} for label, t in times.items()]
    events.append({"kind": "stimulation", "t_s": 120.0, "label": "log", "data": {}})
    assert notes(events, 100.0, 600.0) == [(1.0, "0 mA"), (30.0, "2.0 mA")]
