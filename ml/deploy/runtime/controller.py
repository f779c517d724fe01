"""One controller: a network and the safety envelope around it."""

from __future__ import annotations

from typing import Protocol

from .envelope import BetaSample, Decision, Envelope, EnvelopeLimits, Signal


class WindowNetwork(Protocol):
    """A network that keeps its own window of beta amplitudes."""

    def push(self, beta: float) -> None:
        """Move the window on by one beta amplitude."""

    def fraction(self) -> float:
        """Amplitude fraction for the window as it stands."""


class BoundedController:
    """Beta amplitudes in, one amplitude in mA per period out.

    Args:
        network: asked when its window is whole and fresh.
        limits: the clinician's.
        signal: unit and source of the beta amplitudes that the network was trained on.
    """

    __slots__ = ("_network", "envelope")

    def __init__(self, network: WindowNetwork, limits: EnvelopeLimits, signal: Signal) -> None:
        self._network = network
        self.envelope = Envelope(limits, signal)

    def decide(self, now_s: float, sample: BetaSample | None) -> Decision:
        """Decide on the amplitude of the period that starts now.

        Args:
            now_s: time of this decision, seconds, on the clock of the samples.
            sample: the beta amplitude that came since the last decision; None when none came.
        """
        self.envelope.begin(now_s)
        reasons = 0
        if sample is not None:
            reasons, use = self.envelope.admit(now_s, sample)
            if use:
                self._network.push(sample.beta)
        return self.envelope.decide(now_s, reasons, self._network.fraction)
