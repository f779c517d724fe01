"""Known recordings, which the writers of each format write: samples with bursts, gaps, and an amplitude by steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np


@dataclass(frozen=True)
class Truth:
    """A recording whose content is known.

    Attributes:
        rate_hz: of the samples. t_s: true time of each sample, [n], without those that were lost.
        channels: samples in uV by the channel's name, [n] each.
        steps: (time in s, amplitude in mA) from which it holds; the first one is the first that is stated.
        gaps: (first lost, number lost) in samples of the whole recording.
    """

    rate_hz: float
    t_s: np.ndarray
    channels: dict[str, np.ndarray]
    steps: list[tuple[float, float]]
    gaps: list[tuple[int, int]] = field(default_factory=list)
    total: int = 0

    def pieces(self) -> list[tuple[int, int]]:
        """Begin and end of each gap-free piece, in the samples that are there."""
        edges = np.flatnonzero(np.diff(self.t_s) > 1.25 / self.rate_hz) + 1
        bounds = [0, *edges.tolist(), self.t_s.size]
        return list(pairwise(bounds))

    def amplitude_at(self, t_s: float) -> float:
        """Return the amplitude in force, mA; NaN before the first step."""
        return next((a for t, a in reversed(self.steps) if t <= t_s), float("nan"))


def make_truth(
    rng: np.random.Generator,
    seconds: float = 60.0,
    rate_hz: float = 250.0,
    names: tuple[str, ...] = ("LFP L 0-2", "LFP L 1-3"),
    gaps: int = 2,
    steps: int = 3,
    block: int = 1,
) -> Truth:
    """Make a recording with bursts of 20 Hz, gaps and steps. Gaps and their places are multiples of `block` samples."""
    n = int(seconds * rate_hz) // block * block
    there = np.ones(n, dtype=bool)
    lost: list[tuple[int, int]] = []
    for _ in range(gaps):
        size = max(1, int(rng.integers(2, max(3, int(2 * rate_hz))) // block)) * block
        begin = int(rng.integers(int(0.1 * n), int(0.85 * n)) // block) * block
        if there[max(0, begin - 4 * block) : begin + size + 4 * block].all() and begin + size < 0.95 * n:
            there[begin : begin + size] = False
            lost.append((begin, size))
    t = np.arange(n) / rate_hz
    burst = 1.0 + 4.0 * (np.sin(2 * np.pi * 0.1 * t + rng.uniform(0, 6)) > 0.3)
    channels = {}
    for name in names:
        x = burst * np.sin(2 * np.pi * 20.0 * t + rng.uniform(0, 6)) + rng.normal(0, 2.0, n)
        channels[name] = x[there]
    at = np.sort(rng.uniform(0.05 * seconds, 0.9 * seconds, steps))
    doses = [(float(a), round(float(rng.uniform(0, 4)), 1)) for a in at]
    return Truth(rate_hz, t[there], channels, doses, sorted(lost), n)
