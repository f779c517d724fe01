"""Simulated studies in which nothing is to be found, and studies at the margin: do the tests keep their level, do the intervals cover?

    python benchmarks/null_studies.py --quick
    python benchmarks/null_studies.py --only level [--seed 1]
    python benchmarks/null_studies.py [--studies 2000] [--seed 0] [--workers 2] [--keep FOLDER] [--json FILE]

A study is one participant's visits with sessions of one controller and of cDBS. Every scenario adds what visits bring: days that differ, a
controller that does better on some days and worse on others, drift over the day, ties, arms of different size, missing values, arms on
different visits. The average effect is what is tested. The paper's test (all sessions as independent) is printed next to the primary one.

Where the controller's effect differs between days, the same studies are made again with an effect that has no average in the latent value
alone. Rating and tremor saturate, so that for them this is no null of the metric's average. How often the interval misses that average is
printed too. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from support.null_worlds import (
    BOUNDED,
    METRICS,
    MINUTES,
    WORLDS,
    Tally,
    World,
    latent,
    layout,
    margin_studies,
    measure,
    metric_average,
    show_margin,
)
from support.results import emit, run_benchmark

from ml.statistics.association import within_visits
from ml.statistics.effects import cliffs_delta, energy_saving
from ml.statistics.ranksum import as_in_the_paper
from ml.statistics.within_visits.averages import primary
from ml.statistics.within_visits.contrasts import Average, Measurements, Unavailable
from ml.statistics.within_visits.mixed_models import linear_comparison, minutes_comparison, ordinal_comparison
from ml.statistics.within_visits.stratified import shift_interval, van_elteren

ALPHA, LEVEL = 0.05, 0.95
CONTINUOUS = ("grasp", "beta", "energy")
LAWS = (CONTINUOUS, ("rating",), ("tremor",))
SKEWED = tuple(name for name, world in WORLDS.items() if world.slope)
"""Scenarios in which the controller's effect differs between days."""


def naive(data: Measurements) -> tuple[bool | None, bool | None]:
    """Run the paper's test of all sessions: rejected, and whether its interval covers no difference."""
    result = as_in_the_paper(data, LEVEL)
    if isinstance(result, Unavailable):
        return None, None
    return result.p_value < ALPHA, result.low <= 0 <= result.high


def error(number: int, level: float = ALPHA) -> float:
    """Compute the Monte Carlo standard error of a share that is `level`."""
    return float(np.sqrt(level * (1 - level) / number))


def rejects(found: Average | Unavailable) -> bool:
    """Decide whether a study rejects; one without evidence rejects nothing."""
    return isinstance(found, Average) and found.p_value < ALPHA


def drawn(name: str, studies: int, either: bool, seed: int) -> Iterator[tuple[int, str, Measurements]]:
    """Yield number, metric and data of the studies of one scenario; `either` as in `latent`."""
    world, rng = WORLDS[name], np.random.default_rng(sum(map(ord, name)) + 1_000_000 * seed)
    for study in range(studies):
        design = layout(world, rng)
        for metric in METRICS:
            # Energy follows from what the controller does: days and drift reach it through the controller alone.
            mine = replace(world, day=0.0, drift=0.0) if metric == "energy" else world
            yield study, metric, measure(metric, latent(mine, 0.0, rng, design, either), design, world, rng)


def null_studies(name: str, studies: int, seed: int) -> Tally:
    """Run one scenario with no average effect. The slower analyses are made in every twentieth study, the paper's test in every fourth."""
    tally = Tally()
    for study, metric, data in drawn(name, studies, True, seed):
        one_null(name, metric, data, tally, study)
    return tally


def skewed_studies(name: str, studies: int, seed: int) -> Tally:
    """Run one scenario whose effect has no average in the latent value: rating and tremor against none, and against their own average."""
    tally, own = Tally(), {metric: metric_average(WORLDS[name], metric) for metric in BOUNDED}
    for _, metric, data in drawn(name, studies, False, seed):
        if metric in own:
            found = primary(data, LEVEL)
            tally.add((name, metric, "latent null primary"), rejects(found))
            missed = isinstance(found, Average) and not found.low <= own[metric] <= found.high
            tally.add((name, metric, "own average primary"), missed)
    return tally


def levels(name: str, studies: int, seed: int) -> Tally:
    """Run the primary test of `null_studies` alone, of the same studies."""
    tally = Tally()
    for _, metric, data in drawn(name, studies, True, seed):
        add_primary(name, metric, data, tally)
    return tally


