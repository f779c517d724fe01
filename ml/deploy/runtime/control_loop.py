"""The control loop: one decision per period by the runner's own clock, whatever the device side sends or does not send.

Every period has a time at which its beta amplitude is due. One that comes in time is decided on as it comes. Where none has come within
`GRACE` of a period, the decision is made without it, and the envelope answers with cDBS. One that comes late enters the window and is
decided on with the next one. Periods lost to a standstill of the tablet are not made up for.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

from .controller import BoundedController
from .decision_log import LogFailed, Row
from .envelope import BetaSample, Decision, Reason
from .inputs import DeviceGone, Event, Link
from .protocol import LATEST, WATCHDOG, Peer, Reader, amplitude_line, end_line, greeting

GRACE = 0.2
"""A beta amplitude may come this share of a period after it was due."""
CLOSEST = 0.5
"""Two decisions lie at least this share of a period apart, however many lines come."""
MOST_LINES = 100
"""Lines that are read for one decision; more than that in a period is a fault."""
MISSED = 2.0
"""So many periods between two decisions mean that the deadline of one was missed."""
PHASE_GAIN = 0.1
"""By this share the time of the next one follows a beta amplitude that came early or late, so that two clocks cannot drift apart."""
LEAD_S = 300.0
"""A session ends this long after its planned minutes at the latest, whenever the controller took over."""


class End(StrEnum):
    """End of a session; always on clinical settings."""

    COMPLETE = "complete"
    STOPPED = "stopped"
    INPUT_ENDED = "input_ended"
    STRANGER = "other_device"
    DEVICE_GONE = "device_gone"
    LOG_FAILED = "log_failed"
    EXPIRED = "expired"
    STOOD_STILL = "stood_still"
    FAULT = "fault"


_ENDS = {Event.ENDED: End.INPUT_ENDED, Event.STOP: End.STOPPED}


@dataclass
class LiveSession:
    """One session of a controller with a device side; run once.

    Args:
        controller: within its envelope. peer: who must be connected. link: to the device side, and the clock.
        log: takes every row; raises LogFailed. seconds: length after the first decision of the policy or schedule; None for no end.
        bare: whether lone numbers are taken, on the bench.
        over: whether the day that the bundle is for has ended; asked at every decision. charge: of the tablet's battery, per cent.
        take_over: called before the first amplitude of the policy or schedule leaves; raises LogFailed.

    Attributes:
        rows: of the log, so far. missed: the number of rows after periods that were lost to a standstill. detail: of the end, in words.
    """

    controller: BoundedController
    peer: Peer
    link: Link
    log: Callable[[Row], None]
    seconds: float | None = None
    bare: bool = False
    over: Callable[[], bool] = lambda: False
    charge: Callable[[], float | None] = lambda: None
    take_over: Callable[[], None] = lambda: None
    rows: list[Row] = field(default_factory=list)
    missed: int = 0
    detail: str = ""
    _end: End | None = None
    _began_s: float = 0.0
    _phase_s: float = 0.0
    _phase_known: bool = False
    _took_over_s: float | None = None

    def __post_init__(self) -> None:
        self._limits = self.controller.envelope.limits
        self._period_s = self._limits.period_s
        self._reader = Reader(self.peer, self.bare)
        self._decisions: list[Decision] = []

    @property
    def decisions(self) -> list[Decision]:
        """Every decision so far, at seconds since the start."""
        return self._decisions

    def run(self) -> End:
        """Run to the end of the session. Whatever happens, the last line sent is the return to clinical settings."""
        self._began_s = self._phase_s = self.link.now()
        n = 0
        try:
            self.link.send(greeting(self.peer, self._limits))
            while self._end is None:
                n = max(n + 1, round((self.link.now() - self._phase_s) / self._period_s))
                self._decide(n, *self._collect(n))
        except DeviceGone as error:
            self._break_off(End.DEVICE_GONE, n + 1, str(error))
        except LogFailed as error:
            self._end, self.detail = End.LOG_FAILED, str(error)
        except BaseException as error:
            self._break_off(End.FAULT, n + 1, f"{type(error).__name__}: {error}")
            raise
        finally:
            self._say_end()
        return self._end or End.FAULT

    def _collect(self, n: int) -> tuple[BetaSample | None, list[str]]:
        """Collect what comes until period n is to be decided on: its beta amplitude, and the faults of the link."""
        fresh: BetaSample | None = None
        faults: list[str] = []
        last_s = self._began_s + self.decisions[-1].t_s if self.decisions else -math.inf
        lines = 0
        while True:
            limit_s = self._phase_s + (n + GRACE) * self._period_s
            settled_s = max(self.link.now(), last_s + CLOSEST * self._period_s)
            until_s = min(limit_s, settled_s) if fresh or faults else limit_s
            arrival = self.link.next(until_s)
            if arrival is None:
                break
            lines += 1
            if arrival.event is Event.LOST:
                self._reader.restart()
                fresh = None
                self._distrust("the device is gone", faults)
            elif arrival.event is not Event.LINE:
                self._end = _ENDS[arrival.event]
                break
            elif lines <= MOST_LINES:
                fresh = self._take(arrival.text, arrival.at_s, n, fresh, faults)
                if self._end is not None:
                    break
            else:  # what is more is not read
                fresh = None
                self._distrust(f"more than {MOST_LINES} lines in one period", faults)
                self._reader.restart()
                if self.link.now() >= until_s:
                    break
        if faults and fresh is None:
            self._phase_s = self.link.now() - n * self._period_s  # this decision is made now, the next one a period later
        return fresh, faults

    def _take(self, line: str, at_s: float, n: int, fresh: BetaSample | None, faults: list[str]) -> BetaSample | None:
        """Judge a line. Returns the beta amplitude to decide on in period n, if one has come by now."""
        taken = self._reader.take(line, at_s)
        if taken.stop or taken.stranger:
            self._end, self.detail = (End.STRANGER, taken.stranger) if taken.stranger else (End.STOPPED, "asked for by the device")
            return None
        if taken.fault:
            fresh = None
            self._distrust(taken.fault, faults)
        if taken.sample is None:
            return fresh
        if not self._phase_known:  # the first one says when in a period beta comes
            self._phase_s, self._phase_known = taken.sample.t_s - n * self._period_s, True
        if fresh is not None:
            self._observe(fresh)
        if round((taken.sample.t_s - self._phase_s) / self._period_s) < n:
            self._observe(taken.sample)
            return None
        return taken.sample

    def _distrust(self, what: str, faults: list[str]) -> None:
        """Start the window again."""
        self.controller.envelope.forget()
        self._phase_known = False
        if len(faults) < 3:
            faults.append(what)

    def _observe(self, sample: BetaSample) -> None:
        """Take a beta amplitude that came late, or was overtaken, into the window without a decision."""
        self.controller.observe(self._clock(), self._since_start(sample))

    def _clock(self) -> float:
        """Compute the seconds since the start."""
        return self.link.now() - self._began_s

    def _since_start(self, sample: BetaSample) -> BetaSample:
        return sample._replace(t_s=sample.t_s - self._began_s)

    def _decide(self, n: int, sample: BetaSample | None, faults: list[str]) -> None:
        began = time.perf_counter_ns()
        now_s = self._clock()
        gap_s = now_s - self._decisions[-1].t_s if self._decisions else 0.0
        missed = gap_s > MISSED * self._period_s
        if missed:
            sample = None
            self._distrust(f"the tablet stood still: {gap_s:.1f} s between two decisions", faults)
            self._phase_s = self.link.now() - n * self._period_s
        if gap_s > (WATCHDOG + LATEST) * self._period_s and self._end is None:
            self._end, self.detail = End.STOOD_STILL, "the device has returned to clinical settings"
        decision = self.controller.decide(now_s, sample and self._since_start(sample), Reason.LINK if faults else 0)
        latency_us = (time.perf_counter_ns() - began) / 1000.0
        first = not decision.fallback and self._took_over_s is None
        if first:
            self._took_over_s = now_s
        if self._end is None and self.over():
            self._end = End.EXPIRED
        if self._end is None and self._time_is_up(now_s):
            self._end = End.COMPLETE
        if self._end is None:
            if first:
                self.take_over()
            self.link.send(amplitude_line(len(self.decisions), now_s, decision))
        else:
            decision = self._clinical(decision)
        self.decisions.append(decision)
        self.missed += missed
        due_s = self._phase_s + n * self._period_s
        self._log(n, decision._replace(detail="; ".join([*faults, *filter(None, [decision.detail])])), sample, latency_us, due_s, missed)
        if sample is not None and self._phase_known:
            self._phase_s += PHASE_GAIN * (sample.t_s - due_s)

    def _log(self, n: int, decision: Decision, sample: BetaSample | None, latency_us: float, due_s: float, missed: bool) -> None:
        late_s = max(0.0, self.link.now() - due_s)
        drawn = None if decision.fallback else self.controller.drawn()
        on_grid = decision._replace(t_s=self._began_s + decision.t_s - self._phase_s)
        row = Row(
            n * self._period_s,
            sample,
            on_grid,
            list(self.controller.window),
            latency_us,
            0.0,
            late_s,
            missed,
            drawn,
            self.charge(),
            self._end,
        )
        self.rows.append(row)
        self.log(row)

    def _time_is_up(self, now_s: float) -> bool:
        if self.seconds is None:
            return False
        begun_s = LEAD_S if self._took_over_s is None else min(self._took_over_s, LEAD_S)
        return now_s >= begun_s + self.seconds - CLOSEST * self._period_s

    def _clinical(self, decision: Decision) -> Decision:
        return decision._replace(amplitude_ma=self._limits.cdbs_ma, fallback=True, fraction=None, requested_ma=None)

    def _break_off(self, end: End, n: int, detail: str) -> None:
        """Note an end that came between two decisions, in the log too where that still works."""
        self._end, self.detail = end, detail
        decision = self._clinical(Decision(self._clock(), 0.0, True, 0, None, None, None, 0, detail))
        self.decisions.append(decision)
        try:
            self._log(n, decision, None, 0.0, self.link.now(), missed=False)
        except LogFailed as error:
            self.detail += f"; and {error}"

    def _say_end(self) -> None:
        """Send the last line: clinical settings."""
        try:
            self.link.send(end_line(len(self.decisions), self._clock(), self._limits.cdbs_ma, (self._end or End.FAULT).value))
        except DeviceGone as error:
            self.detail = self.detail or str(error)
