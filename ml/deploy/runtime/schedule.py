"""Amplitudes laid out beforehand, for random, titration, cDBS and no-DBS sessions: within the same envelope as a network."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import Any

from .controller import BoundedController
from .envelope import BetaSample, Decision, EnvelopeLimits, Signal


@dataclass(frozen=True)
class ScheduledHold:
    """One constant amplitude: first step and length, fraction of cDBS, and the log of its density; None where nothing was drawn."""

    start: int
    steps: int
    amplitude: float
    log_density: float | None


@dataclass(frozen=True)
class Schedule:
    """Amplitudes of a session without a network.

    Attributes:
        design: `paper`, `stratified`, `ladder`, `near`, or `constant`.
        level, seed, lower_bound: of the design; None where it has none.
        holds: in order and without gaps from step 0; cDBS follows the last one.

    Raises:
        ValueError: no hold, a gap, or an amplitude outside [0, 1].
    """

    design: str
    level: float | None
    seed: int | None
    lower_bound: float | None
    holds: tuple[ScheduledHold, ...]

    def __post_init__(self) -> None:
        at = 0
        for number, hold in enumerate(self.holds):
            if hold.start != at or hold.steps < 1 or not 0 <= hold.amplitude <= 1:
                raise ValueError(f"hold {number} of the schedule, {hold}, does not follow step {at} or is no fraction")
            at += hold.steps
        if not at:
            raise ValueError("the schedule holds no amplitude")

    def hold_at(self, step: int) -> int | None:
        """Find the index of the hold that a step belongs to; None after the last."""
        index = bisect_right([hold.start for hold in self.holds], step) - 1
        return index if 0 <= step < self.holds[index].start + self.holds[index].steps else None

    @staticmethod
    def from_json(stored: dict[str, Any]) -> Schedule:
        """Read what `dataclasses.asdict` gave. Raises ValueError, KeyError or TypeError for another shape."""
        return Schedule(**stored | {"holds": tuple(ScheduledHold(**hold) for hold in stored["holds"])})


class _Wish:
    """The schedule in the place of a network: it answers with the fraction of the present step."""

    def __init__(self, schedule: Schedule, period_s: float) -> None:
        self._schedule, self._period_s = schedule, period_s
        self._began_s: float | None = None
        self.now_s = 0.0
        self.hold: int | None = None

    def push(self, beta: float) -> None:
        """Ignore beta: it changes no amplitude of a schedule. That it comes is the envelope's condition."""

    def fraction(self) -> float:
        """Compute the fraction of the step that begins now; step 0 is the first one that is asked for."""
        if self._began_s is None or self.now_s < self._began_s:
            self._began_s = self.now_s
        step = round((self.now_s - self._began_s) / self._period_s)
        self.hold = self._schedule.hold_at(step)
        return 1.0 if self.hold is None else self._schedule.holds[self.hold].amplitude


class ScheduledController(BoundedController):
    """A schedule within the safety envelope. The first step is the first decision after a whole window of valid beta amplitudes.

    Args:
        schedule: what is wished. limits: the clinician's. signal: of the beta amplitudes, whose silence leads to cDBS here too.
    """

    __slots__ = ("_wish", "schedule")

    def __init__(self, schedule: Schedule, limits: EnvelopeLimits, signal: Signal) -> None:
        self._wish = _Wish(schedule, limits.period_s)
        super().__init__(self._wish, limits, signal)
        self.schedule = schedule

    def fresh(self) -> ScheduledController:
        """Copy the schedule at its first step."""
        return ScheduledController(self.schedule, self.envelope.limits, self.envelope.signal)

    def decide(self, now_s: float, sample: BetaSample | None, reasons: int = 0) -> Decision:
        """Decide as `BoundedController.decide`; a clock that runs back restarts the schedule, within the same limits."""
        self._wish.now_s, self._wish.hold = now_s, None
        return super().decide(now_s, sample, reasons)

    def drawn(self) -> tuple[int, float | None] | None:
        """Return the hold of the last decision and the log of its density; None where the schedule was not followed or has ended."""
        index = self._wish.hold
        return None if index is None else (index, self.schedule.holds[index].log_density)
