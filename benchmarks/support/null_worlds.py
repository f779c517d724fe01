"""Worlds of the null studies, and how a study is drawn from one: who was tested when, and what a metric then shows."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ml.statistics.within_visits.contrasts import Measurements

MINUTES = 10
METRICS = ("grasp", "beta", "rating", "tremor", "energy")
RESOLUTION = {"rating": 1.0, "tremor": 100 / MINUTES}
BOUNDED = ("rating", "tremor")
"""Metrics with a floor or a ceiling."""


@dataclass(frozen=True)
class World:
    """One scenario.

    Attributes:
        visits, each: visits, and sessions of either arm at each.
        day, slope: standard deviations of visits' levels and of the controller's effect between visits, in those of a session.
        drift: change from the first to the last session of a visit, in the same.
        design: `shuffled`, `alternating` (cDBS between any two), `cdbs_first` (alternating from cDBS on, so that the controller comes
            later), `apart` (every visit has one arm), `uneven` (one to five sessions of either arm).
        missing: share of values that are missing. heavy: noise of Student's t with 3 degrees of freedom.
    """

    visits: int = 5
    each: int = 3
    day: float = 1.5
    slope: float = 0.0
    drift: float = 0.0
    design: str = "shuffled"
    missing: float = 0.0
    heavy: bool = False


WORLDS = {
    "plain": World(day=0.0),
    "days": World(),
    "days, 3 visits": World(visits=3),
    "days, 8 visits": World(visits=8),
    "days, 1 v 1": World(visits=6, each=1),
    "day x dose": World(slope=1.0),
    "day x dose, 3 visits": World(visits=3, slope=1.0),
    "day x dose, 8 visits": World(visits=8, slope=1.0),
    "strong day x dose": World(visits=6, slope=3.0),
    "drift, shuffled": World(drift=2.0),
    "drift, alternating": World(drift=2.0, design="alternating"),
    "drift, cDBS first": World(drift=2.0, design="cdbs_first"),
    "drift, cDBS first, 3": World(visits=3, drift=2.0, design="cdbs_first"),
    "imbalance": World(visits=6, design="uneven"),
    "imbalance, dose": World(visits=6, slope=1.0, design="uneven"),
    "missing 30 %": World(each=4, missing=0.3),
    "heavy tails": World(heavy=True),
    "all of it": World(visits=6, slope=0.7, drift=1.0, design="uneven", missing=0.2, heavy=True),
    "arms apart": World(visits=6, each=4, design="apart"),
}


def layout(world: World, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Visit, arm and place in the visit of every session."""
    visit, tested, order = [], [], []
    for v in range(world.visits):
        if world.design == "apart":
            arm = np.full(world.each, v % 2 == 1)
        elif world.design == "uneven":
            arm = rng.permutation(np.repeat([False, True], rng.integers(1, 6, 2)))
        elif world.design == "alternating":
            arm = np.resize([True, False], 2 * world.each - 1)
        elif world.design == "cdbs_first":
            arm = np.resize([False, True], 2 * world.each)
        else:
            arm = rng.permutation(np.repeat([False, True], world.each))
        visit += [v] * arm.size
        tested += arm.tolist()
        order += range(arm.size)
    return np.array(visit), np.array(tested, dtype=bool), np.array(order, dtype=float)


def latent(
    world: World, effect: float, rng: np.random.Generator, design: tuple[np.ndarray, np.ndarray, np.ndarray], either: bool = False
) -> np.ndarray:
    """What a metric is made of, in standard deviations of a session.

    `either`: what differs between visits befalls either arm with the same chance, so that the average effect is nil in every metric, also
    in one that has a floor or a ceiling.
    """
    visit, tested, order = design
    noise = rng.standard_t(3, visit.size) / np.sqrt(3) if world.heavy else rng.standard_normal(visit.size)
    last = np.maximum(np.maximum.reduceat(order, np.flatnonzero(np.diff(visit, prepend=-1))), 1)[visit]
    level = world.day * rng.standard_normal(world.visits)
    slope = effect + world.slope * rng.standard_normal(world.visits)
    changed = tested ^ (rng.random(world.visits) < 0.5)[visit] if either and world.slope else tested
    return level[visit] + slope[visit] * changed + world.drift * order / last + noise