def add_primary(name: str, metric: str, data: Measurements, tally: Tally) -> None:
    """Count a study by the primary test."""
    found = primary(data, LEVEL)
    tally.add((name, metric, "primary"), rejects(found))
    tally.add((name, metric, "primary cover"), found.low <= 0 <= found.high if isinstance(found, Average) else None)


def one_null(name: str, metric: str, data: Measurements, tally: Tally, study: int) -> None:
    """Run all tests of one metric of one study."""
    add_primary(name, metric, data, tally)
    if study % 4 == 0:
        plain, plain_cover = naive(data)
        tally.add((name, metric, "naive"), plain)
        tally.add((name, metric, "naive cover"), plain_cover)
    delta = cliffs_delta(data, LEVEL)
    tally.add((name, metric, "delta cover"), delta.low <= 0 <= delta.high if isinstance(delta, Average) else None)
    if metric == "energy":
        saved = energy_saving(data, LEVEL, draws=999, seed=study)
        tally.add((name, metric, "saving cover"), None if isinstance(saved, Unavailable) else saved.low <= 0 <= saved.high)
    if metric == "beta":  # against a metric that has nothing to do with it
        x = np.random.default_rng(study).standard_normal(data.value.size)
        link = within_visits(x, data.value, data.visit, LEVEL)
        tally.add((name, metric, "slope cover"), None if isinstance(link, Unavailable) else link.low <= 0 <= link.high)
    if study % 20 == 0:
        test = van_elteren(data)
        tally.add((name, metric, "van elteren"), None if isinstance(test, Unavailable) else test.p_value < ALPHA)
        shift = shift_interval(data, LEVEL)
        tally.add((name, metric, "shift cover"), None if isinstance(shift, Unavailable) else shift.low <= 0 <= shift.high)
        model = mixed(metric, data)
        tally.add((name, metric, "mixed cover"), None if model is None else model.low <= 0 <= model.high)


def mixed(metric: str, data: Measurements) -> Average | None:
    """Estimate the effect of the mixed model that the metric calls for."""
    if metric == "rating":
        found = ordinal_comparison(data)
    elif metric == "tremor":
        counts = Measurements.of(np.round(data.value * MINUTES / 100), data.visit, data.tested)
        found = minutes_comparison(counts, np.where(np.isfinite(data.value), float(MINUTES), 0.0))
    else:
        found = linear_comparison(data)
    return None if isinstance(found, Unavailable) else found.effect


def power_studies(visits: int, studies: int, seed: int) -> Tally:
    """Count what the primary test, the exact one within visits and the paper's find of an effect of one standard deviation of a session."""
    tally = Tally()
    for slope in (0.0, 0.5):
        world, rng = World(visits=visits, each=4, slope=slope), np.random.default_rng(visits + 1_000_000 * seed)
        for _ in range(studies):
            design = layout(world, rng)
            z = latent(world, 1.0, rng, design)
            for metric in ("grasp", *BOUNDED):
                data = measure(metric, z, design, world, rng)
                key = f"{visits} visits, day x dose {slope:g}, {metric}"
                tally.add((key, "primary"), rejects(primary(data, LEVEL)))
                if metric == "grasp":
                    exact = van_elteren(data)
                    tally.add((key, "van elteren"), not isinstance(exact, Unavailable) and exact.p_value < ALPHA)
                    tally.add((key, "naive"), naive(data)[0])
    return tally


Part = Callable[[Any, int, int], Tally]


def cell(work: Part, argument: str | int, studies: int, seed: int, folder: Path | None) -> Tally:
    """Run one part of the benchmark; read where the folder has it from an earlier run of as many studies."""
    path = folder / f"{work.__name__}-{re.sub('[^a-z0-9]+', '-', str(argument).lower())}-{studies}-{seed}.json" if folder else None
    if path and path.exists():
        return Tally.read(path)
    tally = work(argument, studies, seed)
    if path:
        tally.write(path)
    return tally


