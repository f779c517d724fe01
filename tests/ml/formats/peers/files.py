"""Files of every lab format with a known content, made at random from a seed; the faults of real recorders are among them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.ml.formats.peers import xdf
from tests.ml.formats.peers.truth import Truth, make_truth


@dataclass(frozen=True)
class Written:
    """A file and what is known of it; `names`, `lsb_uv`, `pause`, `steps` as `check.compare` takes them."""

    truth: Truth
    names: dict[str, str]
    lsb_uv: float = 0.0
    pause: bool = False
    steps: list[tuple[float, float]] | None = None
    said: dict[str, str] = field(default_factory=dict)


WORDS = ("stim on {a} mA", "Stim {a}mA", "DBS amplitude = {a} mA", "STIM_ON_{a}mA", "therapy set to {a} mA 130 Hz")


def write_xdf(path: Path, rng: np.random.Generator) -> Written:
    """Write LFP and markers on two computers' clocks, with drift, jitter, chunks with one stamp, and losses from two samples to 2 s."""
    rate = float(rng.choice([200.0, 250.0, 500.0, 1000.0]))
    truth = make_truth(rng, rate_hz=rate, gaps=int(rng.integers(0, 6)), steps=int(rng.integers(0, 5)))
    stamped = bool(rng.integers(2))
    jitter = float(rng.choice([0.0, 0.1, 0.3])) / rate
    drift = float(rng.uniform(-1e-4, 1e-4))
    offset, other = float(rng.uniform(-500, 500)), float(rng.uniform(-500, 500))
    local = 4000.0 - offset + truth.t_s * (1 - drift)
    form = str(rng.choice(["float32", "double64"]))
    unit, scale = [("uV", 1.0), ("mV", 1e-3), ("V", 1e-6), ("microvolts", 1.0)][int(rng.integers(4))]
    x = scale * np.column_stack(list(truth.channels.values()))
    stamps = local + rng.normal(0, jitter, local.size)
    kind, size = str(rng.choice(["LFP", "EEG"])), int(rng.choice([8, 32, 100]))
    names, growth = list(truth.channels), drift / (1 - drift)
    amp = xdf.Stream("LFP", kind, rate, stamps, x, names, [unit, unit], form, offset, size, stamped, drift=growth)
    marks = [str(rng.choice(WORDS)).format(a=a) for _, a in truth.steps]
    at = np.array([4000.0 + t - other for t, _ in truth.steps])
    streams = [amp, xdf.Stream("Markers", "Markers", 0, at, marks, form="string", offset_s=other, per_chunk=1)]
    xdf.write(path, streams if rng.integers(2) else streams[::-1])
    return Written(truth, {n: n.replace(" 0", " +0").replace(" 1-", " +1-") for n in truth.channels})


WRITERS: dict[str, Callable[[Path, np.random.Generator], Written]] = {"xdf": write_xdf}
"""By kind."""
