"""Best possible order of candidates after so many visits, by an observer that knows how virtual patients are made.

    python -m benchmarks.evaluation.ideal_observer --quick               one world of part A, few patients
    python -m benchmarks.evaluation.ideal_observer --every 6 --out FOLDER

Of each world the observer knows mechanism, trait, threshold and the distribution of all constants; the constants, the days and the noise it
must infer from the same sessions that a method has (`support/observer.py`). No method may know so much, so what it misses a method will
miss. It is a regression over simulated patients: the best possible may be somewhat better still. Each world is judged with further patients
of its kind, because one world's rank correlation is one draw. Finished worlds are kept in FOLDER. CPU seconds of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.support.cells import Cells
from benchmarks.support.observer import observe, patient_alike, returns_of
from benchmarks.support.ope_cases import DESIGNS
from benchmarks.support.results import run_benchmark
from ml.ope.compare.metrics import spearman
from ml.population.virtual import WORLDS_PER_PART, World, world

VISITS = (0, 1, 3, 9)
"""Visits that are seen; after none the observer has the mean over patients of the kind, whatever the world."""
PATIENTS, SESSIONS, TESTED, TRUTH = 300, 8, 8, 100
QUICK = {"patients": 30, "sessions": 4, "tested": 2, "truth": 30}
QUANTILE = 1.645
"""Half the width of a 90 % interval, in standard deviations of a normal."""
MEASURES = ("rank", "regret", "error", "error of differences", "width")


def observed(w: World, patients: int, sessions: int, tested: int, truth: int, visits: Sequence[int]) -> dict[str, Any]:
    """Compute `MEASURES` by design and number of visits: of the world itself (`own`) and of every tested patient of its kind (`others`)."""
    policies = list(w.candidates().values())
    learnt = [patient_alike(w, k) for k in range(patients)]
    runs = np.stack([returns_of(p, policies, sessions) for p in learnt])  # [N, C, M]
    targets, scatter = runs.mean(2), (runs.var(2, ddof=1) / sessions).mean(0)
    others = [patient_alike(w, patients + k) for k in range(tested)]
    true = np.stack([returns_of(p, policies, truth).mean(1) for p in [w, *others]])
    found: dict[str, Any] = {}
    for design in DESIGNS:
        for number in visits:
            told = observe(w, design, number, learnt, targets, scatter, others)  # type: ignore[arg-type]
            rows = [scores(s, t, told.error) for s, t in zip([told.said, *told.others], true, strict=True)]
            found[f"{design} {number}"] = {"own": rows[0], "others": rows[1:]}
    return found


def scores(said: np.ndarray, true: np.ndarray, error: np.ndarray) -> list[float]:
    """Compute `MEASURES` of one patient; errors and widths are shares of the range of true returns."""
    spread, miss = float(np.ptp(true)), said - true
    return [
        spearman(true, said) or 0.0,
        float(true.max() - true[int(np.argmax(said))]) / spread,
        float(np.abs(miss).mean()) / spread,
        float(np.abs(miss - miss.mean()).mean()) / spread,
        float(np.median(2 * QUANTILE * error)) / spread,
    ]


def lines(found: Sequence[dict[str, Any]]) -> list[str]:
    """Tabulate means over worlds with standard errors; a world's patients count together."""
    result = [f"{'':16} {'rank ± error':>14} {'decile':>7} {'regret':>7} {'error':>7} {'differences':>12} {'width':>7} {'own rank':>14}\n"]
    for key in found[0]:
        each = np.array([np.mean([f[key]["own"], *f[key]["others"]], axis=0) for f in found])
        every = np.array([row for f in found for row in (f[key]["own"], *f[key]["others"])])
        own = np.array([f[key]["own"][0] for f in found])
        rank, error, same = each[:, 0].mean(), _error(each[:, 0]), f"{own.mean():.2f} ± {_error(own):.2f}"
        decile = np.quantile(every[:, 0], 0.1)
        width = np.median(every[:, 4])
        middle = " ".join(f"{v:7.2f}" for v in (decile, each[:, 1].mean(), each[:, 2].mean()))
        result.append(f"{key:16} {f'{rank:.2f} ± {error:.2f}':>14} {middle} {each[:, 3].mean():12.2f} {width:7.2f} {same:>14}\n")
    return result


def _error(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def main() -> None:
    """Print the table and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one world and few patients")
    parser.add_argument("--first", type=int, default=0, help="index of the first world")
    parser.add_argument("--every", type=int, default=6, help="take every so manyth world of part A")
    parser.add_argument("--worlds", type=int, default=WORLDS_PER_PART)
    parser.add_argument("--patients", type=int, default=PATIENTS, help="that the observer learns from, of each world")
    parser.add_argument("--minutes", type=float, default=1e9, help="start no further world after so many minutes")
    parser.add_argument("--out", type=Path, help="folder of finished worlds; a temporary one by default")
    chosen = parser.parse_args()
    sizes = QUICK if chosen.quick else {"patients": chosen.patients, "sessions": SESSIONS, "tested": TESTED, "truth": TRUTH}
    out = chosen.out or Path(tempfile.mkdtemp(prefix="betaloop-observer-"))
    out.mkdir(parents=True, exist_ok=True)
    cells = Cells(out / f"observer{'-quick' if chosen.quick else ''}.jsonl")
    start = time.monotonic()
    for index in range(chosen.first, WORLDS_PER_PART, chosen.every)[: 1 if chosen.quick else chosen.worlds]:
        if cells.get(f"A{index:02d}") is not None or time.monotonic() - start > 60 * chosen.minutes:
            continue
        used = time.process_time()
        found = observed(world("A", index), **sizes, visits=VISITS[:3] if chosen.quick else VISITS)
        cells.add(f"A{index:02d}", found=found, seconds=time.process_time() - used)
        sys.stdout.write(f"A{index:02d}: {time.process_time() - used:.0f} CPU s\n")
        sys.stdout.flush()
    done = [cell["found"] for cell in cells.all("A")]
    sys.stdout.writelines([f"{len(done)} worlds of part A; visits behind each design\n", *lines(done)])
    ranks = {key: [np.mean([f[key]["own"], *f[key]["others"]], axis=0)[0] for f in done] for key in done[0]}
    figures = {f"rank_{key}".replace(" ", "_"): float(np.mean(each)) for key, each in ranks.items()}
    sys.stdout.write(json.dumps({"name": "ideal_observer", "figures": figures, "ratios": {}, "baseline": "posterior"}) + "\n")


if __name__ == "__main__":
    run_benchmark(main)
