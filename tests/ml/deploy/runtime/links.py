"""A link whose lines come at stated times, on a clock that costs no time; and sessions over it."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from ml.deploy.runtime.control_loop import End, LiveSession
from ml.deploy.runtime.controller import BoundedController
from ml.deploy.runtime.decision_log import Row
from ml.deploy.runtime.envelope import EnvelopeLimits, Signal
from ml.deploy.runtime.inputs import Arrival, DeviceGone, Event
from ml.deploy.runtime.network import MlpNetwork
from ml.deploy.runtime.protocol import Peer

PERIOD, W, CDBS = 2.0, 3, 3.0
LIMITS = EnvelopeLimits(
    min_ma=0.6, max_ma=3.0, cdbs_ma=CDBS, ramp_ma_per_s=0.75, window=W, period_s=PERIOD, beta_max=9.0, level_low=0.3, level_high=4.0,
    frozen_after=4,
)  # fmt: skip
SIGNAL = Signal("uV", "time_domain")
PEER = Peer("P1", "left", SIGNAL, PERIOD)
HELLO = "hello 1 P1 left uV time_domain 2000"
Coming = tuple[float, Event, str]


class ScriptedLink:
    """Arrivals at stated times; `stalls` has the number of a wait at which the tablet pauses, and for how long."""

    def __init__(self, coming: Iterable[Coming], stalls: dict[int, float] | None = None, refuses_after: int | None = None) -> None:
        self._coming = sorted(coming, key=lambda c: c[0])
        self._stalls, self._waits, self._refuses_after = stalls or {}, 0, refuses_after
        self.now_s = 100.0
        self.sent: list[tuple[float, str]] = []

    def now(self) -> float:
        return self.now_s

    def next(self, until_s: float) -> Arrival | None:
        self._waits += 1
        self.now_s += self._stalls.pop(self._waits, 0.0)
        if self._coming and self._coming[0][0] + 100.0 <= max(until_s, self.now_s):
            at_s, event, text = self._coming.pop(0)
            self.now_s = max(self.now_s, at_s + 100.0)
            return Arrival(max(at_s + 100.0, self.now_s), event, text)
        self.now_s = max(self.now_s, until_s)
        return None

    def send(self, line: str) -> None:
        if self._refuses_after is not None and len(self.sent) >= self._refuses_after:
            raise DeviceGone("the pipe is closed")
        self.sent.append((self.now_s - 100.0, line))

    @property
    def amplitudes(self) -> list[tuple[float, float]]:
        """Times at which amplitudes went out, and the amplitudes, mA."""
        return [(at, float(line.split()[3])) for at, line in self.sent if line.startswith("amplitude")]


def network(window: int = W) -> MlpNetwork:
    """Build a network that requests 0.2 of cDBS for any input: an amplitude that shows at once when it is followed."""
    weights = [(np.zeros((2, window), dtype=np.float32), np.zeros(2, dtype=np.float32))]
    last = (np.zeros((1, 2), dtype=np.float32), np.array([np.arctanh(2 * 0.2 - 1)], dtype=np.float32))
    return MlpNetwork([*weights, last], 1.0, 1.0)


def beta_line(k: int, beta: float | None = None, seq: int | None = None, sent_s: float | None = None, said: str = "uV time_domain") -> str:
    """Write the message about period k, from 0, sent at 2 (k + 1) s; beta varies a little."""
    value = 1.0 + 0.01 * (k % 5) if beta is None else beta
    return f"beta {k if seq is None else seq} {1000 * (PERIOD * (k + 1) if sent_s is None else sent_s):.0f} {value} {said}"


def betas(periods: Iterable[int], **changes: object) -> list[Coming]:
    """List messages in time about periods."""
    return [(PERIOD * (k + 1), Event.LINE, beta_line(k, **changes)) for k in periods]  # type: ignore[arg-type]


def session(
    link: ScriptedLink, rows: list[Row] | None = None, controller: BoundedController | None = None, **changes: object
) -> LiveSession:
    """Build a session that has not run yet."""
    kept: list[Row] = [] if rows is None else rows
    log: Callable[[Row], None] = kept.append
    return LiveSession(controller or BoundedController(network(), LIMITS, SIGNAL), PEER, link, log, **changes)  # type: ignore[arg-type]


def ran(coming: Iterable[Coming], until_s: float, hello: bool = True, **options: object) -> tuple[ScriptedLink, LiveSession, End]:
    """Run a session that ends when its input does."""
    greeted = [(0.0, Event.LINE, HELLO)] if hello else []
    link = ScriptedLink([*greeted, *coming, (until_s, Event.ENDED, "")], **options)  # type: ignore[arg-type]
    one = session(link)
    return link, one, one.run()


def followed(one: LiveSession) -> list[bool]:
    """List for each decision whether the network was followed."""
    return [not d.fallback for d in one.decisions]