def show_null(tally: Tally, studies: int) -> dict[str, float]:
    """Print the table of null studies and its worst cells; a cell is a scenario and metrics of one law (the continuous ones, rating,
    tremor)."""
    emit(f"null studies, {studies} of each scenario; share rejected at {ALPHA:g} (worst cell), intervals of {LEVEL:g} (range of cells)\n")
    labels = ("primary", "van elteren", "naive")
    intervals = ("primary", "delta", "saving", "slope", "mixed", "shift", "naive")
    emit(f"{'':<22}" + "".join(f"{label:>12}" for label in labels) + "".join(f"{label:>13}" for label in intervals) + "\n")
    for name in WORLDS:
        rates = [max(tally.pooled(name, law, label)[0] for law in LAWS) for label in labels]  # NaN of what was not made
        emit(f"{name:<22}" + "".join(f"{r:>12.3f}" for r in rates))
        for label in intervals:
            shares = [share for law in LAWS for share, n in [tally.pooled(name, law, f"{label} cover")] if n]
            emit(f"{f'{min(shares):.3f}-{max(shares):.3f}' if shares else '-':>13}")
        emit("\n")
    rejected = [(name, law, *tally.pooled(name, law, "primary")) for name in WORLDS for law in LAWS]
    rejected += [(f"{n}, latent", (m,), *tally.share(n, m, "latent null primary")) for n in SKEWED for m in BOUNDED]
    above = [(n, law, r) for n, law, r, number in rejected if r > ALPHA + 2 * error(number)]
    emit(f"cells of the primary test above its level by more than two errors: {len(above)} of {len(rejected)}")
    emit(f" (chance alone: {0.0228 * len(rejected):.1f}) {', '.join(f'{n}/{law[0]} {r:.4f}' for n, law, r in above)}\n\n")
    worst, number = max(r[2:] for r in rejected)
    judged = ("primary", "delta", "saving", "slope")
    covers = [tally.pooled(name, law, f"{label} cover") for name in WORLDS for law in LAWS for label in judged]
    continuous = [
        (n, *tally.pooled(n, CONTINUOUS, f"{c} cover")) for n, w in WORLDS.items() if w.visits >= 5 for c in ("primary", "saving", "slope")
    ]
    overall = [tally.pooled(n, METRICS, "primary") for n in WORLDS]
    return {
        "worst_primary_type1": worst,
        "worst_primary_type1_error": error(number),
        "worst_primary_type1_of_a_scenario": max(r for r, _ in overall),
        "coverage_low": min(share for share, n in covers if n),
        "coverage_high": max(share for _, share, n in continuous if n),
    }


def show_skewed(tally: Tally) -> None:
    """Print studies whose null is one of the latent value alone."""
    emit("the effect differs between days, without an average in the latent value: average in the metric | share rejected |")
    emit(" share of intervals that miss the average in the metric\n")
    for name in SKEWED:
        for metric in BOUNDED:
            shares = [tally.share(name, metric, f"{kind} primary")[0] for kind in ("latent null", "own average")]
            own = metric_average(WORLDS[name], metric)
            emit(f"{name:<22}{metric:<8}{own:>8.2f} |{shares[0]:>8.4f} |{shares[1]:>8.4f}\n")
    emit("\n")


def show_power(tally: Tally) -> None:
    """Print the power for an effect."""
    emit("\npower for an effect of one standard deviation of a session, 4 sessions of either arm a visit:")
    emit(" primary, van Elteren, the paper's\n")
    for key in dict.fromkeys(k[0] for k in tally.counts if len(k) == 2):
        labels = ("primary", "van elteren", "naive")
        emit(f"  {key:<36}" + "".join(f"{tally.share(key, label)[0]:>8.3f}" for label in labels) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="150 studies of each scenario")
    parser.add_argument("--only", choices=("level", "margin", "power"), help="level: the primary test alone in the null studies")
    parser.add_argument("--studies", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0, help="of the studies; those of two seeds have nothing in common")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="a folder for finished parts, which a later run of the same code reads")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    studies = 150 if arguments.quick else arguments.studies
    tally = Tally()
    only, parts = arguments.only, list[tuple[Part, str | int, int]]()
    if only in (None, "level"):
        parts += [(levels if only else null_studies, name, studies) for name in WORLDS]
        parts += [(skewed_studies, name, studies) for name in SKEWED]
    if only in (None, "margin"):
        parts += [(margin_studies, v, studies // 2 if v > 2 else studies // 20) for v in (12, 8, 6, 4, 3, 2, 1)]
    if only in (None, "power"):
        parts += [(power_studies, v, studies // 4) for v in (3, 4, 6, 8)]
    if arguments.keep:
        arguments.keep.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(arguments.workers) as pool:
        for part in [pool.submit(cell, *p, arguments.seed, arguments.keep) for p in parts]:
            tally.merge(part.result())
    figures: dict[str, float] = {}
    if only in (None, "level"):
        figures |= show_null(tally, studies)
        show_skewed(tally)
    if only in (None, "margin"):
        figures |= show_margin(tally)
    if only in (None, "power"):
        show_power(tally)
    figures["cpu_s"] = sum(os.times()[:4])
    emit(json.dumps(figures, indent=1) + "\n")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    run_benchmark(main)
