"""Shared measurements of the synthetic participants: sessions on days of their own, and controllers that follow a timetable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import pytest

from ml.policies.policy import ConstantPolicy
from ml.population import SessionBatch, run_sessions

CODES = ("P1", "P2", "P3", "P4")


class Timetable:
    """Amplitude fractions by step, whatever beta does."""

    def __init__(self, amplitudes: Sequence[float]) -> None:
        self.amplitudes = list(amplitudes)
        self.step = 0

    def act(self, states: np.ndarray) -> np.ndarray:
        value = self.amplitudes[self.step]
        self.step += 1
        return np.full(len(states), value)


@pytest.fixture(scope="session")
def timetable() -> type[Timetable]:
    return Timetable


@pytest.fixture(scope="session")
def constant_sessions() -> Callable[[str, float], SessionBatch]:
    """24 sessions of 5 minutes at one amplitude fraction, on 24 days; the same days and noise for every amplitude."""

    @cache
    def run(code: str, amplitude: float) -> SessionBatch:
        controller = "cdbs" if amplitude == 1 else "no_dbs" if amplitude == 0 else ConstantPolicy(amplitude)
        return run_sessions(code, controller, seeds=range(24), study_seed=range(24), hours=np.linspace(0, 5.5, 24), steps=150)

    return run
