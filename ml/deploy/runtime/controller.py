"""One controller: a network and the safety envelope around it."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from .envelope import BetaSample, Decision, Envelope, EnvelopeLimits, Signal


class WindowNetwork(Protocol):
    """A network that keeps its own window of beta amplitudes."""

    def push(self, beta: float) -> None:
        """Move the window on by one beta amplitude."""

    def fraction(self) -> float:
        """Compute the amplitude fraction for the current window."""


class BoundedController:
    """Beta amplitudes in, one amplitude in mA per period out.

    Args:
        network: asked when its window is whole and fresh.
        limits: the clinician's.
        signal: unit and source of the beta amplitudes that the network was trained on.

    Attributes:
        window: beta amplitudes that the network was given, imputed ones too, the newest last; at most W.
    """

    __slots__ = ("envelope", "network", "window")

    def __init__(self, network: WindowNetwork, limits: EnvelopeLimits, signal: Signal) -> None:
        self.network = network
        self.envelope = Envelope(limits, signal)
        self.window: deque[float] = deque(maxlen=limits.window)

    def fresh(self) -> BoundedController:
        """Copy the controller at the start of a session; the network is shared, and its window is filled before it is asked."""
        return BoundedController(self.network, self.envelope.limits, self.envelope.signal)

    def observe(self, now_s: float, sample: BetaSample) -> int:
        """Take a beta amplitude in without deciding on it, as one that came late. Returns the reasons against it."""
        self.envelope.begin(now_s)
        reasons, taken = self.envelope.admit(now_s, sample)
        for beta in taken:
            self.network.push(beta)
        self.window.extend(taken)
        return reasons

    def decide(self, now_s: float, sample: BetaSample | None, reasons: int = 0) -> Decision:
        """Decide on the amplitude of the period that starts now.

        Args:
            now_s: time of this decision, seconds, on the clock of the samples.
            sample: the beta amplitude that came since the last decision; None when none came.
            reasons: what the loop itself found wrong since the last decision, as bits of `Reason`.
        """
        if sample is None:
            self.envelope.begin(now_s)
        else:
            reasons |= self.observe(now_s, sample)
        return self.envelope.decide(now_s, reasons, self.network.fraction)

    def drawn(self) -> tuple[int, float | None] | None:
        """Index and log density of the drawn amplitude that the last decision delivers; None for a network, which draws nothing."""
        return None
