"""Tests of visits' contrasts where a metric has a floor or a ceiling: how often they err, over more studies than `null_studies.py` makes.

    python -m benchmarks.development.skewed_contrasts --quick
    python -m benchmarks.development.skewed_contrasts [--studies 40000] [--seed 5]

One row per metric, number of visits, sessions of either arm, standard deviation of the effect between days (in those of a session), null:
`either`, what differs between days falls on either arm with the same chance; `latent`, the effect has no average in the latent value;
`own`, contrasts are held against their own average in the metric. Share rejected at .05: two-sided by Student's t and by the larger p of it
and of the ratio freed from skewness (the primary test of rating and tremor), and one-sided at .05 by the same for either direction.
Metrics are those of `support/null_worlds.py`; the order within a visit plays no part. Two CPU minutes for 40 000 studies.
"""

from __future__ import annotations

import argparse
import sys
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from benchmarks.support.null_worlds import BOUNDED, MINUTES, RESOLUTION
from ml.statistics.within_visits.contrasts import unskewed

Floats = NDArray[np.float64]
out = sys.stdout.write
ALPHA, DAY = 0.05, 1.5
DESIGNS = ((3, 3), (5, 3), (6, 3), (6, 1), (8, 3), (12, 3))
"""Visits, and sessions of either arm at each."""


def metric_of(name: str, z: Floats, rng: np.random.Generator) -> Floats:
    """A metric from its latent value, of any shape."""
    if name == "rating":
        return np.clip(np.round(7 + 0.8 * z), 1, 10)
    if name == "tremor":
        return np.asarray(100 * rng.binomial(MINUTES, 1 / (1 + np.exp(1.5 - 0.8 * z))) / MINUTES)
    return 2.3 + 0.15 * z


def contrasts(name: str, visits: int, each: int, slope: float, null: str, studies: int, rng: np.random.Generator) -> Floats:
    """Contrasts of visits, [studies, visits]."""
    shape = (studies, visits, 1)
    level, effect = DAY * rng.standard_normal(shape), slope * rng.standard_normal(shape)
    swapped = rng.random(shape) < 0.5 if null == "either" else np.zeros(shape, dtype=bool)
    noise = rng.standard_normal((2, studies, visits, each))
    tested = metric_of(name, level + np.where(swapped, 0.0, effect) + noise[0], rng).mean(-1)
    cdbs = metric_of(name, level + np.where(swapped, effect, 0.0) + noise[1], rng).mean(-1)
    return tested - cdbs


def ratios(found: Floats, floor: float, value: float) -> tuple[Floats, Floats]:
    """Student's ratio against a value, and the same freed from skewness, [studies]."""
    visits = found.shape[1]
    spread = np.sqrt(np.maximum(found.var(1, ddof=1), floor))
    spread = np.where(spread > 0, spread, np.inf)
    skewness = np.mean((found - found.mean(1, keepdims=True)) ** 3, axis=1) / spread**3
    student = np.sqrt(visits) * (found.mean(1) - value) / spread
    return student, unskewed(student, skewness, visits)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="1 000 studies of each cell")
    parser.add_argument("--studies", type=int, default=40_000)
    parser.add_argument("--seed", type=int, default=5)
    arguments = parser.parse_args()
    studies, rng = 1000 if arguments.quick else arguments.studies, np.random.default_rng(arguments.seed)
    out("metric  visits each  SD  null    average | two-sided: t, larger p | one-sided above: t, larger p | below: t, larger p\n")
    for name, (visits, each), slope in product((*BOUNDED, "grasp"), DESIGNS, (0.0, 0.5, 1.0, 2.0, 3.0)):
        for null in ("either", "latent", "own") if slope else ("latent",):
            found = contrasts(name, visits, each, slope, null, studies, rng)
            average = float(found.mean())
            t, h = ratios(found, RESOLUTION.get(name, 0.0) ** 2 / 12 * 2 / each, average if null == "own" else 0.0)
            two = np.abs(t), np.minimum(np.abs(t), np.abs(h))
            above, below = (t, np.minimum(t, h)), (-t, np.minimum(-t, -h))
            shares = [float(np.mean(sides * stdtr(visits - 1, -r) < ALPHA)) for rs, sides in ((two, 2), (above, 1), (below, 1)) for r in rs]
            cells = " | ".join(f"{a:.3f} {b:.3f}" for a, b in zip(shares[::2], shares[1::2], strict=True))
            out(f"{name:<8}{visits:>5} {each:>4} {slope:>4g}  {null:<7}{average:>8.2f} | {cells}\n")


if __name__ == "__main__":
    main()
