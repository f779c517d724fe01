"""A simulated device side: a synthetic participant whose beta answers to the amplitude, over the tablet's protocol, on a clock of its own.

A whole session runs in the time that its computations take. In between is the very loop that runs in the clinic. With `tamper` a test can
lose, delay, repeat or change what the device sends.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable
from typing import Protocol

import numpy as np

from app.platform.errors import NotFound
from ml.deploy.manifest import BundleManifest
from ml.deploy.runtime.device import DeviceSide
from ml.deploy.runtime.envelope import Signal
from ml.deploy.runtime.inputs import Arrival, Event

_NAME = re.compile(r"([A-Za-z0-9]+)(?::(\d{1,9}))?")
Sent = tuple[float, Event, str]
"""What reaches the runner: seconds after the end of the period that it is about, and as what."""
Tamper = Callable[[int, str], Iterable[Sent]]
"""What becomes of the message about a period: its number, from 0, and the line that the device meant to send."""


def as_sent(_number: int, line: str) -> Iterable[Sent]:
    """Deliver every message, at once and whole."""
    return [(0.0, Event.LINE, line)]


class Brain(Protocol):
    """Measurements of a simulated device: beta in a unit, as from a source."""

    signal: Signal

    def beta(self, amplitude_ma: float) -> float:
        """Compute beta of the next period, in which an amplitude is in force."""


class SyntheticBrain:
    """A synthetic participant: the window before a session first, recorded under cDBS, then one period after the other.

    Args:
        participant: of `ml.population.PARTICIPANTS`. seed: of the session. manifest: of the bundle, for window, period and cDBS amplitude.
        steps: periods after the window; afterwards there is no more.
    """

    def __init__(self, participant: str, seed: int, manifest: BundleManifest, steps: int) -> None:
        from ml.population.env import ParticipantEnv
        from ml.population.participants import PARTICIPANTS

        settings = PARTICIPANTS[participant].mdp_settings(window=manifest.window, period_s=manifest.period_s)
        self._environment, self._cdbs_ma = ParticipantEnv(participant, steps, settings), manifest.cdbs_ma
        window, _ = self._environment.reset(seed=seed)
        self._before = deque(window.tolist())
        self.participant, self.description = participant, f"synthetic participant {participant}, seed {seed}"
        self.signal = Signal("uV", manifest.beta_source)  # the amplitude itself, whatever the device would make it from

    def beta(self, amplitude_ma: float) -> float:
        """Compute beta of the next period, in which an amplitude is in force."""
        if self._before:
            return float(self._before.popleft())
        *_, info = self._environment.step(np.array([amplitude_ma / self._cdbs_ma], dtype=np.float32))
        return float(info["beta"])


def brain_of(text: str, manifest: BundleManifest, steps: int) -> SyntheticBrain:
    """Make the synthetic participant named `P1` or `P1:SEED`. Raises NotFound where there is none."""
    from ml.population import PARTICIPANTS

    found = _NAME.fullmatch(text)
    if found is None or found[1] not in PARTICIPANTS:
        raise NotFound(f"There is no synthetic participant '{text}'.", f"Name one of {', '.join(PARTICIPANTS)}, with :SEED.")
    return SyntheticBrain(found[1], int(found[2] or 0), manifest, steps)


class SimulatedDevice:
    """A device side with a brain, and the clock of both: a `ml.deploy.runtime.inputs.Link`.

    Args:
        brain: answers amplitudes with beta. manifest: of the bundle; the device is the one that it is for.
        tamper: what becomes of the device's messages. clinical_ma: what the device falls back to; the bundle's cDBS where not given.

    Attributes:
        amplitudes_ma: in force over each period that the device has measured. heard: lines of the runner. device: the device side itself.
    """

    def __init__(self, brain: Brain, manifest: BundleManifest, tamper: Tamper = as_sent, clinical_ma: float | None = None) -> None:
        self._brain, self._tamper, self._period_s = brain, tamper, manifest.period_s
        side = manifest.hemisphere or "-"
        clinical = manifest.cdbs_ma if clinical_ma is None else clinical_ma
        self.device = DeviceSide(manifest.participant, side, clinical, manifest.min_ma, manifest.max_ma)
        self.amplitudes_ma: list[float] = []
        self.heard: list[str] = []
        self._said = f"{brain.signal.unit.replace(' ', '_')} {brain.signal.source}"
        hello = f"hello 1 {manifest.participant} {side} {self._said} {1000 * manifest.period_s:g}"
        self._now_s, self._periods = 0.0, 0
        self._coming: list[tuple[float, Event, str]] = [(0.0, Event.LINE, hello)]

    def now(self) -> float:
        """Read the clock of the simulation, in seconds."""
        return self._now_s

    def sleep(self, seconds: float) -> None:
        """Stop the tablet for a while; the device goes on."""
        self._now_s += seconds

    def next(self, until_s: float) -> Arrival | None:
        """Wait for the next arrival, as `Link.next`."""
        while not self._coming or self._coming[0][0] > min(until_s, self._due_s):
            if self._due_s > until_s:
                break
            self._measure()
        if not self._coming or self._coming[0][0] > until_s:
            self._now_s = max(self._now_s, until_s)
            return None
        at_s, event, text = self._coming.pop(0)
        self._now_s = max(self._now_s, at_s)
        return Arrival(self._now_s, event, text)

    def send(self, line: str) -> None:
        """Send a line, as `Link.send`."""
        self.heard.append(line)
        self.device.hear(line, self._now_s)

    @property
    def _due_s(self) -> float:
        """End of the period that is being measured."""
        return (self._periods + 1) * self._period_s

    def _measure(self) -> None:
        """Finish a period on the device: its beta, under the amplitude in force, is sent."""
        due_s, number = self._due_s, self._periods
        amplitude = self.device.look(due_s)
        self.amplitudes_ma.append(amplitude)
        line = f"beta {number} {1000 * due_s:.0f} {self._brain.beta(amplitude):.9g} {self._said}"
        self._coming += [(due_s + delay_s, event, text) for delay_s, event, text in self._tamper(number, line)]
        self._coming.sort(key=lambda sent: sent[0])
        self._periods += 1