def measure(metric: str, z: np.ndarray, design: tuple[np.ndarray, np.ndarray, np.ndarray], world: World, rng: np.random.Generator):
    """A metric of the study from its latent value."""
    visit, tested, order = design
    value = {
        "grasp": lambda: 2.3 + 0.15 * z,
        "beta": lambda: 1.0 + 0.12 * z,
        "rating": lambda: np.clip(np.round(7 + 0.8 * z), 1, 10),
        "tremor": lambda: 100 * rng.binomial(MINUTES, 1 / (1 + np.exp(1.5 - 0.8 * z))) / MINUTES,
        "energy": lambda: 1.0 + 0.05 * z,
    }[metric]()
    value = np.where(rng.random(value.size) < world.missing, np.nan, value)
    return Measurements.of(value, visit, tested, order=order, resolution=RESOLUTION.get(metric, 0.0), bounded=metric in BOUNDED)


def metric_average(world: World, metric: str, visits: int = 20_000, seed: int = 0) -> float:
    """Average effect in the metric, in its unit, where its latent value has none: of that many visits, errors of their mean aside.

    Where a metric has a floor or a ceiling, an effect that is up on some days and down on others does not cancel in it.
    """
    rng, many = np.random.default_rng(seed), replace(world, visits=visits, missing=0.0)
    design = layout(many, rng)
    visit, tested, _ = design
    value = measure(metric, latent(many, 0.0, rng, design), design, many, rng).value
    means = [np.bincount(visit, value * arm) / np.bincount(visit, arm) for arm in (tested.astype(float), (~tested).astype(float))]
    return float(np.mean(means[0] - means[1]))


def nothing_to_test() -> dict[str, Measurements]:
    """Studies that hold nothing to test."""
    visit, arms = np.repeat(np.arange(5), 4), np.tile([False, True], 10)
    nan = np.full(20, np.nan)
    return {
        "all tied": Measurements.of(np.ones(20), visit, arms),
        "one session": Measurements.of([1.0], [1], [True]),
        "nothing": Measurements.of([], [], []),
        "no value": Measurements.of(nan, visit, arms),
        "one visit": Measurements.of(np.arange(20.0), np.zeros(20), arms),
        "one arm": Measurements.of(np.arange(20.0), visit, np.zeros(20)),
        "arms apart": Measurements.of(np.arange(20.0), visit, visit % 2 == 0),
    }


class Tally:
    """Shares of studies, each with its number."""

    def __init__(self) -> None:
        self.counts: dict[tuple[str, ...], list[int]] = {}

    def add(self, key: tuple[str, ...], hit: bool | None) -> None:
        if hit is not None:
            cell = self.counts.setdefault(key, [0, 0])
            cell[0] += int(hit)
            cell[1] += 1

    def merge(self, other: Tally) -> None:
        for key, (hits, number) in other.counts.items():
            cell = self.counts.setdefault(key, [0, 0])
            cell[0] += hits
            cell[1] += number

    def write(self, path: Path) -> None:
        """Whole or not at all."""
        draft = path.with_suffix(".part")
        draft.write_text(json.dumps([[*key, *counts] for key, counts in self.counts.items()]))
        draft.replace(path)

    @classmethod
    def read(cls, path: Path) -> Tally:
        """What `write` wrote."""
        tally = cls()
        tally.counts = {tuple(row[:-2]): row[-2:] for row in json.loads(path.read_text())}
        return tally

    def share(self, *key: str) -> tuple[float, int]:
        hits, number = self.counts.get(key, [0, 0])
        return (hits / number if number else float("nan")), number

    def pooled(self, name: str, metrics: tuple[str, ...], label: str) -> tuple[float, int]:
        """Over metrics that follow the same law."""
        cells = [self.counts.get((name, m, label), [0, 0]) for m in metrics]
        number = sum(c[1] for c in cells)
        return (sum(c[0] for c in cells) / number if number else float("nan")), number
