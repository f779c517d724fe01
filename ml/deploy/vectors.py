"""Test vectors: beta windows with the fractions that every runtime must give, and one session in which beta goes wrong in every way."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.deploy.manifest import BundleManifest
from ml.deploy.runtime.controller import BoundedController
from ml.deploy.runtime.envelope import BetaSample, Signal, reason_names

TOLERANCE = 1e-5
"""Largest difference between two runtimes on a test vector, amplitude fraction; times the cDBS amplitude, of a decision."""
_SCALES = (0.0, 1e-3, 1.0, 1e3, 1e6)


@dataclass(frozen=True)
class Step:
    """One decision of the session: when, what came (`t_s` None: nothing; `beta` NaN: no number), and what must be delivered."""

    now_s: float
    t_s: float | None
    beta: float
    unit: str
    source: str
    amplitude_ma: float
    reasons: int

    @property
    def finite(self) -> bool:
        """True where beta is a number."""
        return math.isfinite(self.beta)


def edge_windows(windows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Add windows of many scales that drive the network into saturation to the windows given. Shape [M + 10, W]."""
    level = float(np.abs(windows).mean()) or 1.0
    ramp = np.linspace(0.0, 2.0, windows.shape[1])
    return np.concatenate([windows, *(np.stack([np.ones_like(ramp), ramp]) * level * scale for scale in _SCALES)])


def session(manifest: BundleManifest, controller: BoundedController, windows: NDArray[np.float64]) -> list[Step]:
    """Run the session through the Python controller; what it decides is what others must decide."""
    signal = Signal(manifest.beta_unit, manifest.beta_source)
    steps = []
    for now_s, sample in _script(manifest, signal, np.abs(windows).ravel()):
        decision = controller.decide(now_s, sample)
        came, beta, (unit, source) = sample or (None, math.nan, signal)
        steps.append(Step(now_s, came, beta, unit, source, decision.amplitude_ma, decision.reasons))
    return steps


def _script(manifest: BundleManifest, signal: Signal, betas: NDArray[np.float64]) -> Iterator[tuple[float, BetaSample | None]]:
    """Yield times and samples: start, NaN, negative, silence, wrong unit, wrong source, late, huge, zero, gap. Then, where limits define
    them, lost ones that may be imputed and one too many, frozen, saturated and another level; an early decision."""
    period, w = manifest.period_s, manifest.window
    level = float(betas.mean()) or 1.0
    values = iter(np.resize(betas, 60 * (w + 8)).tolist())
    k = 0

    def take(count: int, beta: float | None = None, stated: Signal = signal) -> Iterator[tuple[float, BetaSample | None]]:
        nonlocal k
        for _ in range(count):
            now = k * period
            value = next(values) if beta is None else beta
            yield now, BetaSample(now, value, stated)
            k += 1

    yield 0.0, None
    k = 1
    yield from take(w + 5)
    yield from take(1, math.nan)
    yield from take(w + 3)
    yield from take(1, -level)
    yield from take(w + 3)
    for _ in range(3):  # nothing comes: still fresh at first, then stale
        yield k * period, None
        k += 1
    yield from take(w + 3)
    yield from take(1, None, Signal(signal.unit + "2", signal.source))
    yield from take(w + 1)
    yield from take(1, None, Signal(signal.unit, "another"))
    yield from take(w + 1)
    yield k * period, BetaSample((k - 1) * period, level, signal)  # again the one before
    k += 1
    yield from take(w + 2, 1e6 * level)
    yield from take(w + 2, 0.0)
    yield from take(w + 2)
    for lost in (manifest.most_imputed, manifest.most_imputed + 1) if manifest.most_imputed else ():
        yield from take(1, math.nan)  # one, with a measured one before the others: together one too many
        yield from take(1)
        for _ in range(lost):
            yield k * period, None
            k += 1
        yield from take(w + 2)
    if manifest.frozen_after is not None:
        yield from take(manifest.frozen_after + 1, level)
        yield from take(w + 1)
    if manifest.beta_max is not None:
        yield from take(2, 1.5 * manifest.beta_max)
        yield from take(w + 1)
    if manifest.level_low is not None:
        for _ in range(w + 3):  # a unit that is too small by far, and then the right one again
            yield from take(1, 0.1 * manifest.level_low * (1 + 0.01 * (k % 7)))
        yield from take(w + 4)
    yield (k - 0.5) * period, None  # a decision too early: the ramp allows half
    yield from take(3)


def to_json(windows: NDArray[np.float64], expected: NDArray[np.float64], steps: Sequence[Step]) -> bytes:
    """Write the file `test_vectors.json`; no number comes as null in `beta`, no sample as null in `t_s`."""
    rows: list[dict[str, Any]] = [
        {
            "now_s": s.now_s,
            "t_s": s.t_s,
            "beta": s.beta if s.finite else None,
            "unit": s.unit,
            "source": s.source,
            "amplitude_ma": s.amplitude_ma,
            "reasons": list(reason_names(s.reasons)),
        }
        for s in steps
    ]
    body = {"tolerance": TOLERANCE, "windows": windows.tolist(), "expected": expected.tolist(), "session": rows}
    return (json.dumps(body, allow_nan=False) + "\n").encode()
