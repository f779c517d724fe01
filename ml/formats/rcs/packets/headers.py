"""The clocks that every RC+S packet carries. Source: the format notes, A.2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ml.formats.rcs.packets.facts import FACTS

TICKS_PER_S = 10_000
ROLLOVER = int(FACTS.counters["systemTick"].turn)
ROLLOVER_MS = 1000.0 * ROLLOVER / TICKS_PER_S
LATEST_MS = 2.5e14
"""No PC time is later; what says so is damage."""


@dataclass(frozen=True, slots=True)
class PacketHeaders:
    """Header fields of one stream in file order, all shape [n].

    Attributes:
        seconds: the implant's clock at the last sample, whole seconds.
        tick: the implant's counter of 100 us at the last sample; it restarts every 6.5536 s.
        gen_ms: PacketGenTime, when the PC takes the packet to have been made, ms; 0, negative or NaN where it does not know.
        rx_ms: when it arrived, ms in the PC clock.
        sequence: 8-bit counter of the stream's packets. samples: per channel. rate_hz: samples per second.
    """

    seconds: NDArray[np.int64]
    tick: NDArray[np.int64]
    gen_ms: NDArray[np.float64]
    rx_ms: NDArray[np.float64]
    sequence: NDArray[np.int64]
    samples: NDArray[np.int64]
    rate_hz: NDArray[np.float64]

    @property
    def size(self) -> int:
        """Number of packets n."""
        return int(self.seconds.size)

    @property
    def made_ms(self) -> NDArray[np.float64]:
        """PacketGenTime where the PC knew it, else NaN, [n]."""
        return _plausible_times(self.gen_ms)

    @property
    def arrived_ms(self) -> NDArray[np.float64]:
        """Time of arrival where it is known, else NaN, [n]."""
        return _plausible_times(self.rx_ms)

    @property
    def length_ms(self) -> NDArray[np.float64]:
        """Duration of each packet's signal, [n]."""
        return np.asarray(1000.0 * self.samples / self.rate_hz)

    def take(self, index: NDArray[np.int64]) -> PacketHeaders:
        """Select some of the packets."""
        return PacketHeaders(*(getattr(self, name)[index] for name in PacketHeaders.__slots__))


def _plausible_times(pc_ms: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where((pc_ms > 0) & (pc_ms < LATEST_MS), pc_ms, np.nan)
