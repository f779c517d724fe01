"""What the tablet took for its decisions, and of its battery, by the logs of its controller: measured there, and uploaded with the log."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from app.study.sessions.logged import limits_and_policy
from app.tables.recordings import Recording
from app.tables.sessions import Controller

LEAST_FALL = 1.0
"""Charge, %, that must have gone for a whole charge's hours to be told: what operating systems tell a charge in."""


@dataclass(frozen=True)
class Latency:
    """Time that one whole decision takes on the tablet, ms, as the paper's table has it.

    Attributes:
        mean, sd: over decisions. decisions: timed. sessions: with a log that tells.
    """

    mean: float
    sd: float
    decisions: int
    sessions: int = 1


@dataclass(frozen=True)
class Battery:
    """Charge of the tablet's own battery, %, at the first and the last row of a log that knows it, and the minutes between them."""

    first: float
    last: float
    minutes: float

    @property
    def hours_of_a_charge(self) -> float | None:
        """What a whole charge would last if it went on falling as in this session, hours; None where it hardly fell."""
        fall = self.first - self.last
        return self.minutes / 60 * 100 / fall if fall >= LEAST_FALL else None


@dataclass(frozen=True)
class Runtime:
    """One session on its tablet; None where the log does not tell."""

    latency: Latency | None
    battery: Battery | None


def of_recording(recording: Recording) -> Runtime | None:
    """What a controller's log tells of its tablet; None for other recordings and for logs of before it was measured."""
    said = limits_and_policy(recording)
    if said is None:
        return None
    timed, charge, minutes = said.get("latency_us"), said.get("tablet_battery_percent"), said.get("tablet_battery_minutes")
    latency = Latency(timed["mean"] / 1000, timed["std"] / 1000, int(timed["n"])) if timed else None
    battery = Battery(float(charge[0]), float(charge[1]), float(minutes)) if charge and minutes else None
    return Runtime(latency, battery) if latency or battery else None


def by_controller(found: Iterable[tuple[Controller, Runtime | None]]) -> dict[Controller, Latency]:
    """Latency by controller over sessions: the mean of all timed decisions, and their standard deviation, within and between sessions."""
    each: Mapping[Controller, list[Latency]] = defaultdict(list)
    for controller, runtime in found:
        if runtime is not None and runtime.latency is not None:
            each[controller].append(runtime.latency)
    return {controller: _pooled(own) for controller, own in each.items()}


def _pooled(own: list[Latency]) -> Latency:
    n = np.array([one.decisions for one in own], dtype=np.float64)
    means, sds = np.array([one.mean for one in own]), np.array([one.sd for one in own])
    mean = float(np.sum(n * means) / n.sum())
    variance = float(np.sum(n * (sds**2 + (means - mean) ** 2)) / n.sum())
    return Latency(mean, variance**0.5, int(n.sum()), len(own))
