"""A proposed session at a glance: every step that is known is drawn, and no gap is bridged."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from app.ingest.proposals.forms import thumbnail
from app.study.sessions.usable_steps import SessionData


def data(beta: np.ndarray[Any, Any], amplitude_ma: np.ndarray[Any, Any]) -> SessionData:
    """Build a session of these steps, and one window before it."""
    lead = np.full(1, 999.0)
    values = {"beta": np.r_[lead, beta], "amplitude_ma": np.r_[lead, amplitude_ma], "fraction": np.r_[lead, amplitude_ma / 3]}
    trace = SimpleNamespace(unit="uV")
    return cast(SessionData, SimpleNamespace(table=SimpleNamespace(t_s=2.0 * np.arange(beta.size + 1), beta_trace=trace, **values)))


def test_beta_and_amplitude_are_drawn_with_their_units_and_gaps() -> None:
    beta = np.linspace(1, 3, 100)
    beta[40:60] = np.nan
    drawn = thumbnail(data(beta, np.repeat([1.0, 2.0], 50)))
    assert drawn is not None
    assert ("Beta (\u00b5V)" in drawn, "Amplitude (mA)" in drawn) == (True, True)
    first, second = re.findall(r'<path d="([^"]+)"', drawn)
    assert (first.count("M"), first.count("L")) == (2, 78), "two stretches of 80 steps"
    assert second.count("M") == 1
    assert "999" not in drawn, "the window before the session is no part of it"


def test_where_nothing_is_known_nothing_is_drawn() -> None:
    nothing = np.full(10, np.nan)
    assert thumbnail(data(nothing, nothing)) is None
    alone = thumbnail(data(np.ones(10), nothing))
    assert alone is not None
    assert "Amplitude" not in alone
