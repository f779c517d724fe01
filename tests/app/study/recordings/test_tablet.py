"""Latency and battery of the tablet, against numbers computed by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from app.study.recordings.history import Battery, Latency, by_controller, of_recording
from app.tables.recordings import Recording
from app.tables.sessions import Controller


def log(**said: Any) -> Recording:
    return Recording(details={"settings": {"controller": {"min_ma": 0.5, "max_ma": 3.0} | said}})


def timed(values: np.ndarray[Any, Any]) -> dict[str, float]:
    return {"n": float(values.size), "mean": float(values.mean()), "std": float(values.std()), "median": 0.0, "p99": 0.0}


def test_the_log_tells_latency_in_milliseconds_and_what_a_charge_lasts() -> None:
    found = of_recording(
        log(latency_us={"n": 200.0, "mean": 250.0, "std": 40.0, "median": 1.0, "p99": 1.0}, tablet_battery_percent=[87.0, 85.0],
            tablet_battery_minutes=12.0)
    )  # fmt: skip
    assert found is not None
    assert found.latency == Latency(0.25, 0.04, 200)
    assert found.battery is not None
    assert found.battery.hours_of_a_charge == pytest.approx(10.0)  # 2 % in 0.2 h
    assert Battery(87.0, 86.5, 12.0).hours_of_a_charge is None, "half a percent is what a charge is rounded to"
    assert Battery(87.0, 90.0, 12.0).hours_of_a_charge is None, "it was being charged"


def test_other_recordings_and_older_logs_tell_nothing() -> None:
    assert of_recording(Recording(details={})) is None
    assert of_recording(log(latency_us=None, tablet_battery_percent=None, tablet_battery_minutes=None)) is None
    assert of_recording(log()) is None


def test_latencies_of_sessions_are_pooled_as_if_all_decisions_were_timed_at_once() -> None:
    rng = np.random.default_rng(4)
    first, second, small = rng.normal(500, 60, 200), rng.normal(700, 20, 100), rng.normal(80, 5, 200)
    sessions = [
        (Controller.RL, of_recording(log(latency_us=timed(first)))),
        (Controller.RL, of_recording(log(latency_us=timed(second)))),
        (Controller.DISTILLED, of_recording(log(latency_us=timed(small)))),
        (Controller.CDBS, None),
    ]
    found = by_controller(sessions)
    both = np.concatenate([first, second]) / 1000
    assert list(found) == [Controller.RL, Controller.DISTILLED]
    assert (found[Controller.RL].mean, found[Controller.RL].sd) == (pytest.approx(both.mean()), pytest.approx(both.std()))
    assert (found[Controller.RL].decisions, found[Controller.RL].sessions) == (300, 2)
