"""Worlds of the null studies, and how a study is drawn from one: who was tested when, and what a metric then shows; and studies of
controllers that lose nothing, or exactly what is accepted of one outcome.

Steps, bounds, margins, scales and values of failures are those of the service (`app.analysis.primary_verdict.judged_outcome`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit

from app.analysis import facts
from app.analysis.primary_verdict import judged_outcome
from ml.outcomes import BY_KEY, KEYS
from ml.qoc import Margins
from ml.statistics.noninferiority import LEAST_VISITS, Inconclusive, NonInferiorAndSaving, assess
from ml.statistics.within_visits.contrasts import Measurements

from .results import emit

RESOLUTION = facts.RESOLUTION
BOUNDED = tuple(sorted(facts.BOUNDED))
MINUTES = 10
GRASP_HZ = 2.3
METRICS = ("grasp", "beta", "rating", "tremor", "energy")


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
    """Draw visit, arm and place in the visit of every session."""
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
    """Draw what a metric is made of, in standard deviations of a session.

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
    """Derive a metric of the study from its latent value."""
    visit, tested, order = design
    value = {
        "grasp": lambda: GRASP_HZ + 0.15 * z,
        "beta": lambda: 1.0 + 0.12 * z,
        "rating": lambda: np.clip(np.round(7 + 0.8 * z), 1, 10),
        "tremor": lambda: 100 * rng.binomial(MINUTES, expit(0.8 * z - 1.5)) / MINUTES,
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


def tremor_effect(world: World, points: float) -> float:
    """Find the average effect in the latent value that brings so many more percentage points of tremor on average over sessions and
    visits."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)

    def tremor(effect: float, spread: float) -> float:
        return 100 * float(weights @ expit(0.8 * (effect + spread * nodes) - 1.5)) / float(weights.sum())

    alone = float(np.hypot(world.day, 1.0))
    return float(brentq(lambda e: tremor(e, float(np.hypot(alone, world.slope))) - tremor(0.0, alone) - points, -20.0, 20.0))


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
        """Write the file whole or not at all."""
        draft = path.with_suffix(".part")
        draft.write_text(json.dumps([[*key, *counts] for key, counts in self.counts.items()]))
        draft.replace(path)

    @classmethod
    def read(cls, path: Path) -> Tally:
        """Read what `write` wrote."""
        tally = cls()
        tally.counts = {tuple(row[:-2]): row[-2:] for row in json.loads(path.read_text())}
        return tally

    def share(self, *key: str) -> tuple[float, int]:
        hits, number = self.counts.get(key, [0, 0])
        return (hits / number if number else float("nan")), number

    def pooled(self, name: str, metrics: tuple[str, ...], label: str) -> tuple[float, int]:
        """Pool metrics that follow the same law."""
        cells = [self.counts.get((name, m, label), [0, 0]) for m in metrics]
        number = sum(c[1] for c in cells)
        return (sum(c[0] for c in cells) / number if number else float("nan")), number


MARGINS = Margins()
"""As a study begins with them."""

EVERYWHERE = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.05), (0.5, 0.05))
"""Standard deviation of every outcome's effect between days, and share of the controller's sessions that are stopped."""

TREMOR_ALONE = (1.0, 2.0, 3.0)
"""Standard deviations of tremor's effect between days where that of the others is the same on all: what its test finds hardest."""


def margin_studies(visits: int, studies: int, seed: int) -> Tally:
    """Run studies with one outcome exactly at its margin, or everything equal to cDBS; energy saved by a third."""
    tally = Tally()
    cells = [(at, slope, slope, stops, studies) for slope, stops in EVERYWHERE for at in KEYS]
    cells += [("nothing", slope, slope, stops, studies // 4) for slope, stops in EVERYWHERE]
    cells += [("tremor", 0.0, slope, 0.0, studies) for slope in TREMOR_ALONE]
    for number, (at, slope, of_tremor, stops, count) in enumerate(cells):
        rng = np.random.default_rng([visits, seed, number])
        where = f"day x dose {slope:g}" if slope == of_tremor else f"day x dose of tremor {of_tremor:g}"
        for study in range(count):
            small = World(visits=visits, each=4, day=1.0, slope=slope)
            shown, saving = judged({m: replace(small, slope=of_tremor if m == "tremor" else slope) for m in KEYS}, at, stops, rng, study)
            key = (f"{visits} visits", where, f"stopped {stops:.0%}", at)
            tally.add((*key, "non-inferior"), shown)
            tally.add((*key, "and saving"), saving)
    return tally


def judged(worlds: dict[str, World], at: str, stops: float, rng: np.random.Generator, seed: int) -> tuple[bool, bool]:
    """Decide whether non-inferiority is shown by the service's rule, and whether the saving is too; `at`: the outcome at its margin."""
    design = layout(worlds["grasp"], rng)
    visit, tested, order = design
    stopped = (rng.random(visit.size) < stops) & tested
    outcomes = []
    for name, world in worlds.items():
        effect = tremor_effect(world, MARGINS.tremor_points) if name == at == "tremor" else 0.0
        data = measure(name, latent(world, effect, rng, design), design, world, rng)
        if name == at != "tremor":
            lost = {"grasp": MARGINS.grasp_share * GRASP_HZ, "rating": MARGINS.rating_points}[name]
            data = replace(data, value=data.value - lost * tested)
        record = BY_KEY[name]
        judged_as = judged_outcome(record, data, stopped, MARGINS.of(record), record.failed(data.value))
        assert judged_as is not None, "cDBS has a grasp frequency in every study"
        outcomes.append(judged_as)
    energy = np.where(tested, 0.65, 1.0) + np.where(tested, 0.05, 0.01) * rng.standard_normal(visit.size)
    spent = Measurements.of(energy, visit, tested, order=order, resolution=RESOLUTION["energy"])
    result = assess(outcomes, spent, stopped, seed=seed, plan=False)
    saving = isinstance(result.verdict, NonInferiorAndSaving)
    shown = saving or (isinstance(result.verdict, Inconclusive) and result.verdict.open == ("energy",))
    return shown, saving


def _share(share: float) -> str:
    return f"{'-' if np.isnan(share) else f'{share:.3f}':>8}"


def show_margin(tally: Tally) -> dict[str, float]:
    """Print non-inferiority at the margin and where nothing is lost."""
    emit("non-inferiority shown: grasp, rating, tremor exactly at its margin (an error)")
    emit(" | nothing lost (power), of it with the saving shown\n")
    asked = {k: c for k, c in tally.counts.items() if len(k) == 5}
    for key in sorted(dict.fromkeys(k[:3] for k in asked), key=lambda k: (int(k[0].split()[0]), k)):
        wrong = [tally.share(*key, at, "non-inferior")[0] for at in KEYS]
        right = [tally.share(*key, "nothing", label)[0] for label in ("non-inferior", "and saving")]
        emit(f"  {', '.join(key):<50}{' |'.join(''.join(map(_share, shares)) for shares in (wrong, right))}\n")
    errors = {k: c for k, c in asked.items() if k[3] != "nothing" and k[4] == "non-inferior"}
    cases: dict[tuple[str, str, bool], list[list[int]]] = {}  # of one number of visits and outcome, the same for all outcomes or of tremor
    for (visits, where, _, at, _), count in errors.items():
        cases.setdefault((visits, at, "of tremor" in where), []).append(count)
    pooled = {case: sum(c[0] for c in counts) / sum(c[1] for c in counts) for case, counts in cases.items()}
    few = [c[0] for k, c in asked.items() if k[4] == "non-inferior" and int(k[0].split()[0]) < LEAST_VISITS]
    return {
        "non_inferior_at_margin": max(share for (_, _, alone), share in pooled.items() if not alone),
        "non_inferior_at_margin_tremor_alone": max(share for (_, _, alone), share in pooled.items() if alone),
        "non_inferior_at_margin_worst_cell": max(hits / number for hits, number in errors.values()),
        "non_inferior_below_three_visits": float(sum(few)),
    }
